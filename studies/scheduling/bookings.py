"""The cost and benefit of bookings: the same stream of requests, with different shares of them booked ahead.

A request is booked some time before its wanted start, takes the first slot after that start, and asks at its date.
Other requests ask at their wanted start. Each request has a share from which on it is booked, so runs of the same seed
differ in nothing else.
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
"""Shares of requests that are booked ahead."""
AHEAD: Final[tuple[Ns, Ns]] = (30 * SECOND, 120 * SECOND)
"""Time from the booking to the wanted start, drawn uniformly: 6 to 24 times the mean runtime."""
LATEST: Final[Ns] = 600 * SECOND
"""Longest delay of a slot after the wanted start. Without such a slot the request is not booked."""
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
    """Share of all RC-time in which an RC was idle although a request that a booking held back needed it."""
    thrown_away: float
    wait: Mapping[ArcId, Ns]
    """From each ARC's request, or its booked date, to the start of its completed hold."""
    moved: Mapping[ArcId, Ns]
    """Delay of the date after the wanted start, by booked ARC."""


def drawn(job: BookingJob, workload: Workload) -> dict[ArcId, Ns]:
    """The ARCs that are booked, and how long ahead."""
    random = Random(f"bookings/{job.family}/{job.seed}")  # noqa: S311 - workloads, not secrets
    draws = [(arrival.request.arc, random.random(), random.randint(*AHEAD)) for arrival in workload.arrivals]
    return {arc: ahead for arc, place, ahead in draws if place < job.share}


def run(job: BookingJob) -> BookingTrial:
    """Run a job to its end. Raises KeyError for an unknown family."""
    workload = FAMILIES[job.family].workload(job.seed)
    return play(job, workload, drawn(job, workload))


def play(job: BookingJob, workload: Workload, ahead: Mapping[ArcId, Ns]) -> BookingTrial:
    """The same with the caller's workload of exclusive RCs, and its bookings: `ahead` in ns by ARC."""
    played = _Run(workload)
    for arrival in workload.arrivals:
        if arrival.request.arc in ahead:
            played.at(max(0, arrival.at - ahead[arrival.request.arc]), partial(played.book, arrival))
        else:
            played.at(arrival.at, partial(played.ask, arrival.request))
    played.play_all()
    wanted = {arrival.request.arc: arrival.at for arrival in workload.arrivals}
    # A booking asks at its date.
    asked = {arc: at + played.moved.get(arc, 0) for arc, at in wanted.items()}
    done = {hold.arc: hold.start for hold in played.holds if hold.outcome is model.Outcome.COMPLETED}
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
    """The core under virtual time, with an agenda of coming events."""

    def __init__(self, workload: Workload) -> None:
        self._core, self._rcs = Core(Adaptive()), [rc.name for rc in workload.rcs]
        self._last = max((arrival.at for arrival in workload.arrivals), default=0)
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

    def play_all(self) -> None:
        """Play until the agenda is empty and all holds have ended."""
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

    def book(self, arrival: Arrival) -> Iterator[model.Event]:
        request, now = arrival.request, self._now
        wanted = Booking(
            f"b-{request.arc}", request.needs, request.priority, arrival.at, request.min_runtime, PATIENCE, now
        )
        found = self._core.slots(wanted, arrival.at + LATEST, 1).found
        if not found:
            self.at(arrival.at, partial(self.ask, request))
            return
        start = found[0].start
        self.moved[request.arc] = start - arrival.at
        self.at(start, partial(self.ask, replace(request, booking=wanted.id)))
        # Add it at once, because the next booking of this instant must see it.
        self._step([Booked(replace(wanted, start=start))])
        yield model.Tick()

    def _step(self, events: Sequence[model.Event]) -> None:
        for effect in (
            effect for effects in play_instant(self._core, self._now, events, _no_votes) for effect in effects
        ):
            match effect:
                case model.Granted(arc=arc, end=end) if end is not None:
                    self._starts[arc], self._ends[arc] = self._now, end
                case model.HoldEnded(arc=arc, outcome=outcome, rcs=rcs):
                    del self._ends[arc]
                    self.holds.append(HoldRecord(arc, self._starts.pop(arc), self._now, outcome, rcs))
                case BookingChanged(booking=booking, state=state):
                    assert state is not BookingState.LAPSED, booking

    def _lost(self) -> set[RcName]:
        """RCs that are idle because of bookings."""
        status = self._core.status()
        idle = {rc.name for rc in status.rcs if not rc.holders}
        kept_out = (arc for arc in status.queued if arc.reason is not None and arc.reason.code is ReasonCode.BOOKED)
        return idle & {rc for arc in kept_out for rc in arc.needs}


def _no_votes(asked: model.Propose) -> model.Vote:
    raise ValueError(f"{asked.rc} is sharable")


@dataclass(frozen=True, slots=True)
class BookingsRow:
    """A family at a share of bookings, averaged over the seeds."""

    share: float
    booked: float
    """Bookings in a run."""
    in_use: float
    lost: float
    thrown_away: float
    at_date: float
    """Share of the booked ARCs that began at their dates."""
    moved: float
    """Mean delay of these dates after the wanted starts, in seconds."""
    at_once: float
    """Share of the same ARCs that begin when they ask, in the run without bookings."""
    wait: float
    """Mean wait in seconds of the ARCs that are not booked in any run."""
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

    others = [wait for trial in trials for arc, wait in trial.wait.items() if arc not in largest(trial).moved]
    booked = [(trial, arc) for trial in trials for arc in trial.moved]
    return BookingsRow(
        share=trials[0].job.share,
        booked=len(booked) / len(trials),
        in_use=statistics.fmean(trial.in_use for trial in trials),
        lost=statistics.fmean(trial.lost for trial in trials),
        thrown_away=statistics.fmean(trial.thrown_away for trial in trials),
        at_date=_share([trial.wait.get(arc) == 0 for trial, arc in booked]),
        moved=statistics.fmean(trial.moved[arc] for trial, arc in booked) / SECOND if booked else 0.0,
        at_once=_share([without(trial).wait.get(arc) == 0 for trial, arc in booked]),
        wait=statistics.fmean(others) / SECOND if others else 0.0,
        longest=max(others, default=0) / SECOND,
    )


def _share(true: Sequence[bool]) -> float:
    return sum(true) / len(true) if true else 0.0
