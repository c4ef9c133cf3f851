"""The key space: every key expression of zscout is built and parsed here, and nowhere else.

All keys begin with `zscout/<fleet>`. The key of a request contains its sender, so that access control can check it; the
receiver reads the sender from the key and refuses wildcards there."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Collection, Iterable
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal, NamedTuple, TypeAlias

MAX_NAME = 64
NAME = re.compile(rf"[A-Za-z0-9_.-]{{1,{MAX_NAME}}}")
# `*`, or a name with `$*` for any part; not two stars in a row, and not `$*` alone.
_CHUNK = rf"(?:\*|(?![^/#]*\$\*\$)(?!\$\*(?:[/#]|\Z))(?:[A-Za-z0-9_.-]|\$\*){{1,{MAX_NAME}}})"
_PATTERN = re.compile(rf"{_CHUNK}/{_CHUNK}(?:#[1-9][0-9]?)?")
ROOT = "zscout"
MAX_DIGITS = 19
"""Digits of an incarnation."""
CACHED_NAMES = 4_096
"""Valid names that are not checked again."""


class BadName(ValueError):
    """A name or key that is not valid in the key space; the message has the name and the rule."""


def _quoted(text: str) -> str:
    return '"{}"'.format(repr(text[:130])[1:-1].replace("\\'", "'").replace('"', '\\"'))


@lru_cache(CACHED_NAMES)
def check_name(name: str, what: str = "name") -> str:
    """Return `name` if it is valid in a key. Raises BadName."""
    if NAME.fullmatch(name) is None:
        raise BadName(f"{what} {_quoted(name)} is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -")
    return name


def check_new_name(name: str, what: str) -> str:
    """`check_name` for a name that a person gave: the error suggests a valid name, `test_gpu-0` for `test_gpu[0]`."""
    try:
        return check_name(name, what)
    except BadName as error:
        near = re.sub(r"-{2,}", "-", valid_name(name[:200])).strip("-")
        raise BadName(f"{error}, as in {near}" if re.search("[A-Za-z0-9]", near) and name else str(error)) from None


@lru_cache(CACHED_NAMES)
def check_rc(name: str) -> str:
    """Return `name` if it is a valid `kind/name` of an RC. Raises BadName."""
    kind, slash, rest = name.partition("/")
    if not slash:
        raise BadName(f"device {_quoted(name)} is not valid; write kind/name, as in robot/scout33")
    check_name(kind, "kind")
    check_name(rest, "device name")
    return name


def is_pattern(need: str) -> bool:
    """Return True if a need is a pattern of RC names, not a name."""
    return "*" in need


@lru_cache(CACHED_NAMES)
def check_need(need: str) -> str:
    """Return `need` if it is an RC or a pattern: `kind/name` with `*` or `$*` in it, and `#2`, `#3` and so on for
    further RCs by the same pattern. Raises BadName."""
    if not is_pattern(need):
        return check_rc(need)
    if _PATTERN.fullmatch(need) is None:
        raise BadName(
            f"pattern {_quoted(need)} is not valid; write kind/name with * for a whole name or $* for a part of "
            "a name, as in framegrabber/*, and #2, #3 and so on at the end for a second and third device"
        )
    return need


def of_host(host: str) -> str:
    """Name of all RCs of a host, for maintenance: `@anvil`."""
    return f"@{host}"


def host_in(need: str) -> str | None:
    """`anvil` of `@anvil`; None for other needs."""
    return need[1:] if need.startswith("@") else None


@lru_cache(CACHED_NAMES)
def check_maintained(need: str) -> str:
    """Return an RC, a pattern for all matching RCs, or `@<host>` for all RCs of a host. Raises BadName."""
    if (host := host_in(need)) is None:
        return check_need(need)
    check_name(host, "host")
    return need


@lru_cache(CACHED_NAMES)
def matcher(need: str) -> Callable[[str], bool]:
    """Return a test of RC names against a pattern, with the semantics of Zenoh's key expressions."""
    kind, _, name = need.partition("#")[0].partition("/")

    def matches(rc: str) -> bool:
        rc_kind, _, rc_name = rc.partition("/")
        return _matches(kind, rc_kind) and _matches(name, rc_name)

    return matches


