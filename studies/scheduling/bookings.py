"""What bookings cost and what they give: one stream of requests, a share of them booked ahead or not.

Who books does so some time before it wants to start, takes the first slot from then on, and asks at its date. Without
bookings the same requests ask when they want to start. Who is booked at a larger share is so at none smaller than its
own: runs of one seed differ in nothing else.
"""

from __future__ import annotations

import heapq
import itertools
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Final

from msgspec.structs import replace

from studies.scheduling.families import FAMILIES
from studies.scheduling.measures import measure
from zscout.scheduling import model
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.booking import Booked, Booking, BookingChanged, BookingState
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.reason import ReasonCode
from zscout.simulation.replay import HoldRecord, Replay
from zscout.simulation.workload import Arrival, Workload
from zscout.types import SECOND, ArcId, Ns, RcName

BOOKABLE: Final = ("calm", "load65", "narrow", "levels", "operators", "overload")
"""Streams of exclusive RCs."""
DEFAULT_FAMILIES: Final = ("load65", "levels")
SHARES: Final = (0.0, 0.1, 0.2, 0.4)
"""Of the requests, booked ahead."""
AHEAD: Final[tuple[Ns, Ns]] = (30 * SECOND, 120 * SECOND)
"""How long before it wants to start it is booked, drawn evenly: 6 to 24 times the mean runtime."""
LATEST: Final[Ns] = 600 * SECOND
"""How much later a slot may be than it was wanted; else it asks as without a booking."""
PATIENCE: Final[Ns] = 10 * SECOND


@dataclass(frozen=True, slots=True, order=True)
class BookingJob:
    family: str
    seed: int
    share: float


@dataclass(frozen=True, slots=True)
class BookingTrial:
    """One run. Times in ns, shares from 0 to 1."""

    job: BookingJob
    in_use: float
    lost: float
    """Share of all RC-time in which an RC was idle though somebody waited for it whom a booking kept out."""
    thrown_away: float
    wait: Mapping[ArcId, Ns]
    """From when each ARC asked, or the date for which it was booked, to the start of the hold that it completed."""
    moved: Mapping[ArcId, Ns]
    """By ARC that was booked: how much later than it was wanted."""


def drawn(job: BookingJob, workload: Workload) -> dict[ArcId, Ns]:
    """Who books, and how long ahead."""
    random = Random(f"bookings/{job.family}/{job.seed}")  # noqa: S311 - workloads, not secrets
    draws = [(one.request.arc, random.random(), random.randint(*AHEAD)) for one in workload.arrivals]
    return {arc: ahead for arc, place, ahead in draws if place < job.share}


def run(job: BookingJob) -> BookingTrial:
    """Runs a job to its end. Raises KeyError for a family that does not exist."""
    workload = FAMILIES[job.family].workload(job.seed)
    return play(job, workload, drawn(job, workload))


def play(job: BookingJob, workload: Workload, ahead: Mapping[ArcId, Ns]) -> BookingTrial:
    """The same with a workload of exclusive RCs and bookings of the caller's own."""
    played = _Run(workload)
    for one in workload.arrivals:
        if one.request.arc in ahead:
            played.at(max(0, one.at - ahead[one.request.arc]), partial(played.book, one))
        else:
            played.at(one.at, partial(played.ask, one.request))
    played.go_on()
    wanted = {one.request.arc: one.at for one in workload.arrivals}
    # A booking asks at its date.
    asked = {arc: at + played.moved.get(arc, 0) for arc, at in wanted.items()}
    done = {one.arc: one.start for one in played.holds if one.outcome is model.Outcome.COMPLETED}
    found = measure(workload, Replay(tuple(played.holds), tuple(wanted.keys() - done.keys())))
    last = max(wanted.values(), default=0)
    return BookingTrial(
        job,
        in_use=found.in_use,
        lost=played.lost / (last * len(workload.rcs)) if last else 0.0,
        thrown_away=found.thrown_away,
        wait={arc: done[arc] - at for arc, at in asked.items() if arc in done},
        moved=played.moved,
    )


