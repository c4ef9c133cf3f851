"""Fair shares, measured: a week of two groups, one of which asks in bursts; and cases that show whether a group profits
from asking for more than it needs, or from splitting its requests.

A case is a small fleet, drawn from a seed, whose groups are always at work. Only one group changes how it asks. Its
result is its part of all useful RC-seconds. Because any change alters the luck of a run, one way of asking serves as
control: the group begins a second later.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from random import Random
from typing import Final, NamedTuple

from studies.scheduling.programs import ProgramJob, Use, play
from zscout.config.scheduling_policy import PATIENCE, FairShares, SchedulingPolicy
from zscout.types import SECOND, Ns, RcName

DAY: Final[Ns] = 86_400 * SECOND
HOUR: Final[Ns] = 3_600 * SECOND
DAYS: Final = 7
STEADY, BURSTY = "steady", "bursty"
WEEK_RCS: Final = [f"robot/r{number}" for number in range(10)]
MEAN: Final = 120.0
"""Seconds of an ARC in the week; exponential, 10 s to an hour."""
PROGRAMS: Final = 12
"""Programs of the steady group; their mean pause is half a minute."""
BURST: Final = 20
"""ARCs that the bursty group requests at the same instant."""
BURSTS: Final = 252
"""Bursts in the week, at random times: together a fifth of all RC-seconds."""
EQUAL: Final = 1e15
"""Weights so large that all shares are equal: use is charged, but the order is as without fair shares."""
GAMER: Final = "gamer"
SHORT: Final[Ns] = SECOND // 1_000
RISE: Final = 0.05
"""A part has risen if it grows by more than this part of itself."""


class Week(NamedTuple):
    """A week to play, with fair shares if `fair`."""

    seed: int
    fair: bool


@dataclass(frozen=True, slots=True)
class WeekTrial:
    job: Week
    uses: Mapping[str, Use]

    @property
    def apart(self) -> float:
        """Difference between the charged RC-seconds of the two groups, divided by their mean."""
        steady, bursty = self.uses[STEADY].charged, self.uses[BURSTY].charged
        return abs(steady - bursty) / ((steady + bursty) / 2)


def play_week(job: Week) -> WeekTrial:
    random = Random(f"week/{job.seed}")  # noqa: S311 - workloads, not secrets
    steady = [_endless(Random(random.random()), WEEK_RCS, MEAN, 30.0) for _ in range(PROGRAMS)]  # noqa: S311
    times = [random.randrange(DAYS * DAY // SECOND) * SECOND for _ in range(BURSTS)]
    bursty = [iter([_job(random, WEEK_RCS, MEAN, at)]) for at in times for _ in range(BURST)]
    weights = {} if job.fair else {STEADY: EQUAL, BURSTY: EQUAL}
    # A patience that follows the runtimes would be longer than these waits, so that no request became due.
    policy = SchedulingPolicy(patience=PATIENCE, fair_shares=FairShares(DAY, weights))
    return WeekTrial(job, play(WEEK_RCS, {STEADY: steady, BURSTY: bursty}, policy, DAYS * DAY))


def _job(random: Random, rcs: Sequence[RcName], mean: float, pause: Ns, most: int = 3) -> ProgramJob:
    runtime = max(10, min(3_600, round(random.expovariate(1 / mean)))) * SECOND
    return ProgramJob(pause, tuple(random.sample(rcs, random.randint(1, min(most, len(rcs))))), runtime, runtime)


def _endless(random: Random, rcs: Sequence[RcName], mean: float, pause: float) -> Iterator[ProgramJob]:
    while True:
        yield _job(random, rcs, mean, round(random.expovariate(1 / pause)) * SECOND)


Programs = list[Iterator[ProgramJob]]
Way = Callable[[Sequence[int], Callable[[int], Iterator[ProgramJob]], "SharesCase"], Programs]


@dataclass(frozen=True, slots=True)
class SharesCase:
    """`groups`: the seeds of the programs by group. `factor`: of inflated requests, or pieces of split ones."""

    seed: int
    rcs: tuple[RcName, ...]
    groups: Mapping[str, tuple[int, ...]]
    mean: float
    pause: float
    half_life: Ns
    factor: int
    way: str


def draw_case(seed: int) -> SharesCase:
    random = Random(f"case/{seed}")  # noqa: S311
    groups = {
        name: tuple(random.getrandbits(32) for _ in range(random.randint(1, 5)))
        for name in (GAMER, "other", "third")[: random.randint(2, 3)]
    }
    return SharesCase(
        seed,
        tuple(f"robot/r{number}" for number in range(random.randint(2, 6))),
        groups,
        random.choice((30.0, 60.0, 180.0)),
        random.choice((5.0, 30.0)),
        random.choice((HOUR // 4, HOUR, DAY)),
        random.choice((2, 3, 4)),
        list(WAYS)[seed % len(WAYS)],
    )


def _truthful(seeds: Sequence[int], jobs: Callable[[int], Iterator[ProgramJob]], _case: SharesCase) -> Programs:
    return [jobs(seed) for seed in seeds]


def _later(seeds: Sequence[int], jobs: Callable[[int], Iterator[ProgramJob]], _case: SharesCase) -> Programs:
    def begin(of: Iterator[ProgramJob]) -> Iterator[ProgramJob]:
        yield next(of)._replace(pause=SECOND)
        yield from of

    return [begin(jobs(seed)) for seed in seeds]


def _inflate(seeds: Sequence[int], jobs: Callable[[int], Iterator[ProgramJob]], case: SharesCase) -> Programs:
    return [(job._replace(asked=job.asked * case.factor) for job in jobs(seed)) for seed in seeds]


def _split_time(seeds: Sequence[int], jobs: Callable[[int], Iterator[ProgramJob]], case: SharesCase) -> Programs:
    def pieces(of: Iterable[ProgramJob]) -> Iterator[ProgramJob]:
        for job in of:
            piece = job.used // case.factor
            for number in range(case.factor):
                yield ProgramJob(0 if number else job.pause, job.rcs, piece, piece)

    return [pieces(jobs(seed)) for seed in seeds]


def _split_gang(seeds: Sequence[int], jobs: Callable[[int], Iterator[ProgramJob]], case: SharesCase) -> Programs:
    def part(of: Iterator[ProgramJob], number: int) -> Iterator[ProgramJob]:
        for job in of:
            if number < len(job.rcs):
                yield job._replace(rcs=job.rcs[number : number + 1])

    return [part(jobs(seed), number) for seed in seeds for number in range(min(3, len(case.rcs)))]


def _spoil(seeds: Sequence[int], jobs: Callable[[int], Iterator[ProgramJob]], case: SharesCase) -> Programs:
    everything = (ProgramJob(5 * SECOND, case.rcs, SHORT, SHORT) for _ in count())
    return [*_truthful(seeds, jobs, case), everything]


WAYS: Final[Mapping[str, Way]] = {
    "begins a second later": _later,
    "asks for 2 to 4 times the time": _inflate,
    "splits each ARC in time": _split_time,
    "splits each gang": _split_gang,
    "asks for everything besides": _spoil,
}


@dataclass(frozen=True, slots=True)
class CaseTrial:
    """The gamer's part of useful RC-seconds, if it asks `honest` and if not, with fair shares and without (`off`)."""

    case: SharesCase
    honest: float
    gamed: float
    honest_off: float
    gamed_off: float

    @property
    def rise(self) -> float:
        """Relative growth of the gamer's part with fair shares."""
        return self.gamed / self.honest - 1 if self.honest else 0.0


