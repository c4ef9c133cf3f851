"""What goes wrong in a run, and when: drawn from the seed before the run begins, so that a fault can be left out."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final, Literal, TypeAlias

from studies.faults.liars import LIES
from zscout.messages import MAX_COUNTER
from zscout.testing.link import Disturbance

FaultKind: TypeAlias = Literal[
    "freeze",
    "stall",
    "kill",
    "cut",
    "isolate",
    "part",
    "disturb",
    "forget",
    "double",
    "fail",
    "forge",
    "old disk",
    "restart",
    "disk",
    "clock",
    "lie",
    "nodes",
]

KINDS: Mapping[FaultKind, int] = MappingProxyType(
    {
        "freeze": 3,
        "stall": 3,
        "kill": 2,
        "cut": 2,
        "isolate": 2,
        "part": 2,
        "disturb": 3,
        "double": 1,
        "forget": 1,
        "fail": 1,
        "forge": 1,
    }
)
"""And how often each is drawn."""
DELAYS: Final = frozenset({"freeze", "stall", "cut", "isolate", "part", "disturb", "forget"})
"""Those by which messages are late, or heard late."""
LASTING, SHARES = ((0.5, 1.5), (0.05, 3.0), (3.0, 8.0)), (7, 2, 1)
"""Seconds, and how often: about a lease is the worst there is; longer than the hold lease is seldom."""
JUMPS = (3, 10_000_000, MAX_COUNTER)
"""How far a forged term is above the fleet's: it is believed; it is absurd; it is the last there is, at most."""
LONGER = 1.0
"""Seconds for which hosts are apart besides, at most: so that both sides have a leader."""
HALVES = (4.0, 12.0)
"""The same where programs book: both book for some time."""
OUT = (1.0, 8.0)
"""Seconds for which a host is out that comes back with an old disk, or all are that are started anew."""
MONTH: Final = 30 * 86_400
STEP: Final = 7_200
"""Seconds by which a host's clock is set at once, at most."""
STEPS: Final = (6, 20, STEP, 3 * 86_400)
"""The same where those of several hosts are set: dates are skipped, or come again."""
HEALED = 45.0
RELINK = 1.0
"""Seconds after which links that were lost stand again, at most."""
MESSAGES = ("grants", "rc/state", "rcm/state", "schedule", "notice", "requests", "command", "confirm", "vote", "alive")
"""Kinds of messages that may be disturbed."""
OPERATIONS = ("hand_over", "move", "restore", "activate")
"""Steps of a component's move: the first node that asks for one of them, or answers, may be killed as it does, and
nobody but the other hears what it has just said."""
UNTIL_ASKED = 5
"""How many times longer than others a kill waits for one of them."""


@dataclass(frozen=True, slots=True)
class Fault:
    """From `at` on, for `lasts` seconds."""

    at: float
    lasts: float
    kind: FaultKind
    whom: tuple[str, ...]
    """Processes or hosts; of a partition one side of it; of a cut from whom and to whom; of a kill one or
    the first of several to say something; an RC, and a host."""
    both: bool = True
    """Of a cut: in both directions. Of a double: it leaves in order. Of a kill: at once, not at the next `message`."""
    message: str = ""
    """A kind of messages, or of a kill an operation."""
    how: Disturbance = field(default_factory=Disturbance)
    jump: int = 0
    """Of a forged term; in seconds, of a clock that is set, or for how long nothing ran by the clocks of hosts."""

    @property
    def felt(self) -> float:
        """Seconds for which it goes on when it is over: until links stand again, or every process that it left in
        contradiction has joined anew."""
        tokens_lost = self.kind == "disturb" and self.message == "alive" and self.how.lost > 0
        return HEALED if self.kind == "forget" or tokens_lost else RELINK

    def __str__(self) -> str:
        what = {
            "freeze": "stands still",
            "stall": "does not come round to anything",
            "kill": "is killed, and started again" if self.both else f"killed, the first that sends: {self.message}",
            "cut": "cut from one another" if self.both else "the first can't reach the second",
            "isolate": "is cut off",
            "part": "are cut off from all others",
            "disturb": f"disturbed: {self.message} {self.how}",
            "double": "offers it as well",
            "fail": "fails, and works again",
            "forge": f"has a stranger that says to lead in a term {self.jump} higher",
            "forget": "is cut off, and its links come back without all that was declared",
            "old disk": "is out, and comes back with what its disk had early in the run",
            "restart": f"everything is out, and started anew {self.jump / 86_400:g} days later",
            "disk": "can't write to its disk",
            "clock": f"have their clocks set by {self.jump} s",
            "lie": f"has a liar ({self.message}), of terms {self.jump} higher",
            "nodes": f"all but clients is killed, and started again{' with empty disks' if self.jump else ''}",
        }[self.kind]
        return f"{self.at:7.3f} for {self.lasts:.3f} s: {' '.join(self.whom)} {what}"


