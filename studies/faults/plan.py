"""The faults of a run and their times, drawn from the seed before the run begins, so that faults can be left out."""

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
"""Weights of the kinds in draws."""
DELAYS: Final = frozenset({"freeze", "stall", "cut", "isolate", "part", "disturb", "forget"})
"""Kinds of faults that delay messages or their processing."""
LASTING, SHARES = ((0.5, 1.5), (0.05, 3.0), (3.0, 8.0)), (7, 2, 1)
"""Ranges of seconds and their weights. Durations of about a lease are the worst; few exceed the hold lease."""
JUMPS = (3, 10_000_000, MAX_COUNTER)
"""Distances of a forged term above the fleet's: believed, absurd, and up to the highest possible term."""
LONGER = 1.0
"""Largest addition in seconds to the time for which hosts are apart, so that both sides have a leader."""
HALVES = (4.0, 12.0)
"""Seconds for which halves are apart in runs with bookings: both halves book."""
OUT = (1.0, 8.0)
"""Seconds for which a host is down before it returns with an old disk, or all hosts before they restart."""
MONTH: Final = 30 * 86_400
STEP: Final = 7_200
"""Largest jump of a host's clock in seconds."""
STEPS: Final = (6, 20, STEP, 3 * 86_400)
"""Largest jumps of several hosts' clocks: dates are skipped, or come again."""
HEALED = 45.0
RELINK = 1.0
"""Seconds after which lost links are restored at the latest."""
MESSAGES = ("grants", "rc/state", "rcm/state", "schedule", "notice", "requests", "command", "confirm", "vote", "alive")
"""Kinds of messages that may be disturbed."""
OPERATIONS = ("hand_over", "move", "restore", "activate")
"""Steps of a component's move. The first node that requests such a step, or answers, may be killed just then, so that
its message reaches only the other node."""
UNTIL_ASKED = 5
"""Factor by which a kill waits longer for such a step than for other messages."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault at `at`, for `lasts` seconds."""

    at: float
    lasts: float
    kind: FaultKind
    whom: tuple[str, ...]
    """Processes or hosts. A partition: one side. A cut: source and target. A kill: a process, or several, of
    which the first to send `message` is killed. A double: an RC and a host."""
    both: bool = True
    """A cut: in both directions. A double: it leaves in order. A kill: at once, not at the next `message`."""
    message: str = ""
    """A kind of messages, or for a kill an operation."""
    how: Disturbance = field(default_factory=Disturbance)
    jump: int = 0
    """The jump of a forged term, or of a clock in seconds; or the seconds for which all hosts are down."""

    @property
    def felt(self) -> float:
        """Seconds for which its effects last: until links are restored, or all processes in a contradiction have
        reopened."""
        tokens_lost = self.kind == "disturb" and self.message == "alive" and self.how.lost > 0
        return HEALED if self.kind == "forget" or tokens_lost else RELINK

    def __str__(self) -> str:
        what = {
            "freeze": "is frozen",
            "stall": "processes nothing",
            "kill": "is killed, and restarted" if self.both else f"killed, the first that sends: {self.message}",
            "cut": "cut from each other" if self.both else "the first can't reach the second",
            "isolate": "is cut off",
            "part": "are cut off from all others",
            "disturb": f"disturbed: {self.message} {self.how}",
            "double": "offers it as well",
            "fail": "fails, and works again",
            "forge": f"has a stranger that claims to lead in a term {self.jump} higher",
            "forget": "is cut off, and its links return without some declarations",
            "old disk": "is down, and returns with an early copy of its disk",
            "restart": f"everything is down, and restarted {self.jump / 86_400:g} days later",
            "disk": "can't write to its disk",
            "clock": f"have their clocks set by {self.jump} s",
            "lie": f"has a liar ({self.message}), of terms {self.jump} higher",
            "nodes": f"all but clients are killed, and restarted{' with empty disks' if self.jump else ''}",
        }[self.kind]
        return f"{self.at:7.3f} for {self.lasts:.3f} s: {' '.join(self.whom)} {what}"


def draw(
    seed: int, processes: Sequence[str], hosts: Sequence[str], rcs: Sequence[str], *, count: int, span: float
) -> list[Fault]:
    """`count` faults within `span` seconds, most of them 0.5 to 1.5 s long: about a lease, which is the worst."""
    rng = random.Random(f"faults {seed}")  # noqa: S311 - failures must be repeatable
    # A separate generator: seeds without such faults give the same runs as before these faults were added.
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
                # Prefer nodes: one of them leads, and its faults have the most effects.
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
    """Only kills of nodes in the steps of a component's move."""
    rng = random.Random(f"moves {seed}")  # noqa: S311
    nodes = _nodes(processes)
    return sorted((_at_a_step(rng, nodes, *_when(rng, span)) for _ in range(count)), key=lambda fault: fault.at)


def draw_for_bookings(seed: int, hosts: Sequence[str], span: float, drawn: Sequence[Fault]) -> list[Fault]:
    """The `drawn` faults, and those worst for bookings: halves that both run for a while, faults of disks and
    clocks."""
    rng = random.Random(f"bookings {seed}")  # noqa: S311
    # No old answers on this key: they don't name their question, so they may concern any booking.
    faults = [
        replace(fault, how=replace(fault.how, old=0.0)) if fault.message == "schedule" else fault for fault in drawn
    ]

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
    """The `drawn` faults with lies of members instead of forgeries, and sometimes all nodes killed while clients
    live."""
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
    at = 3.0 + rng.random() * (span - 3.0)
    return at, rng.uniform(*rng.choices(LASTING, SHARES)[0])


def _at_a_step(rng: random.Random, nodes: tuple[str, ...], at: float, lasts: float) -> Fault:
    return Fault(at, UNTIL_ASKED * lasts, "kill", nodes, both=False, message=rng.choice(OPERATIONS))