class _Run:
    """The core under virtual time, with what is still to come."""

    def __init__(self, workload: Workload) -> None:
        self._core, self._rcs = Core(Adaptive()), [rc.name for rc in workload.rcs]
        self._last = max((one.at for one in workload.arrivals), default=0)
        self._agenda: list[tuple[Ns, int, Callable[[], Iterator[model.Event]]]] = []
        self._numbers = itertools.count()
        self._now: Ns = 0
        self._ends: dict[ArcId, Ns] = {}
        self._starts: dict[ArcId, Ns] = {}
        self.holds: list[HoldRecord] = []
        self.moved: dict[ArcId, Ns] = {}
        self.lost = 0
        self._step([model.RcJoined(rc, sharable=False) for rc in self._rcs])

    def at(self, time: Ns, make: Callable[[], Iterator[model.Event]]) -> None:
        heapq.heappush(self._agenda, (time, next(self._numbers), make))

    def go_on(self) -> None:
        """Until nothing is left."""
        while self._agenda or self._ends:
            coming = min((*self._ends.values(), *(time for time, _, _ in self._agenda[:1])))
            wasted = len(self._lost()) if self._now < self._last else 0
            self.lost += wasted * (min(coming, self._last) - self._now)
            self._now = coming
            events: list[model.Event] = []
            while self._agenda and self._agenda[0][0] == coming:
                events += heapq.heappop(self._agenda)[2]()
            self._step(events or [model.Tick()])

    def ask(self, request: model.ArcRequest) -> Iterator[model.Event]:
        yield model.Requested(request)

    def book(self, one: Arrival) -> Iterator[model.Event]:
        request, now = one.request, self._now
        wanted = Booking(
            f"b-{request.arc}", request.needs, request.priority, one.at, request.min_runtime, PATIENCE, now
        )
        found = self._core.slots(wanted, one.at + LATEST, 1).found
        if not found:
            self.at(one.at, partial(self.ask, request))
            return
        start = found[0].start
        self.moved[request.arc] = start - one.at
        self.at(start, partial(self.ask, replace(request, booking=wanted.id)))
        # One after the other: the next that books in this instant has to see it.
        self._step([Booked(replace(wanted, start=start))])
        yield model.Tick()

    def _step(self, events: Sequence[model.Event]) -> None:
        for effect in (one for effects in play_instant(self._core, self._now, events, _no_votes) for one in effects):
            match effect:
                case model.Granted(arc=arc, end=end) if end is not None:
                    self._starts[arc], self._ends[arc] = self._now, end
                case model.HoldEnded(arc=arc, outcome=outcome, rcs=rcs):
                    del self._ends[arc]
                    self.holds.append(HoldRecord(arc, self._starts.pop(arc), self._now, outcome, rcs))
                case BookingChanged(booking=booking, state=state):
                    assert state is not BookingState.LAPSED, booking

    def _lost(self) -> set[RcName]:
        """RCs that are idle, and would not be without the bookings."""
        status = self._core.status()
        idle = {rc.name for rc in status.rcs if not rc.holders}
        kept_out = (one for one in status.queued if one.reason is not None and one.reason.code is ReasonCode.BOOKED)
        return idle & {rc for one in kept_out for rc in one.needs}


def _no_votes(asked: model.Propose) -> model.Vote:
    raise ValueError(f"{asked.rc} is sharable")


@dataclass(frozen=True, slots=True)
class BookingsRow:
    """One family at one share, on average over the seeds."""

    share: float
    booked: float
    """Bookings in a run."""
    in_use: float
    lost: float
    thrown_away: float
    at_date: float
    """Share of the booked that began at their dates."""
    moved: float
    """How much later than wanted these were, in seconds, on average."""
    at_once: float
    """The same ones without bookings: share that began when they asked."""
    wait: float
    """Mean wait of those that are booked at no share, in seconds."""
    longest: float


@dataclass(frozen=True, slots=True)
class BookingsReport:
    seeds: tuple[int, ...]
    families: dict[str, tuple[BookingsRow, ...]]


def jobs(families: Sequence[str], seeds: Sequence[int]) -> list[BookingJob]:
    return [BookingJob(family, seed, share) for family in families for seed in seeds for share in SHARES]


def report(trials: Sequence[BookingTrial]) -> BookingsReport:
    by_job = {trial.job: trial for trial in trials}
    seeds = sorted({job.seed for job in by_job})
    rows = {
        family: tuple(
            _row([by_job[job] for job in by_job if (job.family, job.share) == (family, share)], by_job)
            for share in SHARES
        )
        for family in dict.fromkeys(job.family for job in by_job)
    }
    return BookingsReport(tuple(seeds), rows)


def _row(trials: Sequence[BookingTrial], by_job: Mapping[BookingJob, BookingTrial]) -> BookingsRow:
    def largest(trial: BookingTrial) -> BookingTrial:
        return by_job[BookingJob(trial.job.family, trial.job.seed, SHARES[-1])]

    def without(trial: BookingTrial) -> BookingTrial:
        return by_job[BookingJob(trial.job.family, trial.job.seed, 0.0)]

    others = [wait for one in trials for arc, wait in one.wait.items() if arc not in largest(one).moved]
    booked = [(one, arc) for one in trials for arc in one.moved]
    return BookingsRow(
        share=trials[0].job.share,
        booked=len(booked) / len(trials),
        in_use=statistics.fmean(one.in_use for one in trials),
        lost=statistics.fmean(one.lost for one in trials),
        thrown_away=statistics.fmean(one.thrown_away for one in trials),
        at_date=_share([one.wait.get(arc) == 0 for one, arc in booked]),
        moved=statistics.fmean(one.moved[arc] for one, arc in booked) / SECOND if booked else 0.0,
        at_once=_share([without(one).wait.get(arc) == 0 for one, arc in booked]),
        wait=statistics.fmean(others) / SECOND if others else 0.0,
        longest=max(others, default=0) / SECOND,
    )


def _share(true: Sequence[bool]) -> float:
    return sum(true) / len(true) if true else 0.0
