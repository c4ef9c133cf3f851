"""Faults, drawn from a seed: their kind, hosts and duration."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from studies.chaos.work import CLIENTS, HOSTS, NODES, OWN_CLIENTS, RC_HOSTS

SECOND: Final = 1_000_000_000
LEASE: Final = 1.0
Way = tuple[str, str]


@dataclass(slots=True)
class Fault:
    """Times in ns; 0 if it has not happened."""

    kind: str
    how: str
    """kill, freeze, cut, cable or address."""
    lasts: float
    hosts: tuple[str, ...] = ()
    """The hosts that are killed, frozen, unplugged or without an address."""
    ways: frozenset[Way] = frozenset()
    began: int = 0
    at: int = 0
    """When it was complete, a little after `began`."""
    mended: int = 0
    alone: bool = True
    """True if all clients were served before it, and no other fault came until all were served again."""
    term: int = 0
    """The counter of the term before it."""
    granted: int = 0
    """The first grant of a request that was made after it."""
    linked: int = 0
    """When the last link or token was back."""
    served: int = 0

    @property
    def touched(self) -> tuple[str, ...]:
        """The hosts that it affects. If a host is cut off, the others do not count."""
        if not self.ways:
            return self.hosts
        return self.hosts or tuple(sorted({host for way in self.ways for host in way}))

    def over(self, after: int) -> int:
        """When it has no effect any more: all clients were served, or `after` ns have passed."""
        if not self.mended:
            return 1 << 62
        return self.served if self.served and after else self.mended + after


def isolated(host: str) -> frozenset[Way]:
    return frozenset(pair for other in HOSTS if other != host for pair in ((host, other), (other, host)))


def groups(rng: random.Random) -> frozenset[Way]:
    """Two or three parts of the fleet without links between them."""
    parts = {host: rng.randrange(rng.choice((2, 2, 3))) for host in HOSTS}
    return frozenset((a, b) for a in HOSTS for b in HOSTS if parts[a] != parts[b])


def _lasts(rng: random.Random) -> float:
    """Mostly about a lease."""
    low, high = rng.choice(((0.5, 1.5), (0.5, 1.5), (0.5, 1.5), (1.5, 3.0), (3.0, 6.0)))
    return LEASE * rng.uniform(low, high)


def _leader(how: str, low: float, high: float) -> Callable[[random.Random, str], Fault]:
    def make(rng: random.Random, leader: str) -> Fault:
        ways = isolated(leader) if how == "cut" else frozenset()
        return Fault("", how, rng.uniform(low, high), (leader,), ways)

    return make


def _any(how: str, *hosts: str) -> Callable[[random.Random, str], Fault]:
    def make(rng: random.Random, _leader: str) -> Fault:
        host = rng.choice(hosts)
        return Fault("", how, _lasts(rng), (host,), isolated(host) if how == "cut" else frozenset())

    return make


def _away(rng: random.Random, leader: str) -> Fault:
    return _leader(rng.choice(("freeze", "cut")), 0.6, 1.0)(rng, leader)


def _ways(draw: Callable[[random.Random], frozenset[Way]]) -> Callable[[random.Random, str], Fault]:
    return lambda rng, _leader: Fault("", "cut", _lasts(rng), (), draw(rng))


def _pair(rng: random.Random) -> frozenset[Way]:
    a, b = rng.choice(NODES + RC_HOSTS), rng.choice(HOSTS)
    return _pair(rng) if a == b else frozenset(((a, b), (b, a)))


def _one_way(rng: random.Random) -> frozenset[Way]:
    return frozenset((rng.choice(sorted(_pair(rng))),))


def _two_frozen(rng: random.Random, _leader: str) -> Fault:
    """Both hosts of a link are frozen: neither closes it, and each finds it as before."""
    first = rng.choice(NODES)
    return Fault("", "freeze", rng.uniform(1.0, 3.5), (first, rng.choice([host for host in HOSTS if host != first])))


def _blackout(rng: random.Random, _leader: str) -> Fault:
    return Fault("", "kill", rng.uniform(0.0, 3.0), NODES)


KINDS: Final[dict[str, tuple[int, Callable[[random.Random, str], Fault]]]] = {
    "leader killed": (4, _leader("kill", 1.0, 2.0)),
    "leader frozen": (3, _leader("freeze", 1.3, 3.0)),
    "leader cut": (3, _leader("cut", 1.3, 3.0)),
    "leader away": (6, _away),
    "killed": (3, _any("kill", *HOSTS)),
    "frozen": (4, _any("freeze", *HOSTS)),
    "two frozen": (2, _two_frozen),
    "cut": (4, _any("cut", *HOSTS)),
    "unplugged": (2, _any("cable", *HOSTS)),
    "readdressed": (2, _any("address", *NODES, *OWN_CLIENTS)),
    "partition": (4, _ways(groups)),
    "pair": (5, _ways(_pair)),
    "one way": (3, _ways(_one_way)),
    "blackout": (1, _blackout),
    "client killed": (1, _any("kill", *CLIENTS)),
}
"""The share of each kind, and its function, which draws a fault from a random source and the leader's host.
`readdressed` takes addresses of hosts with programs of zscout only: the protocol does not require others to follow."""


def draw(rng: random.Random, kinds: list[str], leader: str) -> Fault:
    kind = kinds[0] if len(kinds) == 1 else rng.choices(kinds, [KINDS[kind][0] for kind in kinds])[0]
    fault = KINDS[kind][1](rng, leader)
    fault.kind = kind
    return fault
