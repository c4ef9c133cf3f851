"""Fair shares by measurement: a week of two groups one of which comes in bursts, and whether it is of use to a group to
ask for more than it needs, or for less at a time.

A case of the second is a small fleet, drawn from a seed, whose groups are always at work; in it one group changes how
it asks, and nothing else is changed. What counts is its part of all RC-seconds of use. As any change changes the luck
of a run, one way is none: the group begins a second later.
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
"""Of the steady group; each pauses for half a minute in the mean."""
BURST: Final = 20
"""ARCs that the bursty group asks for at one instant,"""
BURSTS: Final = 252
"""so often in the week, whenever it is: a fifth of all RC-seconds there are."""
EQUAL: Final = 1e15
"""Weights so great that all shares are equal: charged is what would be, and the order is that without fair shares."""
GAMER: Final = "gamer"
SHORT: Final[Ns] = SECOND // 1_000
RISE: Final = 0.05
"""A part that grows by more than this part of itself has risen."""


class Week(NamedTuple):
    """What to play: `fair` None without fair shares."""

    seed: int
    fair: bool


@dataclass(frozen=True, slots=True)
class WeekTrial:
    job: Week
    uses: Mapping[str, Use]

    @property
    def apart(self) -> float:
        """How far the charged RC-seconds of the two are apart, as a part of their mean."""
        steady, bursty = self.uses[STEADY].charged, self.uses[BURSTY].charged
        return abs(steady - bursty) / ((steady + bursty) / 2)


def play_week(job: Week) -> WeekTrial:
    random = Random(f"week/{job.seed}")  # noqa: S311 - workloads, not secrets
    steady = [_endless(Random(random.random()), WEEK_RCS, MEAN, 30.0) for _ in range(PROGRAMS)]  # noqa: S311
    times = [random.randrange(DAYS * DAY // SECOND) * SECOND for _ in range(BURSTS)]
    bursty = [iter([_job(random, WEEK_RCS, MEAN, at)]) for at in times for _ in range(BURST)]
    weights = {} if job.fair else {STEADY: EQUAL, BURSTY: EQUAL}
    # A patience that follows the runtimes is longer than these waits: then nobody is due.
    policy = SchedulingPolicy(patience=PATIENCE, fair_shares=FairShares(DAY, weights))
    return WeekTrial(job, play(WEEK_RCS, {STEADY: steady, BURSTY: bursty}, policy, DAYS * DAY))


def _job(random: Random, rcs: Sequence[RcName], mean: float, pause: Ns, most: int = 3) -> ProgramJob:
    runtime = max(10, min(3_600, round(random.expovariate(1 / mean)))) * SECOND
    return ProgramJob(pause, tuple(random.sample(rcs, random.randint(1, min(most, len(rcs))))), runtime, runtime)


def _endless(random: Random, rcs: Sequence[RcName], mean: float, pause: float) -> Iterator[ProgramJob]:
    while True:
        yield _job(random, rcs, mean, round(random.expovariate(1 / pause)) * SECOND)


# Whether it is of use to ask otherwise than one needs

Programs = list[Iterator[ProgramJob]]
Way = Callable[[Sequence[int], Callable[[int], Iterator[ProgramJob]], "SharesCase"], Programs]


@dataclass(frozen=True, slots=True)
class SharesCase:
    """A fleet and its groups: by group the seeds of its programs. `factor`: by how much is asked for more, or in how
    many pieces."""

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
    """The gamer's part of all RC-seconds of use, if it asks for what it needs, and if not; with fair shares and
    without."""

    case: SharesCase
    honest: float
    gamed: float
    honest_off: float
    gamed_off: float

    @property
    def rise(self) -> float:
        """By which part of itself its part grows with fair shares."""
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


# What came of it


@dataclass(frozen=True, slots=True)
class WeekReport:
    seed: int
    fair: bool
    apart: float
    uses: Mapping[str, Use]


@dataclass(frozen=True, slots=True)
class Changes:
    """In which part of the cases the gamer's part rose and fell by more than `RISE` of itself, and in which it rose to
    more than that beyond an equal part; by how much it changed in all; and the greatest rise, with its case."""

    rose: float
    beyond: float
    fell: float
    mean: float
    greatest: float
    seed: int

    @classmethod
    def of(cls, found: Sequence[tuple[SharesCase, float, float]]) -> Changes:
        """From the parts honest and gamed."""
        rises = [(gamed / honest - 1 if honest else 0.0, case.seed) for case, honest, gamed in found]
        greatest, seed = max(rises)
        honest = sum(one for _, one, _ in found)
        beyond = [gamed * len(case.groups) > 1 + RISE for case, _, gamed in found]
        return cls(
            sum(rise > RISE for rise, _ in rises) / len(found),
            sum(rise > RISE and far for (rise, _), far in zip(rises, beyond, strict=True)) / len(found),
            sum(rise < -RISE for rise, _ in rises) / len(found),
            sum(one for _, _, one in found) / honest - 1 if honest else 0.0,
            greatest,
            seed,
        )


@dataclass(frozen=True, slots=True)
class WayReport:
    """All cases of one way, with fair shares and without."""

    way: str
    cases: int
    on: Changes
    off: Changes


@dataclass(frozen=True, slots=True)
class SharesReport:
    weeks: list[WeekReport]
    ways: list[WayReport]
    risen: dict[str, list[int]]
    """By way: the seeds of the cases in which a part rose with fair shares."""


def report(weeks: Sequence[WeekTrial], cases: Sequence[CaseTrial]) -> SharesReport:
    by_way = {way: found for way in WAYS if (found := [one for one in cases if one.case.way == way])}
    return SharesReport(
        [WeekReport(one.job.seed, one.job.fair, one.apart, one.uses) for one in weeks],
        [
            WayReport(
                way,
                len(found),
                Changes.of([(one.case, one.honest, one.gamed) for one in found]),
                Changes.of([(one.case, one.honest_off, one.gamed_off) for one in found]),
            )
            for way, found in by_way.items()
        ],
        {way: [one.case.seed for one in found if one.rise > RISE] for way, found in by_way.items()},
    )