def play_case(seed: int) -> CaseTrial:
    case = draw_case(seed)
    on = SchedulingPolicy(fair_shares=FairShares(case.half_life))
    parts = [_part(case, way, policy) for policy in (on, SchedulingPolicy()) for way in (_truthful, WAYS[case.way])]
    return CaseTrial(case, *parts)


def _part(case: SharesCase, way: Way, policy: SchedulingPolicy) -> float:
    def jobs(seed: int) -> Iterator[ProgramJob]:
        return _endless(Random(seed), case.rcs, case.mean, case.pause)  # noqa: S311

    groups = {name: (way if name == GAMER else _truthful)(seeds, jobs, case) for name, seeds in case.groups.items()}
    uses = play(case.rcs, groups, policy, HOUR)
    total = sum(use.useful for use in uses.values())
    return uses[GAMER].useful / total if total else 0.0


@dataclass(frozen=True, slots=True)
class WeekReport:
    seed: int
    fair: bool
    apart: float
    uses: Mapping[str, Use]


@dataclass(frozen=True, slots=True)
class Changes:
    """Changes of the gamer's part over all cases. `rose`, `fell`: share of cases with a relative change above `RISE`.
    `beyond`: of cases in which it rose, and to more than an equal part by `RISE`. `mean`: relative change of the sum.
    `greatest`: the largest rise, and the `seed` of its case."""

    rose: float
    beyond: float
    fell: float
    mean: float
    greatest: float
    seed: int

    @classmethod
    def of(cls, found: Sequence[tuple[SharesCase, float, float]]) -> Changes:
        """`found`: each case with its honest and gamed parts."""
        rises = [(gamed / honest - 1 if honest else 0.0, case.seed) for case, honest, gamed in found]
        greatest, seed = max(rises)
        honest = sum(part for _, part, _ in found)
        beyond = [gamed * len(case.groups) > 1 + RISE for case, _, gamed in found]
        return cls(
            sum(rise > RISE for rise, _ in rises) / len(found),
            sum(rise > RISE and far for (rise, _), far in zip(rises, beyond, strict=True)) / len(found),
            sum(rise < -RISE for rise, _ in rises) / len(found),
            sum(gamed for _, _, gamed in found) / honest - 1 if honest else 0.0,
            greatest,
            seed,
        )


@dataclass(frozen=True, slots=True)
class WayReport:
    """All cases of a way of asking, with fair shares and without."""

    way: str
    cases: int
    on: Changes
    off: Changes


@dataclass(frozen=True, slots=True)
class SharesReport:
    weeks: list[WeekReport]
    ways: list[WayReport]
    risen: dict[str, list[int]]
    """Seeds of the cases in which the gamer's part rose with fair shares, by way."""


def report(weeks: Sequence[WeekTrial], cases: Sequence[CaseTrial]) -> SharesReport:
    by_way = {way: found for way in WAYS if (found := [case for case in cases if case.case.way == way])}
    return SharesReport(
        [WeekReport(week.job.seed, week.job.fair, week.apart, week.uses) for week in weeks],
        [
            WayReport(
                way,
                len(found),
                Changes.of([(case.case, case.honest, case.gamed) for case in found]),
                Changes.of([(case.case, case.honest_off, case.gamed_off) for case in found]),
            )
            for way, found in by_way.items()
        ],
        {way: [case.case.seed for case in found if case.rise > RISE] for way, found in by_way.items()},
    )
