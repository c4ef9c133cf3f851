"""The rights of a sender's role that keys alone don't enforce: checked before its query is answered. Pure.

Access control ties the `<host>` in a sender's keys to its certificate, so rights are looked up by that name alone. On
a plain mesh nothing proves a name, and nothing is refused here."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Final

from msgspec import structs

from zscout.config.fleet import Fleet
from zscout.config.scheduling_policy import RcQuota, SchedulingPolicy
from zscout.keyexpr import NODES, USERS, Rank, Sender, as_pattern, is_pattern
from zscout.messages import (
    ActivateComponent,
    ComponentOperation,
    ListComponents,
    Placement,
    ReadOutput,
    Refused,
    RestoreComponent,
    StopComponent,
    Who,
)
from zscout.scheduling.model import ArcRequest, ArcStatus
from zscout.types import SECOND, ClientId, ComponentId, HostName, Ns, RcName

OPERATORS: Final[frozenset[Rank]] = frozenset({"operator"})


class Authority:
    """The rights of all names, and the limits, by the fleet file as it was read last."""

    def __init__(self, fleet: Fleet) -> None:
        self._policy, self.enforced = fleet.access, fleet.security is not None
        self.limits = fleet.limits
        self._runtimes = fleet.min_runtime, fleet.command_min_runtime
        self._operator_priority = fleet.operator_priority
        self.placed: Mapping[ComponentId, Placement] = {}
        """The components that the placer published last."""

    def reload(self, fleet: Fleet) -> None:
        self._policy, self.limits = fleet.access, fleet.limits
        self._runtimes = fleet.min_runtime, fleet.command_min_runtime

    def bound(self, policy: SchedulingPolicy) -> SchedulingPolicy:
        """The policy with the rights and limits for the scheduler. A name belongs to the first of its groups."""
        policy = self.limits.bound(policy)
        if policy.fair_shares is not None:
            # Reversed, so that the first group of a name overwrites the others.
            listed = reversed([*self._policy.groups.items()])
            groups = {name: group for group, members in listed for name in members}
            policy = replace(policy, fair_shares=replace(policy.fair_shares, groups=groups))
        if not self.enforced:
            return policy
        names = list(self._policy.ranks)
        quotas = {
            name: tuple(
                RcQuota(owner, frozenset(members), quota.rcs)
                for owner, members, quota in self._policy.quotas_of(name)
                if quota.rcs is not None
            )
            for name in names
        }
        return replace(
            policy,
            rc_quotas={name: found for name, found in quotas.items() if found},
            barred={name: found for name in names if (found := self._barred(name))},
        )

    def check_ask(self, name: str, asked: ArcRequest, open_by: Callable[[Collection[str]], int]) -> None:
        """Raises Refused if `name` may not make this request. `open_by`: counts the open ARCs of some names."""
        if not self.enforced:
            return
        self._check_rank(name, "request devices", USERS)
        most, longest = self.highest_priority(name), self.longest_runtime(name)
        if most is not None and asked.priority > most:
            raise self._refused(name, f"request priority {asked.priority}; at most {most}")
        if longest and asked.min_runtime > longest:
            raise self._refused(name, f"request {asked.min_runtime / SECOND:g} s; at most {longest / SECOND:g} s")
        for need in asked.needs:
            if not is_pattern(need) and not self.may_hold(name, need):
                raise Refused(
                    "not_allowed", self._policy.refusal_text(name, f"hold {need}", self._policy.holders(need) or ())
                )
        for owner, members, quota in self._policy.quotas_of(asked.charged_to or name):
            if quota.rcs is not None and len(asked.needs) > quota.rcs:
                raise Refused(
                    "not_allowed",
                    f"{owner} may hold {quota.rcs} devices at one time, and this request needs more; name fewer",
                )
            if quota.arcs is not None and open_by(members) >= quota.arcs:
                raise Refused("not_allowed", f"{owner} has {quota.arcs} open requests, its quota; cancel one")

    def highest_priority(self, name: str) -> int | None:
        """None: any."""
        if not self.enforced:
            return None
        most = self._policy.ceiling(name).priority
        if "operator" in self._policy.ranks_of(name):
            return most
        below = self._operator_priority - 1
        return below if most is None else min(below, most)

    def longest_runtime(self, name: str) -> Ns:
        """0: any."""
        return (self._policy.ceiling(name).runtime or 0) if self.enforced else 0

    def until_done(self, name: str, min_runtime: Ns) -> Ns:
        """How long a hold of this name for a command is protected; 0: for `min_runtime`, if that is less than the
        fleet's, as the request then ranks before others."""
        usual, most = self._runtimes
        limits = (most, self.longest_runtime(name) or most, self.limits.max_runtime or most)
        return min(limits) if min_runtime >= usual else 0

    def starter(self, client: ClientId) -> str:
        """The name whose quotas count a component's requests: of the person who started it. Empty: its own host's."""
        host, _, name = client.partition("/")
        placement = self.placed.get(name.rpartition(".")[0]) if self.enforced else None
        if placement is None or host not in (placement.host, placement.to):
            return ""
        return placement.spec.owner if self._policy.ranks_of(placement.spec.owner) & USERS else ""

    def may_lead(self, host: HostName) -> bool:
        return not self.enforced or "manager" in self._policy.ranks_of(host)

    def certified_who(self, sender: Sender, who: Who | None) -> Who | None:
        """Return `who` with the user of the sender's certificate, not the user that it claims."""
        return structs.replace(who, user=sender.host) if who is not None and self.enforced else who

    def check_hand_over(
        self,
        sender: Sender,
        to: Sender,
        arcs: Collection[ArcStatus],
        open_by: Callable[[Collection[str]], int],
        held_by: Callable[[Collection[str]], int],
    ) -> None:
        """Raises Refused if the new client may not have these ARCs. `open_by` and `held_by` count the open ARCs of
        names, and the RCs that they hold."""
        if not self.enforced:
            return
        self._check_rank(to.host, "take over a request", USERS)
        for arc in arcs:
            wanted = arc.request if arc.hold is None else structs.replace(arc.request, needs=arc.needs)
            self.check_ask(to.host, wanted, lambda _: 0)
        running = sum(len(arc.needs) for arc in arcs if arc.hold is not None)
        for owner, members, quota in self._policy.quotas_of(self.starter(str(to)) or to.host):
            if (self.starter(str(sender)) or sender.host) in members:
                continue  # the quota counts these ARCs already
            if quota.arcs is not None and open_by(members) + len(arcs) > quota.arcs:
                words = f"{owner} may have {quota.arcs} open requests, and would have more; cancel some first"
                raise Refused("not_allowed", words)
            if running and quota.rcs is not None and held_by(members) + running > quota.rcs:
                words = f"{owner} may hold {quota.rcs} devices at one time, and would hold more; release some first"
                raise Refused("not_allowed", words)

    def check_operator(self, sender: Sender, what: str) -> None:
        """Raises Refused for all but operators. `what` follows `may not` in the refusal."""
        if self.enforced:
            self._check_rank(sender.host, what, OPERATORS)

    def check_user(self, sender: Sender, what: str) -> None:
        """Raises Refused for senders that may only view."""
        if self.enforced:
            self._check_rank(sender.host, what, USERS)

    def check_component(self, sender: Sender, operation: ComponentOperation) -> None:
        """Raises Refused if `sender` may not order this of a node: the placer starts and moves, operators may also
        stop, and a moving component may hand its state to its next incarnation."""
        if not self.enforced or isinstance(operation, ListComponents | ReadOutput):
            return
        name, _, number = sender.client.rpartition(".")
        what = f"order a node to {operation.__struct_config__.tag} {operation.component}"
        match operation:
            case RestoreComponent() | ActivateComponent() | StopComponent(incarnation=int()) if (
                operation.component == name and number.isdecimal() and int(number) < (operation.incarnation or 0)
            ):
                self._check_rank(sender.host, what, NODES)
            case StopComponent():
                self._check_rank(sender.host, what, {"manager", "operator"})
            case _:
                self._check_rank(sender.host, what, {"manager"})

    def may_hold(self, name: str, rc: RcName) -> bool:
        holders = self._policy.holders(rc) if self.enforced else None
        return holders is None or name in holders

    def _barred(self, name: str) -> tuple[str, ...]:
        allowed = {name, *self._policy.groups_of(name)}
        barred = (pattern for pattern, names in self._policy.access.items() if not allowed & {*names})
        return tuple(map(as_pattern, barred))

    def is_removed(self, client: ClientId) -> bool:
        ranks = self._policy.ranks_of(client.partition("/")[0])
        return self.enforced and not ranks & USERS

    def _check_rank(self, name: str, what: str, needed: Collection[Rank]) -> None:
        if why := self._policy.refusal(name, what, needed):
            raise Refused("not_allowed", why)

    def _refused(self, name: str, what: str) -> Refused:
        operators = [operator for operator, ranks in self._policy.ranks.items() if "operator" in ranks]
        return Refused("not_allowed", self._policy.refusal_text(name, what, operators))