def _matches(pattern: str, name: str) -> bool:
    """Match a single chunk. Not by a regular expression, whose time grows exponentially with many stars."""
    if "/" in name or not name:
        return False
    if pattern == "*" or "*" not in pattern:
        return pattern in ("*", name)
    first, *middle, last = pattern.split("$*")
    if len(name) < len(first) + len(last) or not name.startswith(first) or not name.endswith(last):
        return False
    # Matching each part as far left as possible leaves most room for the rest.
    at, end = len(first), len(name) - len(last)
    for part in middle:
        at = name.find(part, at, end)
        if at < 0:
            return False
        at += len(part)
    return True


def valid_name(text: str) -> str:
    """Turn a text, such as a hostname, into a valid name; "unnamed" if it is empty."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text)[:64] or "unnamed"


RANDOM: Final[ContextVar[random.Random]] = ContextVar("RANDOM", default=random.SystemRandom())  # noqa: B039
"""Source of random names, pauses and lots: the system's, or in a simulation a seeded source for each process."""


def new_instance() -> str:
    """A random name for this run of a process or RC: two owners of the same liveliness key would hide each other."""
    return f"{RANDOM.get().getrandbits(48):012x}"


def incarnation_of(instance: str) -> int:
    """The incarnation in the instance of a component's token: `<incarnation>-<any>`. Raises BadName."""
    number = instance.partition("-")[0]
    if not (number.isascii() and number.isdigit() and len(number) <= MAX_DIGITS and int(number) > 0):
        raise BadName(f"{_quoted(instance)} does not begin with an incarnation")
    return int(number)


class Sender(NamedTuple):
    """A process that sends queries and publications: `<host>/<client>`."""

    host: str
    client: str

    def __str__(self) -> str:
        return f"{self.host}/{self.client}"


class Token(NamedTuple):
    """A liveliness token. `name` is `kind/name` for an RC."""

    host: str
    role: str
    name: str
    instance: str


class Role:
    """The roles of liveliness tokens."""

    NODE = "node"
    CANDIDATE = "candidate"
    RCM = "rcm"
    RC = "rc"
    CLIENT = "client"
    LOAD = "load"
    RECORDER = "recorder"
    COMPONENT = "component"
    SESSION = "session"
    """A Zenoh session of a process: `instance` is its Zenoh id."""


class _Key:
    def __init__(self, suffix: str) -> None:
        self._suffix = suffix

    def __get__(self, keys: Keys, _: object = None) -> str:
        return f"{keys.base}/{self._suffix}"


def _rc_key(suffix: str) -> Callable[[Keys, str], str]:
    return lambda self, rc: f"{self.base}/rc/{check_rc(rc)}/{suffix}"


def _host_key(suffix: str) -> Callable[[Keys, str], str]:
    return lambda self, host: f"{self.base}/host/{check_name(host, 'host')}/{suffix}"


