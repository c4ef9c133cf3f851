"""`python -m benchmarks.scale`: cost of an event in the scheduling core, by the size of the queue.

Nine of ten RCs are exclusive; the tenth shares 4 units among ARCs of 1 or 2 units, and its votes arrive at once. An ARC
needs 1 to 4 RCs, at one of four priorities. ARCs that leave the queue are replaced, so that its size is constant. With
`--bookings N`, N bookings are made first, each of 1 to 4 RCs for one hour of the next week, at one of the priorities;
no two share an RC and an hour.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from random import Random

from benchmarks.stats import Samples
from zscout.config.scheduling_policy import DEFAULT, FairShares, SchedulingPolicy, StrategyName
from zscout.scheduling.booking import Booked, Booking
from zscout.scheduling.capacity import excess
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    ArcRequest,
    Effect,
    Event,
    Granted,
    HoldEnded,
    Propose,
    RcJoined,
    Released,
    Requested,
    Tick,
    Vote,
    WakeAt,
)
from zscout.scheduling.priority import Priority
from zscout.scheduling.state import Actions, SchedulerState
from zscout.scheduling.strategies import STRATEGIES
from zscout.types import SECOND, ArcId, Ns, Params

QUEUES = (10, 100, 1_000, 10_000)
RCS = (10, 100, 1_000)
CAPACITY = {"rate": Fraction(4)}
HOUR: Ns = 3_600 * SECOND
HOURS = 7 * 24
KINDS = ("request", "release", "end of hold", "vote", "search", "full pass", "fill")
MEANING = {
    "request": "one more ARC",
    "release": "a holder gives back its RCs, and waiting ARCs get them",
    "end of hold": "a minimum runtime is over, and waiting ARCs get the RCs",
    "vote": "a vote arrives",
    "search": "one slice of a longer search",
    "full pass": "a pass over all RCs as if freed, without effect",
    "fill": "the whole queue is requested at once, as after a takeover",
}
AIMS = {"request": 200e-6, "release": 200e-6, "end of hold": 200e-6, "full pass": 10e-3}
"""Medians, in seconds, at the largest size."""
BAR = 40


@dataclass(frozen=True)
class Point:
    """Costs, in seconds, of one kind of event at one size."""

    kind: str
    rcs: int
    queue: int
    samples: Samples


class _FullPriority(Priority):
    """The strategy `priority`, with all RCs considered freed before each pass."""

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        state.index.freed = state.mask(state.rcs)
        super().run_pass(state, actions)


class Fleet:
    """A core with a queue of constant size."""

    def __init__(
        self, rcs: int, queue: int, seed: int, strategy: StrategyName, bookings: int, policy: SchedulingPolicy
    ) -> None:
        self.rng, self.queue = Random(seed), queue  # noqa: S311
        self.core, self.now, self.number = Core(STRATEGIES[strategy](), policy), 0, 0
        self.ends: dict[ArcId, Ns] = {}
        """End of each running hold. Calls of `Core.status` would leave cold caches for the timed calls."""
        self.sharable = {f"device/{number}": number % 10 == 0 for number in range(rcs)}
        self.names = list(self.sharable)
        self.samples = {kind: Samples() for kind in KINDS}
        self.core.handle(0, *[RcJoined(name, sharable) for name, sharable in self.sharable.items()])
        self.booked: set[tuple[str, int]] = set()
        self.core.handle(0, *[Booked(self.booking(number)) for number in range(bookings)])
        self.send("fill", *[self.ask() for _ in range(queue)])

    def needs(self) -> dict[str, Params]:
        rng = self.rng
        return {
            name: {"rate": Fraction(rng.randint(1, 2))} if self.sharable[name] else {}
            for name in rng.sample(self.names, rng.randint(1, 4))
        }

    def booking(self, number: int) -> Booking:
        while True:
            needs, hour = self.needs(), self.rng.randrange(1, HOURS)
            if not any((rc, hour) in self.booked for rc in needs):
                break
        self.booked.update((rc, hour) for rc in needs)
        return Booking(f"b{number}", needs, self.rng.randrange(4), hour * HOUR, HOUR, HOUR // 6, 0)

    def ask(self) -> Event:
        rng, self.number = self.rng, self.number + 1
        runtime = rng.randint(10 * SECOND, 100 * SECOND)
        arc, client = f"a{self.number}", f"h{self.number % 20}/c"
        return Requested(ArcRequest(arc, client, self.needs(), rng.randrange(4), runtime))

    def send(self, kind: str, *events: Event) -> None:
        """Time the events of one instant, then each vote and each further pass that follows."""
        effects = self._timed(kind, *events)
        votes = list(self._votes(effects))
        while votes or any(isinstance(effect, WakeAt) and effect.at == self.now for effect in effects):
            effects = self._timed("vote", votes.pop()) if votes else self._timed("search", Tick())
            votes += self._votes(effects)

    def _timed(self, kind: str, *events: Event) -> list[Effect]:
        start = time.thread_time()
        effects = self.core.handle(self.now, *events)
        self.samples[kind].add(time.thread_time() - start)
        for effect in effects:
            match effect:
                case Granted(arc=arc, end=end) if end is not None:
                    self.ends[arc] = end
                case HoldEnded(arc=arc):
                    del self.ends[arc]
                case _:
                    pass
        return effects

    def _votes(self, effects: list[Effect]) -> Iterator[Event]:
        for effect in effects:
            if isinstance(effect, Propose):
                reason = excess(CAPACITY, effect.holders.items())
                yield Vote(effect.proposal, accept=not reason, reason=reason)

    def fill_up(self) -> None:
        while self.core.waiting < self.queue:
            self.send("request", self.ask())

    def rounds(self, count: int) -> None:
        for _ in range(count):
            self.fill_up()
            self.now += 1
            self.send("release", Released(self.rng.choice(list(self.ends))))
            self.fill_up()
            self.now = min(self.ends.values())
            self.send("end of hold", Tick())
        self.fill_up()

    def full_passes(self, count: int) -> None:
        self.core.strategy = _FullPriority()
        for _ in range(count):
            self._timed("full pass", Tick())


def measure(
    rcs: int,
    queue: int,
    rounds: int,
    seed: int,
    strategy: StrategyName,
    bookings: int = 0,
    policy: SchedulingPolicy = DEFAULT,
) -> list[Point]:
    fleet = Fleet(rcs, queue, seed, strategy, bookings, policy)
    fleet.rounds(rounds)
    if strategy == "priority":
        fleet.full_passes(max(3, rounds // 20))
    return [Point(kind, rcs, queue, samples) for kind, samples in fleet.samples.items() if samples.values]


def table(points: list[Point]) -> str:
    lines = [f"{'event':<12}{'RCs':>6}{'queued':>8}{'median':>12}{'p99':>12}{'samples':>9}"]
    for kind in KINDS:
        for point in (point for point in points if point.kind == kind):
            samples = point.samples
            lines.append(
                f"{kind:<12}{point.rcs:>6}{point.queue:>8}{_span(samples.median):>12}"
                f"{_span(samples.p99):>12}{len(samples.values):>9}"
            )
    return "\n".join(lines)


def plot(points: list[Point], rcs: int) -> str:
    """Draw the median cost by the size of the queue, on a logarithmic axis."""
    low, high = 1e-6, 1.0
    lines = [f"median cost with {rcs} RCs, from {_span(low)} at the left to {_span(high)} at the right"]
    for kind in KINDS:
        for point in (point for point in points if point.kind == kind and point.rcs == rcs):
            share = math.log(max(point.samples.median, low) / low) / math.log(high / low)
            bar = "#" * round(BAR * min(1.0, share))
            lines.append(f"{kind:>12} {point.queue:>6} |{bar:<{BAR}}| {_span(point.samples.median)}")
    return "\n".join(lines)


def _million_additions() -> float:
    """Measure the speed of this interpreter: seconds for a million additions."""
    start = time.thread_time()
    sum(number + 1 for number in range(1_000_000))
    return time.thread_time() - start


def _span(seconds: float) -> str:
    for unit, factor in (("s", 1.0), ("ms", 1e3)):
        if seconds * factor >= 1:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--rounds", type=int, default=300, help="releases per size (default: 300)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the random requests (default: 1)")
    parser.add_argument("--strategy", choices=("priority", "adaptive"), default="adaptive")
    parser.add_argument("--bookings", type=int, default=0, help="number of open bookings (default: 0)")
    parser.add_argument("--rcs", type=int, choices=RCS, help="measure only fleets with this number of RCs")
    parser.add_argument("--fair-shares", action="store_true", help="fair shares for 20 hosts")
    args = parser.parse_args()
    policy = SchedulingPolicy(fair_shares=FairShares(86_400 * SECOND)) if args.fair_shares else DEFAULT
    if not 10 <= args.rounds <= 100_000:
        parser.error(f"--rounds is {args.rounds}; give 10 to 100000")
    if not 0 <= args.bookings <= 10 * (args.rcs or RCS[0]):
        parser.error(f"--bookings is {args.bookings}; give 0 to ten times as many as there are RCs")
    sizes = [(rcs, queue) for rcs in RCS if args.rcs in (None, rcs) for queue in QUEUES]
    speed = _million_additions()
    points = [
        point
        for rcs, queue in sizes
        for point in measure(rcs, queue, args.rounds, args.seed, args.strategy, args.bookings, policy)
    ]
    largest = {point.kind: point for point in points if (point.rcs, point.queue) == (RCS[-1], QUEUES[-1])}
    met = {kind: largest[kind].samples.median <= aim for kind, aim in AIMS.items() if kind in largest}
    if args.json:
        rows = [
            {
                "event": point.kind,
                "rcs": point.rcs,
                "queued": point.queue,
                "median_s": point.samples.median,
                "p99_s": point.samples.p99,
                "samples": len(point.samples.values),
            }
            for point in points
        ]
        machine = {"cores": os.cpu_count(), "python": platform.python_version(), "million_additions_s": speed}
        print(json.dumps({"machine": machine, "rows": rows, "aims_met": met}, indent=2))
        return
    print(table(points), *(plot(points, rcs) for rcs in dict.fromkeys(rcs for rcs, _ in sizes)), sep="\n\n")
    print()
    for kind, meaning in MEANING.items():
        aim = f"; aim {_span(AIMS[kind])}: {'met' if met[kind] else 'missed'}" if kind in met else ""
        print(f"{kind}: {meaning}{aim}")
    print(f"\n{os.cpu_count()} cores, Python {platform.python_version()}, load {os.getloadavg()[0]:.1f};")
    print(f"a million additions take {_span(speed)} here. All times are of the processor, not of the clock.")


if __name__ == "__main__":
    main()