def draw(
    seed: int, processes: Sequence[str], hosts: Sequence[str], rcs: Sequence[str], *, count: int, span: float
) -> list[Fault]:
    """`count` faults within `span` seconds, most of them 0.5 to 1.5 s long: about a lease, the worst there is."""
    rng = random.Random(f"faults {seed}")  # noqa: S311 - what failed once must fail again
    # One of its own: a seed that has no such fault is what it was before there were any.
    steps = random.Random(f"operations {seed}")  # noqa: S311
    nodes = _nodes(processes)
    faults = []
    for _ in range(count):
        at, lasts = _when(rng, span)
        kind = rng.choices(tuple(KINDS), tuple(KINDS.values()))[0]
        whom: tuple[str, ...] = ()
        apart = lasts + LONGER * rng.random()
        match kind:
            case "freeze" | "stall" | "kill":
                # One of them leads, and that is felt most.
                whom = (rng.choice(nodes if rng.random() < 0.5 else processes),)
            case "cut":
                whom = tuple(rng.sample(hosts, 2))
            case "forge":
                whom = (rng.choice(hosts),)
            case "isolate":
                whom, lasts = (rng.choice(hosts),), apart
            case "forget":
                whom, lasts = (rng.choice(hosts),), LONGER + lasts
            case "fail":
                whom = (rng.choice(rcs),)
            case "double":
                whom, lasts = (rng.choice(rcs), rng.choice(hosts)), 5 * lasts
            case "part":
                whom, lasts = tuple(sorted(rng.sample(hosts, rng.randrange(1, len(hosts))))), apart
        how = Disturbance()
        if kind == "disturb":
            lasts *= 3
            how = Disturbance(
                lost=rng.choice((0, 0, 0.1, 0.5, 1.0)),
                twice=rng.choice((0, 0.3)),
                late=rng.choice((0, 0.3)),
                by=rng.choice((0.05, 0.5, 2.0)),
                old=rng.choice((0, 0, 0.2)),
            )
        both, message, jump = rng.random() < 0.7, rng.choice(MESSAGES), rng.choice(JUMPS)
        if kind == "kill" and not both and steps.random() < 0.5:
            faults.append(_at_a_step(steps, nodes, at, lasts))
        else:
            faults.append(Fault(at, lasts, kind, whom, both, message, how, jump))
    return sorted(faults, key=lambda fault: fault.at)


def draw_moves(seed: int, processes: Sequence[str], *, count: int, span: float) -> list[Fault]:
    """Nothing but nodes that are killed in the steps of a component's move."""
    rng = random.Random(f"moves {seed}")  # noqa: S311
    nodes = _nodes(processes)
    return sorted((_at_a_step(rng, nodes, *_when(rng, span)) for _ in range(count)), key=lambda fault: fault.at)


def draw_for_bookings(seed: int, hosts: Sequence[str], span: float, drawn: Sequence[Fault]) -> list[Fault]:
    """The faults that were `drawn`, and what endangers bookings most: halves that both go on for some time, and what
    becomes of disks and clocks."""
    rng = random.Random(f"bookings {seed}")  # noqa: S311
    # An answer on this key may be of any booking, and says nothing of what was asked.
    faults = [replace(one, how=replace(one.how, old=0.0)) if one.message == "schedule" else one for one in drawn]

    def add(kind: FaultKind, whom: Sequence[str], lasts: float, jump: int = 0, after: float = 3.0) -> None:
        faults.append(Fault(rng.uniform(after, span), lasts, kind, tuple(sorted(whom)), jump=jump))

    if rng.random() < 0.6:
        add("part", rng.sample(hosts, rng.randrange(1, len(hosts))), rng.uniform(*HALVES))
    if rng.random() < 0.4:
        add("old disk", [rng.choice(hosts)], rng.uniform(*OUT), after=span / 2)
    if rng.random() < 0.25:
        add("restart", [], rng.uniform(*OUT), rng.choice((0, MONTH)), after=span / 3)
    if rng.random() < 0.5:
        add("disk", rng.sample(hosts, rng.choice((1, len(hosts)))), rng.uniform(2, span / 2))
    if rng.random() < 0.3:
        add("clock", [rng.choice(hosts)], 0.0, rng.randrange(-STEP, STEP))
    if rng.random() < 0.5:
        step = rng.choice(STEPS)
        add("clock", rng.sample(hosts, rng.randrange(2, len(hosts) + 1)), 0.0, rng.randint(-step, step))
    return sorted(faults, key=lambda fault: fault.at)


def draw_lies(seed: int, hosts: Sequence[str], span: float, drawn: Sequence[Fault]) -> list[Fault]:
    """The faults that were `drawn`, with lies of members in place of a stranger's forgeries, and all nodes that are
    killed while clients live."""
    rng = random.Random(f"lies {seed}")  # noqa: S311
    faults = [fault for fault in drawn if fault.kind != "forge"]
    for kind in ("client", "rc", *rng.choices(LIES, k=2)):
        at, lasts = _when(rng, span)
        jump = 1 if kind == "promised" else rng.choice(JUMPS)
        faults.append(Fault(at, 2 * lasts, "lie", (rng.choice(hosts),), message=kind, jump=jump))
    if rng.random() < 0.5:
        at, _ = _when(rng, span)
        faults.append(Fault(at, rng.uniform(*OUT), "nodes", (), jump=rng.random() < 0.5))
    return sorted(faults, key=lambda fault: fault.at)


def _nodes(processes: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in processes if name.endswith("/node"))


def _when(rng: random.Random, span: float) -> tuple[float, float]:
    """When it begins, and for how long it lasts."""
    at = 3.0 + rng.random() * (span - 3.0)
    return at, rng.uniform(*rng.choices(LASTING, SHARES)[0])


def _at_a_step(rng: random.Random, nodes: tuple[str, ...], at: float, lasts: float) -> Fault:
    return Fault(at, UNTIL_ASKED * lasts, "kill", nodes, both=False, message=rng.choice(OPERATIONS))
