"""Bookings in one term: fleet time, the dates in the core, dangers, and operations. Values in and out; the present time
is passed in (`at`). The exchange with keepers is in `booking_sharing.py`."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from enum import Enum, auto
from typing import Any, Final, Self

from zscout.config.fleet import Fleet
from zscout.keyexpr import BadName, Sender
from zscout.messages import Ask, BookingRecord, BookingsKept, Operation, Problem, Refused
from zscout.rcm.admission import Admission
from zscout.rcm.deadlines import Deadlines
from zscout.rcm.device_check import DeviceCheck
from zscout.rcm.steps import BookedDanger, ClocksRead, Keep, Outbox, Proposed, RetryBooking, Ticket
from zscout.scheduling.booking import BookingConflict, BookingThreatened, Dates
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, Effect, Event, Propose, Tick, Vote, VoteOverdue
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.services.bookings.fleet_clock import SAME, FleetClock, agreed, wall_ns
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.bookings.records import Records
from zscout.services.rcm.booked_dates import BookedDates, Date
from zscout.services.rcm.booking_handler import BookingHandler
from zscout.types import SECOND, HostName, Ns, span

SLACK: Final[Ns] = SECOND // 100
"""Added to deadlines, as timers may be a little early."""
BALLOTS_DELAY: Final[Ns] = SECOND // 500
"""The time in which the ballots on a booking are gathered, one for each of its dates."""
DATE_REFRESH_DELAY: Final[Ns] = SECOND
"""The time in which changes are gathered before the next dates of repeated bookings are computed."""
DANGER_DELAY: Final[Ns] = 3 * SECOND
"""A danger is reported if it lasts for this time: after a change of leader, RCs join one after the other."""


class _Due(Enum):
    RECONCILE = auto()
    NEXT_DATE = auto()
    """A repeated booking may have one more date within 60 days."""
    REFRESH = auto()
    """The times of `NEXT_DATE` and `RENEW` must be computed."""
    RENEW = auto()
    """Maintenance without an end must be extended."""
    RETRY = auto()
    DANGERS = auto()


class Bookings:
    """`drained`: hosts in maintenance. Before `settles_at` some dates of the fleet may be unknown: after a restart of
    all hosts, each knows only its own records."""

    def __init__(
        self,
        fleet: Fleet,
        core: Core,
        admission: Admission,
        device_check: DeviceCheck,
        records: Records,
        clock: FleetClock,
        runtimes: RuntimeEstimator | None,
        settles_at: Ns,
    ) -> None:
        self._core, self.drained = core, frozenset[HostName]()
        self._adaptive = fleet.strategy == "adaptive"
        self._strategy, self._records, self.clock, self.settles_at = fleet.strategy, records, clock, settles_at
        self.dates = BookedDates(core, records, clock)
        self.handler = BookingHandler(fleet, core, records, self.dates, admission, device_check, runtimes)
        self._deadlines: Deadlines[tuple[_Due, Any]] = Deadlines()
        self._set: set[_Due] = set()
        """Deadlines of kinds that are set only once at a time."""
        self._next_date: Ns | None = None
        self._renewal: Ns | None = None
        self._by_clocks = settles_at > 0
        """True while fleet time is the median of the hosts' clocks, as no host has a fleet time from before."""
        self._reported: dict[str, str] = {}
        """By date: the danger that was reported last."""
        self._once(_Due.RECONCILE, 0)
        if settles_at:
            self._deadlines.set(settles_at + SLACK, (_Due.RECONCILE, None))

    def at(self, now: Ns) -> Self:
        self.dates.now = now
        return self

    @property
    def settled(self) -> bool:
        """Return True if all dates of the fleet are known."""
        return self.dates.now >= self.settles_at

    @property
    def time(self) -> float | None:
        """Fleet time for heartbeats, in seconds since 1970 (UTC); None: it is not settled."""
        return self.dates.time if self.settled else None

    @property
    def age(self) -> float:
        """Seconds for which fleet time has run."""
        return (self.dates.now - self.clock.since) / SECOND

    @property
    def next(self) -> Ns | None:
        return self._deadlines.next

    def take_up(self, ask: Ask, sender: Sender) -> str:
        return self.handler.take_up(ask, sender)

    def dated(self, request: ArcRequest) -> ArcRequest:
        return self.dates.dated(request)

    def record(self, booking: str) -> BookingRecord | None:
        return self._records.get(booking)

    def recovered(self, taken: Collection[str]) -> Sequence[Event]:
        """`taken`: dates that ARCs have taken up."""
        return [self.dates.recovered(taken)]

    def proposal(self, asked: Propose) -> Proposed:
        return self.handler.proposal(asked)

    def operation(self, ticket: Ticket, sender: Sender, operation: Operation) -> Outbox:
        try:
            if not self._adaptive:
                words = f'strategy "{self._strategy}" has no bookings; set strategy = "adaptive" under [fleet]'
                raise Refused("wrong_strategy", words)
            if not self.settled:
                raise Refused("busy", "the whole fleet restarted and its bookings are not known yet; try again")
            before = len(self.handler.undecided)
            self.handler.operation(ticket, sender, operation)
            if len(self.handler.undecided) > before:
                self._deadlines.set(self.handler.undecided[-1].until + SLACK, (_Due.RETRY, None))
        except Refused as refused:
            self.dates.out.answers.append((ticket, refused.problem))
        except BadName as error:
            self.dates.out.answers.append((ticket, Problem("bad_name", str(error))))
        return self._out()

    def retry(self, again: RetryBooking) -> Outbox:
        self.handler.retry(again.undecided)
        return self._out()

    def kept(self, keep: Keep, why: str) -> Outbox:
        self.handler.kept(keep, why)
        return self._out()

    def shared(self) -> Outbox:
        self._once(_Due.RECONCILE, 0)
        return self._out()

    def set_clock(self, read: ClocksRead) -> Outbox:
        """Set fleet time by the fleet times that hosts received from leaders, and by their clocks."""
        clock, (at, heard, walls, kept) = self.clock, read
        if heard is not None and heard[0] > self.age + SAME:
            # This term began without the fleet time of these hosts.
            clock.since, self._by_clocks = at - round(heard[0] * SECOND), False
            clock.step(heard[1], at)
        elif self._by_clocks and not self.settled:
            clock.step(agreed(walls.values(), kept=[walls[host] for host in kept]), at)
        elif moved := clock.correct(walls, at, kept):
            words = f"{span(abs(moved) / SECOND)} {'forward' if moved > 0 else 'back'}"
            self.dates.out.strange.append(("clock", f"fleet time is put {words}, to the time of most hosts' clocks"))
        if self.dates.redate(settled=self.settled):
            self._reconcile()
        return self._out()

    def note(self, events: Collection[Event], effects: Iterable[Effect]) -> Outbox:
        """Take over the events and effects of an instant. Their consequences belong to later instants."""
        if self.dates.note(effects, settled=self.settled):
            self._once(_Due.RECONCILE, 0)
        kinds = {*map(type, events), *map(type, effects)}
        if kinds & {BookingThreatened, BookingConflict}:
            self._report_later()
        if Dates in kinds:
            self._once(_Due.REFRESH, DATE_REFRESH_DELAY)
        if (drained := self._core.drained()) != self.drained:
            self.drained = drained
            self.dates.out.drained.append(drained)
        if self.handler.undecided and kinds & {Vote, VoteOverdue}:
            self._once(_Due.RETRY, BALLOTS_DELAY)
        return self._out()

    def tick(self) -> Outbox:
        while (due := self._deadlines.pop_due(self.dates.now)) is not None:
            self._set.discard(due[0])
            match due:
                case (_Due.RECONCILE, _):
                    self._reconcile()
                case (_Due.NEXT_DATE, at) if at == self._next_date:
                    self._next_date = None
                    self._once(_Due.RECONCILE, 0)
                case (_Due.RENEW, at) if at == self._renewal and self.settled:
                    self.dates.renew()
                    self._once(_Due.RECONCILE, 0)
                case (_Due.REFRESH, _):
                    self._refresh_dates()
                case (_Due.RETRY, _):
                    again, self.handler.undecided = self.handler.undecided, []
                    self.dates.out.then += map(RetryBooking, again)
                    self.dates.out.events += [Tick()] if again else []
                case (_Due.DANGERS, _):
                    self._report_dangers()
        return self._out()

    def _once(self, due: _Due, delay: Ns) -> None:
        if due not in self._set:
            self._set.add(due)
            self._deadlines.set(self.dates.now + delay, (due, None))

    def _out(self) -> Outbox:
        out, self.dates.out = self.dates.out, Outbox()
        return out

    def _reconcile(self) -> None:
        self.dates.out.events.append(self.dates.reconcile())
        self._report_later()
        self._refresh_dates()

    def _refresh_dates(self) -> None:
        """Set the deadlines for the next date of repeated bookings, and for extending maintenance without an end."""
        renewal, self._renewal = self.dates.until_renewal(), None
        if math.isfinite(renewal):
            self._renewal = self.dates.now + round(max(0.0, renewal) * SECOND) + SLACK
            self._deadlines.set(self._renewal, (_Due.RENEW, self._renewal))
        until, self._next_date = self.dates.until_next_date(), None
        if math.isfinite(until):
            self._next_date = self.dates.now + round(max(0.0, until) * SECOND) + SLACK
            self._deadlines.set(self._next_date, (_Due.NEXT_DATE, self._next_date))

    def _report_later(self) -> None:
        if self.dates.dangers() != self._reported:
            self._once(_Due.DANGERS, DANGER_DELAY)

    def _report_dangers(self) -> None:
        """Report changed dangers: once for all dates of a booking, next dates first, as notices are bounded."""
        before, self._reported = self._reported, self.dates.dangers()
        news = dict[tuple[str, str], list[Date]]()
        for name in before.keys() | self._reported.keys():
            why, date = self._reported.get(name, ""), self.dates.date(name)
            if why != before.get(name, "") and date is not None:
                news.setdefault((date.record.id, why), []).append(date)
        found = [
            BookedDanger(*min(dates, key=lambda date: date.start), why, len(dates) - 1)
            for (_, why), dates in news.items()
        ]
        self.dates.out.dangers += sorted(found, key=lambda danger: (danger.start, danger.record.id, danger.why))


