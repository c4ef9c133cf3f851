"""Families of random workloads. A seed of a family gives the same workload on every machine.

A stream's load is exact: the requested RC-seconds of exclusive RCs, divided by the available ones until the last
request. Arrivals are those of a Poisson process with a given number of requests.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from random import Random
from typing import Final

from zscout.scheduling.model import ArcRequest
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import Ns, Params, RcName

MILLISECOND: Final[Ns] = 1_000_000
SHORTEST: Final = 0.5
"""Seconds: no ARC runs for less."""
LONGEST: Final = 600.0
RATE: Final = "command_rate"


@dataclass(frozen=True, slots=True)
class Family:
    """`make` draws one workload; `at_once` if all its ARCs ask at time 0."""

    name: str
    summary: str
    make: Callable[[Random], Workload]
    at_once: bool = False

    def workload(self, seed: int) -> Workload:
        # Strings seed by their text, not by their hash, which changes from process to process.
        return self.make(Random(f"{self.name}/{seed}"))  # noqa: S311 - workloads, not secrets


@dataclass(frozen=True, slots=True)
class Mix:
    """The ARCs of a family. `widths` and `priorities` are drawn with equal probability."""

    rcs: int = 10
    arcs: int = 400
    widths: Sequence[int] = (1, 2, 3, 4, 5)
    priorities: Sequence[int] = (1,)
    mean_runtime: float = 5.0
    """Seconds; runtimes are exponential above `SHORTEST`."""
    load: float = 0.65
    burst: int = 1
    """ARCs that ask at the same instant."""
    radios: int = 0
    """Additional sharable RCs; every ARC uses one."""
    operators: float = 0.0
    """Share of operators' ARCs, with priority 10 and one or two RCs."""


def _robots(count: int) -> list[RcName]:
    return [f"robot/r{number}" for number in range(count)]


def _requests(mix: Mix, random: Random) -> list[ArcRequest]:
    robots = _robots(mix.rcs)
    requests = []
    for number in range(mix.arcs):
        operator = random.random() < mix.operators
        width = random.choice((1, 2)) if operator else random.choice(mix.widths)
        needs: dict[RcName, Params] = {rc: {} for rc in random.sample(robots, width)}
        if mix.radios:
            needs[f"radio/rf{random.randrange(mix.radios)}"] = {RATE: Fraction(random.randint(2, 6))}
        priority = 10 if operator else random.choice(mix.priorities)
        seconds = SHORTEST + random.expovariate(1 / (mix.mean_runtime - SHORTEST))
        runtime = round(min(seconds, LONGEST) * 1000) * MILLISECOND
        requests.append(ArcRequest(f"a{number}", "study/client", needs, priority, runtime))
    return requests


def _rcs(mix: Mix) -> tuple[WorkloadRc, ...]:
    radios = (WorkloadRc(f"radio/rf{number}", True, {RATE: Fraction(10)}) for number in range(mix.radios))
    return (*map(WorkloadRc, _robots(mix.rcs)), *radios)


def at_once(mix: Mix, random: Random) -> Workload:
    """All ask at time 0."""
    return Workload(_rcs(mix), tuple(Arrival(0, request) for request in _requests(mix, random)))


def stream(mix: Mix, random: Random) -> Workload:
    """ARCs arrive one after the other, or in bursts, at the mix's load."""
    requests = _requests(mix, random)
    exclusive = set(_robots(mix.rcs))
    work = sum(request.min_runtime * len(exclusive & request.needs.keys()) for request in requests)
    length = int(work / (mix.rcs * mix.load))
    bursts = -(-len(requests) // mix.burst)
    times = sorted(random.randrange(length) // MILLISECOND * MILLISECOND for _ in range(bursts))
    arrivals = (Arrival(times[number // mix.burst], request) for number, request in enumerate(requests))
    return Workload(_rcs(mix), tuple(arrivals))


def wide_among_narrow(random: Random) -> Workload:
    """A few ARCs need 8 of the 10 RCs for a long time; many others need one for a short time."""
    wide = stream(Mix(arcs=10, widths=(8,), mean_runtime=20.0, load=0.2), random)
    narrow = stream(Mix(arcs=640, widths=(1,), mean_runtime=5.0, load=0.4), random)
    # The shorter stream is stretched to the length of the longer.
    ends = [part.arrivals[-1].at for part in (wide, narrow)]
    arrivals = [
        Arrival(arrival.at * max(ends) // end // MILLISECOND * MILLISECOND, _renamed(arrival.request, prefix))
        for part, end, prefix in zip((wide, narrow), ends, "wn", strict=True)
        for arrival in part.arrivals
    ]
    return Workload(wide.rcs, tuple(sorted(arrivals, key=lambda arrival: arrival.at)))


def _renamed(request: ArcRequest, prefix: str) -> ArcRequest:
    return ArcRequest(prefix + request.arc, request.client, request.needs, request.priority, request.min_runtime)


def _family(name: str, summary: str, mix: Mix, *, together: bool = False) -> Family:
    make = at_once if together else stream
    return Family(name, summary, lambda random: make(mix, random), at_once=together)


_ALL: Final = (
    _family("paper", "10 RCs, 20 ARCs of 1 to 5 RCs, all at once", Mix(arcs=20), together=True),
    _family("larger", "30 RCs, 60 ARCs of 1 to 5 RCs, all at once", Mix(rcs=30, arcs=60), together=True),
    _family("calm", "10 RCs, ARCs of 1 to 5, load 25 %", Mix(load=0.25)),
    _family("load65", "10 RCs, ARCs of 1 to 5, load 65 %", Mix()),
    _family("overload", "10 RCs, ARCs of 1 to 5, load 120 %", Mix(arcs=200, load=1.2)),
    _family("narrow", "10 RCs, ARCs of 1 or 2, load 80 %", Mix(widths=(1, 2), load=0.8)),
    Family("wide", "10 RCs, 10 long ARCs of 8 among 640 short ones of 1, load about 60 %", wide_among_narrow),
    _family("levels", "10 RCs, ARCs of 1 to 5, 5 priorities, load 65 %", Mix(priorities=(1, 2, 3, 4, 5))),
    _family(
        "operators",
        "10 RCs, ARCs of 1 to 5, 2 priorities, 5 % operators, load 65 %",
        Mix(priorities=(1, 2), operators=0.05),
    ),
    _family(
        "radios",
        "10 RCs and 3 sharable radios, ARCs of 1 to 4 and a radio, 3 priorities, load 50 %",
        Mix(widths=(1, 2, 3, 4), priorities=(1, 2, 3), radios=3, load=0.5),
    ),
    _family("bursts", "10 RCs, ARCs of 1 to 5, 10 at a time, load 65 %", Mix(burst=10)),
)

FAMILIES: Final[Mapping[str, Family]] = {family.name: family for family in _ALL}
