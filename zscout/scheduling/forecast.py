"""Forecast of starts: a copy of the core is played forward, as if no further event came.

It is an estimate: later requests of higher priority and early releases make it wrong. RCs vote as they have voted, and
unknown votes count as yes. Bookings are taken up at their dates, or lapse if the date is over; maintenance lasts as
planned."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from zscout.scheduling import model
from zscout.scheduling.booking import Booked, Booking
from zscout.scheduling.calendar import request_for
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, Effect, Event, Granted, Hold, HoldEnded, Outcome, Propose, Released
from zscout.scheduling.reason import Reason
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.scheduling.strategies import STRATEGIES
from zscout.types import ArcId, Ns, Term

MAX_CHECKS = 4_000
"""Checks of queued ARCs in a forecast, summed over its instants: bounds the time that the RCM spends."""
CHECKS_PER_DATE = 20
"""A date that begins costs as much as this many checks."""
LOOKAHEAD = 4
"""Open bookings are entered this many longest runtimes ahead (at least 2)."""
MAX_WAITING = 1_000
"""Queued ARCs in a forecast, best-ranked first."""


def play_instant(
    core: Core, now: Ns, events: Iterable[Event], vote: Callable[[Propose], model.Vote]
) -> Iterator[list[Effect]]:
    """Play one instant, with all its votes and further passes. Yields the effects of each batch."""
    batch = list(events)
    while batch:
        effects = core.handle(now, *batch)
        yield effects
        batch = [vote(effect) for effect in effects if isinstance(effect, Propose)]
        if not batch and any(isinstance(effect, model.WakeAt) and effect.at == now for effect in effects):
            batch = [model.Tick()]


@dataclass(slots=True)
class Forecast:
    starts: dict[ArcId, Ns] = field(default_factory=dict)
    """A missing ARC does not start within the forecast, or never from the present state."""
    preempts: list[ArcId] = field(default_factory=list)
    begin_within: Ns = 0
    """The longest time that the newcomer's devices need to begin."""
    reason: Reason | None = None  # the newcomer's first reason to wait; None if it starts at once


def forecast(
    core: Core, now: Ns, newcomer: ArcRequest | None = None, runtimes: RuntimeEstimator | None = None
) -> Forecast:
    """Play a copy of `core` forward from `now`, with `newcomer` first. With `runtimes`, holds end as usual."""
    # A copy, as a strategy may keep unfinished searches.
    copy = Core(STRATEGIES[core.strategy.name](), core.policy, assume_latest_begin=True)
    booked = {booking.id: (booking, arc is None) for booking, arc in core.bookings()}
    own = "" if newcomer is None else newcomer.booking
    later = {name: booking for name, (booking, is_open) in booked.items() if is_open and name != own}
    joined, lead = core.as_events(Term(core.term.counter + 1, "forecast"), MAX_WAITING, without=later)
    result = Forecast()
    ends = {held.request.arc: held.end for held in lead.recovered_holds}
    releases: dict[ArcId, Ns] = {}
    requests = [held.request for held in lead.recovered_holds] + [queued.request for queued in lead.waiting]
    requests += [newcomer] if newcomer is not None else []
    runtimes_of = [request.min_runtime for request in requests] + [
        booking.runtime for booking, _ in booked.values() if not booking.maintenance
    ]
    coming = _ComingBookings(later.values(), max(runtimes_of, default=0))
    dates = sorted(
        (at, name) for name, (booking, is_open) in booked.items() for at in _dates(booking, now, is_open=is_open)
    )
    # Nothing is known about the time after maintenance without an end.
    unknown = min((booking.end for booking, _ in booked.values() if booking.until is None), default=math.inf)
    unserved = {queued.request.arc for queued in lead.waiting}  # queued ARCs that have not started within the forecast

    def expect(request: ArcRequest, hold: Hold) -> None:
        end = None if runtimes is None else runtimes.end(request, hold, now)
        if end is not None:
            releases[request.arc] = end

    def vote(proposal: Propose) -> model.Vote:
        return model.Vote(proposal.proposal, core.expects_yes(proposal.rc, frozenset(proposal.holders)))

    def step(events: list[Event], preempting: ArcId | None = None) -> None:
        for effect in itertools.chain.from_iterable(play_instant(copy, now, events, vote)):
            match effect:
                case Granted(arc=arc, start=start):
                    result.starts.setdefault(arc, start)
                    unserved.discard(arc)
                    running = copy.arc(arc)
                    if running is not None and running.hold is not None:
                        ends[arc] = running.hold.end
                        expect(running.request, running.hold)
                        if newcomer is not None and arc == newcomer.arc:
                            runtime = running.hold.runtime or running.request.min_runtime
                            result.begin_within = max(0, ends[arc] - start - runtime)
                case HoldEnded(arc=arc, outcome=outcome, by=by, requeued=requeued):
                    ends.pop(arc, None)
                    releases.pop(arc, None)
                    if requeued and arc not in result.starts:
                        unserved.add(arc)
                    if preempting is not None and by == preempting and outcome is Outcome.PREEMPTED:
                        result.preempts.append(arc)
        # A kept hold outlasts its minimum runtime: only the time until it is preemptible counts.
        for arc in [arc for arc, end in ends.items() if end <= now]:
            del ends[arc]

    for held in lead.recovered_holds:
        expect(held.request, Hold(held.grant, held.start, held.end))
    step([*joined, *coming.until(now), lead])
    if newcomer is not None:
        unserved.add(newcomer.arc)
        step([model.Requested(newcomer)], newcomer.arc)
        asking = copy.arc(newcomer.arc)
        result.reason = asking.reported if asking is not None else None
    checks = 0
    while (ends or releases or dates) and unserved:
        checks += copy.waiting
        if checks > MAX_CHECKS:
            break
        changes = [at for at in (copy.next_change(),) if at is not None and at > now]
        now = max(now, min((*ends.values(), *releases.values(), *(date for date, _ in dates[:1]), *changes)))
        if now >= unknown:
            break
        events: list[Event] = [
            *coming.until(now),
            model.Tick(),
            *(Released(arc) for arc, at in releases.items() if at <= now),
        ]
        while dates and dates[0][0] <= now:
            date, name = dates.pop(0)
            booking, is_open = booked[name]
            if is_open and date == booking.start and not booking.maintenance:
                events.append(model.Requested(request_for(booking)))
                checks += CHECKS_PER_DATE
        step(events)
    return result


class _ComingBookings:
    """Open bookings that the copy does not know yet: it gets them as they come near, so a forecast of hours need not
    copy the bookings of a year. Every ARC that starts now ends within `reach`, the longest runtime. Reservations that
    an unknown booking would move begin later, so they hold back none of these ARCs."""

    def __init__(self, bookings: Iterable[Booking], reach: Ns) -> None:
        self._left = deque(sorted(bookings, key=lambda booking: (booking.start, booking.id)))
        self._reach = reach
        self._known_until: Ns = 0

    def until(self, now: Ns) -> list[Event]:
        if now + 2 * self._reach > self._known_until:
            self._known_until = now + LOOKAHEAD * self._reach
        near = list[Event]()
        while self._left and self._left[0].start <= self._known_until:
            near.append(Booked(self._left.popleft()))
        return near


def _dates(booking: Booking, now: Ns, *, is_open: bool) -> list[Ns]:
    """Times at which a booking changes without a hold."""
    if booking.maintenance:
        return [at for at in (booking.start, booking.end) if at > now]
    if booking.start > now:
        return [booking.start]
    return [booking.lapses] if is_open else []