def bookings_of(
    fleet: Fleet,
    core: Core,
    admission: Admission,
    device_check: DeviceCheck,
    keeper: BookingKeeper,
    kept: Sequence[BookingsKept],
    runtimes: RuntimeEstimator | None,
) -> Bookings:
    """The bookings of a new term. `kept`: the answers of keepers to the takeover."""
    now, known = keeper.mesh.now(), _is_known(keeper, kept, fleet)
    time, age = _time(keeper, kept)
    keeper.records.take(record for answer in kept for record in answer.records)
    clock, settles_at = FleetClock(time, now, now - round(age * SECOND)), now + round(fleet.mesh.lease * SECOND)
    return Bookings(fleet, core, admission, device_check, keeper.records, clock, runtimes, 0 if known else settles_at)


def oldest(answers: Iterable[BookingsKept]) -> tuple[float, Ns] | None:
    """The fleet time that has run longest at any host: its seconds and the time. If a missed correction left two that
    have run equally long, the one of more hosts, else the nearer to their clocks."""
    heard = [answer for answer in answers if answer.time is not None]
    age = max((answer.time_age for answer in heard), default=None)
    if age is None:
        return None
    times = [wall_ns(answer.time) for answer in heard if answer.time is not None and answer.time_age > age - SAME]
    return age, agreed(times, agreed(wall_ns(answer.wall) for answer in heard))


def _time(keeper: BookingKeeper, kept: Sequence[BookingsKept]) -> tuple[Ns, float]:
    """Fleet time, and the seconds that it has run: the oldest of any host; else the median of the clocks, from now."""
    found = oldest([*kept, keeper.answer_to("", durable=False)])
    if found is not None:
        return found[1], found[0]
    hosts = {answer.host: answer for answer in (*kept, keeper.answer_to("", durable=False))}.values()
    return agreed(
        (wall_ns(host.wall) for host in hosts), kept=[wall_ns(host.wall) for host in hosts if host.synchronised]
    ), 0.0


def _is_known(keeper: BookingKeeper, kept: Sequence[BookingsKept], fleet: Fleet) -> bool:
    """Return True if fleet time is known anywhere, or most candidates of the fleet file have answered."""
    if keeper.time is not None or any(answer.time is not None for answer in kept):
        return True
    answered = {keeper.mesh.me.host, *(answer.host for answer in kept)} & {*fleet.candidates}
    return 2 * len(answered) > len(fleet.candidates) > 0