def _sender_key(prefix: str, suffix: str = "") -> Callable[[Keys, Sender], str]:
    def key(self: Keys, sender: Sender) -> str:
        return f"{self.base}/{prefix}/{_sender(sender)}{suffix}"

    return key


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one fleet. Arguments must be valid names; each method checks its own."""

    fleet: str
    closed: bool = False
    """True if the fleet has certificates: then the key of every query contains its sender."""

    everything = _Key("**")
    schedule_any = _Key("rcm/schedule/*/*")
    grants = _Key("rcm/grants")
    rcm_state = _Key("rcm/state")
    rcm_state_any = _Key("rcm/state/*/*")
    rcm_bookings = _Key("rcm/bookings")
    rcm_bookings_any = _Key("rcm/bookings/*/*")
    rc_state_any = _Key("rc/*/*/state")
    frame_any = _Key("rc/*/*/frame")
    load_any = _Key("host/*/load")
    bookings_any = _Key("host/*/bookings")
    rank = _Key("balancer/rank")
    rank_any = _Key("balancer/rank/*/*")
    placements = _Key("placer/placements")
    notice_any = _Key("client/*/*/notice")
    requests_any = _Key("client/*/*/requests")
    behavior_any = _Key("client/*/*/behavior")
    recorded_any = _Key("recorder/*/*/recorded")
    building_plan_any = _Key("building/*/*/plan")
    building_poses_any = _Key("building/*/*/poses")

    schedule = _sender_key("rcm/schedule")
    vote = _rc_key("vote")
    command_any = _rc_key("command/*/*")
    rc_state = _rc_key("state")
    asked_state_any = _rc_key("state/*/*")
    frame = _rc_key("frame")
    load = _host_key("load")
    confirm_any = _host_key("confirm/*/*")
    history_any = _host_key("history/*/*")
    bookings = _host_key("bookings")
    notice = _sender_key("client", "/notice")
    requests = _sender_key("client", "/requests")
    behavior = _sender_key("client", "/behavior")
    recorded = _sender_key("recorder", "/recorded")
    building_plan = _sender_key("building", "/plan")
    building_poses = _sender_key("building", "/poses")

    def __post_init__(self) -> None:
        check_name(self.fleet, "fleet")

    @property
    def base(self) -> str:
        return f"{ROOT}/{self.fleet}"

    def command(self, rc: str, sender: Sender) -> str:
        return f"{self.base}/rc/{check_rc(rc)}/command/{_sender(sender)}"

    def confirm(self, host: str, sender: Sender) -> str:
        return f"{self.base}/host/{check_name(host, 'host')}/confirm/{_sender(sender)}"

    def history(self, host: str, sender: Sender) -> str:
        return f"{self.base}/host/{check_name(host, 'host')}/history/{_sender(sender)}"

    def placer(self, sender: Sender) -> str:
        return self._asked("placer/component", sender)

    def component(self, host: str, sender: Sender) -> str:
        return self._asked(f"host/{check_name(host, 'host')}/component", sender)

    def component_any(self, sender: Sender) -> str:
        return self._asked("host/*/component", sender)

    def _asked(self, key: str, sender: Sender) -> str:
        # Versions before certificates serve only the key without a sender.
        return f"{self.base}/{key}/{_sender(sender)}" if self.closed else f"{self.base}/{key}"

    def ask_state(self, sender: Sender) -> str:
        """Key to query the leader's state; nodes, with their RCs and candidates, use `rcm_state`."""
        return self._asked("rcm/state", sender)

    def ask_rc_state(self, rc: str, sender: Sender) -> str:
        """Key for people to query an RC's state; leaders use `rc_state`, also for a promise."""
        return f"{self.rc_state(rc)}/{_sender(sender)}" if self.closed else self.rc_state(rc)

    def ask_bookings(self, sender: Sender) -> str:
        return self._asked("rcm/bookings", sender)

    def ask_rank(self, sender: Sender) -> str:
        return self._asked("balancer/rank", sender)

    def served_placer(self) -> tuple[str, ...]:
        return self._served("placer/component")

    def served_component(self, host: str) -> tuple[str, ...]:
        return self._served(f"host/{check_name(host, 'host')}/component")

    def _served(self, key: str) -> tuple[str, ...]:
        named = f"{self.base}/{key}/*/*"
        return (named,) if self.closed else (named, f"{self.base}/{key}")

    def alive(self, token: Token) -> str:
        check_name(token.host, "host")
        check_name(token.role, "role")
        check_name(token.instance, "instance")
        name = check_rc(token.name) if token.role == Role.RC else check_name(token.name)
        return f"{self.base}/alive/{token.host}/{token.role}/{name}/{token.instance}"

    def alive_rc(self, rc: str) -> str:
        return f"{self.base}/alive/*/{Role.RC}/{check_rc(rc)}/*"

    def alive_session(self, program: Sender) -> str:
        return f"{self.base}/alive/{program.host}/{Role.SESSION}/{program.client}/*"

    def alive_any(self, role: str = "*") -> str:
        """Tokens of a role; "*": of all roles."""
        return f"{self.base}/alive/*/{role}/**" if role != "*" else f"{self.base}/alive/**"

    # Parsing: each method raises BadName for a key of another form

    def sender_of(self, key: str) -> Sender:
        """The sender of a request or command, or the owner of a client's, recorder's or building's key."""
        return _sender_of(self, key)

    def rc_of(self, key: str) -> str:
        match self._chunks(key):
            case ["rc", kind, name, *_]:
                return check_rc(f"{kind}/{name}")
        raise BadName(f"{_quoted(key)} is not the key of an RC")

    def host_of(self, key: str) -> str:
        match self._chunks(key):
            case ["host", host, *_]:
                return check_name(host, "host")
        raise BadName(f"{_quoted(key)} is not the key of a host")

    def token_of(self, key: str) -> Token:
        match self._chunks(key):
            case ["alive", host, Role.RC, kind, name, instance]:
                token = Token(host, Role.RC, f"{kind}/{name}", instance)
            case ["alive", host, role, name, instance] if role != Role.RC:
                token = Token(host, role, name, instance)
            case _:
                raise BadName(f"{_quoted(key)} is not the key of a liveliness token")
        self.alive(token)
        return token

    def _chunks(self, key: str) -> list[str]:
        if not key.startswith(f"{self.base}/"):
            raise BadName(f"{_quoted(key)} is not a key of fleet {self.fleet}")
        return key[len(self.base) + 1 :].split("/")


