"""Access rights: the roles, groups, quotas and ceilings of a fleet file, and the rights that follow for each name.

A name is the common name of a certificate: a machine's (node, manager, relay) or a person's (viewer, client, operator).
Without `[security]` names are not proved, and rights are not enforced."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from functools import cached_property
from hashlib import blake2b
from typing import Annotated, Any, Final, get_args

from msgspec import Meta, Struct, to_builtins
from msgspec.structs import replace

from zscout.config.strict import Where, check_name, check_names, key, quoted, seconds
from zscout.keyexpr import PEOPLE, FleetMember, Rank, as_pattern, matcher
from zscout.types import SECOND, HostName, Ns, RcName

MAX_NAMES: Final = 1_000
"""Names of one role or group; groups, patterns and quotas of one file."""
MAX_PATTERNS: Final = 1_000
"""RCs, or patterns of RCs, that a host may serve."""
MAX_NAMED: Final = 4
"""Permitted names that a refusal lists."""
CLIENT_RUNTIME: Final[Ns] = 86_400 * SECOND
"""The longest minimum runtime of a client, by default."""
_RC: Final = re.compile(r"[A-Za-z0-9_.*-]{1,64}/[A-Za-z0-9_.*-]{1,64}")

Names = Annotated[tuple[str, ...], Meta(max_length=MAX_NAMES)]
Patterns = Annotated[tuple[str, ...], Meta(max_length=MAX_PATTERNS)]


class Roles(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [roles]: the role of each name. A person has one role; a machine may be node and manager."""

    viewer: Annotated[Names, key("People who may look.", example=["wall"])] = ()
    client: Annotated[Names, key("People whose programs may hold RCs, and start components.", example=["bob"])] = ()
    operator: Annotated[
        Names, key("People who may also take, end others' ARCs, move components and drain hosts.", example=["ada"])
    ] = ()
    node: Annotated[
        Mapping[str, Patterns],
        key(
            "Hosts, with the RCs that each may serve; `*` is any part of a name.",
            most=MAX_NAMES,
            example={"bellows": ["robot/scout33", "radio/*"]},
        ),
    ] = {}
    manager: Annotated[Names, key("Hosts whose nodes may lead; the others never do.", example=["anvil"])] = ()
    relay: Annotated[
        Names, key("Hosts that join sites. They forward all messages under their own name.", example=["gate"])
    ] = ()


class Quota(Struct, frozen=True, forbid_unknown_fields=True):
    """A table of [quotas]: limits of one name, or of the members of one group together, at one time."""

    rcs: Annotated[Annotated[int, Meta(ge=0, le=100_000)] | None, key("RCs that are held.")] = None
    arcs: Annotated[Annotated[int, Meta(ge=0, le=100_000)] | None, key("ARCs, waiting or running.")] = None


class Ceiling(Struct, frozen=True, forbid_unknown_fields=True):
    """A table of [ceilings]: limits of each ARC of one role."""

    priority: Annotated[
        Annotated[int, Meta(ge=-1_000_000, le=1_000_000)] | None,
        key("The highest priority; for clients always below `operator_priority`."),
    ] = None
    runtime: Annotated[
        Ns | None, seconds("0", "31622400", "The longest minimum runtime; 0: any. Without it: a day for clients.")
    ] = None