@lru_cache(CACHED_NAMES)
def _sender_of(keys: Keys, key: str) -> Sender:
    match keys._chunks(key):
        case (
            ["rcm", "schedule" | "state" | "bookings", host, client]
            | ["balancer", "rank", host, client]
            | ["rc", _, _, "command", host, client]
            | ["client", host, client, "notice" | "requests" | "behavior"]
            | ["building", host, client, "plan" | "poses"]
            | ["recorder", host, client, "recorded"]
            | ["placer", "component", host, client]
            | ["host", _, "component" | "confirm" | "history", host, client]
        ):
            return Sender(check_name(host, "host"), check_name(client, "client"))
    raise BadName(f"{_quoted(key)} does not name its sender")


def client_of(text: str) -> Sender:
    """Parse `<host>/<client>` from a message. Raises BadName."""
    host, _, client = text.partition("/")
    return Sender(check_name(host, "host"), check_name(client, "client"))


def _sender(sender: Sender) -> str:
    return f"{check_name(sender.host, 'host')}/{check_name(sender.client, 'client')}"


# Access: the messages that each role may send on each key. `<host>` in a sender's key is the name of its certificate

Rank: TypeAlias = Literal["viewer", "client", "operator", "node", "manager", "relay"]
"""The role of a name in a fleet. A manager is a node that may lead."""
PEOPLE: Final[frozenset[Rank]] = frozenset({"viewer", "client", "operator"})
MACHINES: Final[frozenset[Rank]] = frozenset({"node", "manager", "relay"})
_ALL: Final[frozenset[Rank]] = frozenset({"viewer", "client", "operator", "node", "manager"})
USERS: Final = _ALL - {"viewer"}
"""Ranks whose programs may hold RCs."""
NODES: Final[frozenset[Rank]] = frozenset({"node", "manager"})
_MANAGERS: Final[frozenset[Rank]] = frozenset({"manager"})
_NO_RANK: Final[frozenset[Rank]] = frozenset()


class Access(NamedTuple):
    """In `key`, `{by}` is the asking name; `{at}` the name that serves, publishes or shows a token; `{rc}` an RC that
    it may serve. In the rules of other names they are `*`."""

    key: str
    ask: frozenset[Rank] = _NO_RANK
    serve: frozenset[Rank] = _NO_RANK
    publish: frozenset[Rank] = _NO_RANK
    subscribe: frozenset[Rank] = _NO_RANK
    show: frozenset[Rank] = _NO_RANK
    """Ranks that may declare a liveliness token."""


ACCESS: Final = (
    Access("rcm/schedule/{by}/*", ask=USERS, serve=_MANAGERS),
    Access("rcm/grants", publish=_MANAGERS, subscribe=_ALL),
    Access("rcm/state", ask=NODES, serve=_MANAGERS),
    Access("rcm/state/{by}/*", ask=_ALL, serve=_MANAGERS),
    Access("rcm/bookings", ask=NODES, serve=_MANAGERS),
    Access("rcm/bookings/{by}/*", ask=_ALL, serve=_MANAGERS),
    Access("rc/{rc}/vote", ask=_MANAGERS, serve=NODES),
    Access("rc/{rc}/command/{by}/*", ask=USERS, serve=NODES),
    # This query can ask for a promise, which only leaders may do.
    Access("rc/{rc}/state", ask=_MANAGERS, serve=NODES, publish=NODES, subscribe=_ALL),
    Access("rc/{rc}/state/{by}/*", ask=_ALL, serve=NODES),
    Access("rc/{rc}/frame", publish=NODES, subscribe=_ALL),
    Access("host/{at}/load", publish=NODES, subscribe=_ALL),
    Access("host/{at}/component/{by}/*", ask=_ALL, serve=NODES),
    Access("host/{at}/confirm/{by}/*", ask=USERS, serve=NODES),
    Access("host/{at}/history/{by}/*", ask=_ALL, serve=_MANAGERS),
    Access("host/{at}/bookings", ask=_MANAGERS, serve=NODES),
    Access("balancer/rank", ask=NODES, serve=_MANAGERS),
    Access("balancer/rank/{by}/*", ask=_ALL, serve=_MANAGERS),
    Access("placer/component/{by}/*", ask=_ALL, serve=_MANAGERS),
    Access("placer/placements", publish=_MANAGERS, subscribe=_ALL),
    Access("client/*/*/notice", publish=_MANAGERS, subscribe=_ALL),
    Access("client/{at}/*/requests", ask=_MANAGERS, serve=USERS),
    Access("client/{at}/*/behavior", publish=USERS, subscribe=_ALL),
    Access("recorder/{at}/*/recorded", ask=_ALL, serve=NODES),
    Access("building/{at}/*/plan", ask=_ALL, serve=USERS),
    Access("building/{at}/*/poses", publish=USERS, subscribe=_ALL),
    *(Access(f"alive/{{at}}/{role}/**", show=_ALL) for role in (Role.CLIENT, Role.RECORDER, Role.SESSION)),
    *(Access(f"alive/{{at}}/{role}/**", show=NODES) for role in (Role.NODE, Role.LOAD, Role.COMPONENT)),
    *(Access(f"alive/{{at}}/{role}/**", show=_MANAGERS) for role in (Role.CANDIDATE, Role.RCM)),
    Access(f"alive/{{at}}/{Role.RC}/{{rc}}/*", show=NODES),
)
"""Every key of the fleet with its ranks. Rights that do not depend on the key alone are checked by the receiver."""

_SENT: Final[dict[str, tuple[str, ...]]] = {
    "ask": ("query",),
    "serve": ("declare_queryable", "reply"),
    "publish": ("put",),
    "show": ("liveliness_token",),
}
_READ: Final = ("liveliness_query", "declare_liveliness_subscriber")
_EVERYTHING: Final = [*(kind for kinds in _SENT.values() for kind in kinds), "delete", "declare_subscriber", *_READ]


class FleetMember(NamedTuple):
    """A machine or person of a fleet, and the RCs, or patterns of RCs, that it may serve."""

    name: str
    ranks: frozenset[Rank]
    rcs: tuple[str, ...] = ()


def access_control(keys: Keys, members: Collection[FleetMember]) -> dict[str, Any]:
    """Zenoh's `access_control`: only members may send, under their certificates' names and as their ranks allow.
    Zenoh's rules have no templates, so each name has its own."""
    out = {"id": "out", "permission": "allow", "flows": ["egress"], "messages": _EVERYTHING}
    read = {"id": "read", "permission": "allow", "flows": ["ingress"], "messages": ["declare_subscriber"]}
    watch = {"id": "watch", "permission": "allow", "flows": ["ingress"], "messages": list(_READ)}
    rules: list[dict[str, Any]] = [
        out | {"key_exprs": [keys.everything]},
        read | {"key_exprs": [f"{keys.base}/{_filled(row.key)}" for row in ACCESS if row.subscribe]},
        watch | {"key_exprs": [f"{keys.base}/alive/**"]},
    ]
    subjects, policies = [], []
    for member in members:
        own = list(_rules(keys, member))
        rules += own
        subjects.append({"id": member.name, "cert_common_names": [member.name]})
        policies.append({"subjects": [member.name], "rules": ["out", "read", "watch", *(rule["id"] for rule in own)]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def _rules(keys: Keys, member: FleetMember) -> Iterable[dict[str, Any]]:
    for act, kinds in _SENT.items():
        if "relay" in member.ranks:
            # Messages from other sites arrive under the name of the relay, which has checked them.
            found = [keys.everything]
        else:
            found = [
                f"{keys.base}/{key}"
                for row in ACCESS
                if getattr(row, act) & member.ranks
                for key in _keys_of(row, member, asks=act == "ask")
            ]
        if found:
            yield {
                "id": f"{member.name} {act}",
                "permission": "allow",
                "flows": ["ingress"],
                "messages": list(kinds),
                "key_exprs": found,
            }


def _keys_of(row: Access, member: FleetMember, *, asks: bool) -> list[str]:
    if asks:
        return [_filled(row.key, by=member.name)]
    rcs = map(as_pattern, member.rcs) if "{rc}" in row.key else ["*/*"]
    return [_filled(row.key, at=member.name, rc=rc) for rc in rcs]


def _filled(key: str, *, by: str = "*", at: str = "*", rc: str = "*/*") -> str:
    return key.format(by=by, at=at, rc=rc)


def as_pattern(text: str) -> str:
    """Translate `*` for any part of a name into a pattern of RCs: `robot/arm*` to `robot/arm$*`."""
    return "/".join(chunk if chunk == "*" else chunk.replace("*", "$*") for chunk in text.split("/"))