class AccessPolicy(Struct, frozen=True, dict=True):
    roles: Roles = Roles()
    groups: Mapping[str, tuple[str, ...]] = {}
    access: Mapping[str, tuple[str, ...]] = {}
    """By pattern of RCs: the names and groups that may hold them. Each pattern that matches an RC must allow a name."""
    quotas: Mapping[str, Quota] = {}
    ceilings: Mapping[Rank, Ceiling] = {}

    @cached_property
    def ranks(self) -> Mapping[str, frozenset[Rank]]:
        found: dict[str, set[Rank]] = {}
        for rank in get_args(Rank):
            for name in getattr(self.roles, rank):
                found.setdefault(name, set()).add(rank)
        return {name: frozenset(ranks) for name, ranks in found.items()}

    @cached_property
    def digest(self) -> str:
        """Hash of all rights, independent of the order of names."""
        return blake2b(_ordered(to_builtins(self)).encode(), digest_size=6).hexdigest()

    def ranks_of(self, name: str) -> frozenset[Rank]:
        return self.ranks.get(name, frozenset())

    def members(self) -> list[FleetMember]:
        """All names, with the RCs that they may serve."""
        return [FleetMember(name, ranks, self.roles.node.get(name, ())) for name, ranks in sorted(self.ranks.items())]

    def may_serve(self, host: HostName, rc: RcName) -> bool:
        return any(matcher(as_pattern(pattern))(rc) for pattern in self.roles.node.get(host, ()))

    def groups_of(self, name: str) -> list[str]:
        return [group for group, members in self.groups.items() if name in members]

    def holders(self, rc: RcName) -> frozenset[str] | None:
        """The names that may hold this RC; None: all names that may hold any RC."""
        allowed: frozenset[str] | None = None
        for pattern, names in self.access.items():
            if matcher(as_pattern(pattern))(rc):
                these = frozenset(member for name in names for member in self.groups.get(name, (name,)))
                allowed = these if allowed is None else allowed & these
        return allowed

    def quotas_of(self, name: str) -> Iterator[tuple[str, Collection[str], Quota]]:
        """The name or group that has the quota, the names that share it, and the quota."""
        for owner in (name, *self.groups_of(name)):
            if owner in self.quotas:
                yield owner, self.groups.get(owner, (owner,)), self.quotas[owner]

    def ceiling(self, name: str) -> Ceiling:
        """The ceiling of this name's ARCs. Programs on a machine (its components) have the ceiling of clients."""
        ranks = self.ranks_of(name)
        rank: Rank = "operator" if "operator" in ranks else "client"
        found = self.ceilings.get(rank, Ceiling())
        return found if found.runtime is not None else replace(found, runtime=CLIENT_RUNTIME if rank == "client" else 0)

    def refusal(self, name: str, what: str, needed: Collection[Rank]) -> str:
        """The text of `refusal_text` unless this name has one of the ranks `needed` for `what`; else ""."""
        if self.ranks_of(name) & {*needed}:
            return ""
        return self.refusal_text(name, what, [other for other, ranks in self.ranks.items() if ranks & {*needed}])

    def refusal_text(self, name: str, what: str, permitted: Collection[str]) -> str:
        ranks, names = self.ranks_of(name), sorted(permitted)
        title = f"{name} ({', '.join(sorted(ranks))})" if ranks else f"{name}, which has no role here,"
        more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
        return f"{title} may not {what}; {', '.join(names[:MAX_NAMED]) + more or 'nobody'} may"


def _ordered(value: Any) -> str:
    match value:
        case dict():
            return f"{{{','.join(f'{name!r}:{_ordered(value[name])}' for name in sorted(value))}}}"
        case list() | tuple():
            return f"[{','.join(sorted(map(_ordered, value)))}]"
        case _:
            return repr(value)


def check_access(policy: AccessPolicy, at: Where) -> None:
    """Raises BadInput for a name with two roles, and for a group, access rule or quota with an unknown name."""
    seen: dict[str, Rank] = {}
    for rank in get_args(Rank):
        names, here = getattr(policy.roles, rank), at / "roles" / rank
        check_names(names, here)
        for name in names:
            other = seen.setdefault(name, rank)
            if other != rank and not {other, rank} <= {"node", "manager"}:
                what = "a machine or a person" if (other in PEOPLE) != (rank in PEOPLE) else "one of the two"
                raise here.bad(f"{quoted(name)} already has the role {other}", f"a name has one role: make it {what}")
    for host, patterns in policy.roles.node.items():
        for number, pattern in enumerate(patterns):
            _check_pattern(pattern, (at / "roles" / "node" / host).item(number))
    for group, members in policy.groups.items():
        check_name(group, at / "groups" / group)
        if group in seen:
            raise (at / "groups" / group).bad(f"{quoted(group)} is also a name with a role", "rename the group")
        _check_known(members, seen, at / "groups" / group)
    known = {*seen, *policy.groups}
    for pattern, names in policy.access.items():
        _check_pattern(pattern, at / "access" / pattern)
        _check_known(names, known, at / "access" / pattern)
    _check_known(policy.quotas, known, at / "quotas")
    for rank in policy.ceilings:
        if rank not in ("client", "operator"):
            raise (at / "ceilings" / rank).bad(
                "only clients and operators have a ceiling", 'write "client" or "operator"'
            )


def _check_known(names: Collection[str], known: Collection[str], at: Where) -> None:
    for number, name in enumerate(names):
        here = at / name if isinstance(names, Mapping) else at.item(number)
        check_name(name, here)
        if name not in known:
            raise here.bad(f"{quoted(name)} has no role", "name it under [roles], or correct the name")


def _check_pattern(pattern: str, at: Where) -> None:
    if not _RC.fullmatch(pattern) or "**" in pattern:
        remedy = 'write kind/name with * for any part, as in "robot/scout33" or "robot/arm*"'
        raise at.bad(f"{quoted(pattern)} does not name a device", remedy)
