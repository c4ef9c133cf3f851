"""Bookings in one term: fleet time, the dates in the core, dangers, and operations. Values in and out; the present time
is passed in (`at`). Who keeps them, and whom that is asked, is `booking_sharing.py`."""

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
"""Timers may be a little early."""
BALLOTS: Final[Ns] = SECOND // 500
"""Ballots on a booking are gathered for so long: one for each of its dates."""
GATHERS: Final[Ns] = SECOND
"""Bookings are gathered for so long before it is found out when there is one more date of them to keep."""
LASTS: Final[Ns] = 3 * SECOND
"""A danger may pass within this time: after a change of leader RCs come one after the other."""


class _Due(Enum):
    NEWS = auto()
    ANOTHER = auto()
    """What is repeated may have one more date within 60 days."""
    LOOK = auto()
    """It is found out when that is."""
    RENEW = auto()
    """Maintenance without an end is to be put off."""
    TRY = auto()
    TELL = auto()


class Bookings:
    """`drained`: the hosts in maintenance. Before `settles_at` not all dates of the fleet are known: after a restart of
    all its hosts, each knows its own only."""

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
        """Those of which there is one at a time."""
        self._another: Ns | None = None
        self._renewal: Ns | None = None
        self._is_found_out = settles_at > 0
        """True while fleet time is what hosts' clocks say, as nobody has heard it."""
        self._told: dict[str, str] = {}
        """Dangers that were reported, by date."""
        self._once(_Due.NEWS, 0)
        if settles_at:
            self._deadlines.set(settles_at + SLACK, (_Due.NEWS, None))

    def at(self, now: Ns) -> Self:
        """The present time is `now`."""
        self.dates.now = now
        return self

    @property
    def settled(self) -> bool:
        """Whether the dates of the fleet are known."""
        return self.dates.now >= self.settles_at

    @property
    def time(self) -> float | None:
        """Fleet time, in seconds since 1970 (UTC), as others may go by it; None: it is not settled."""
        return self.dates.time if self.settled else None

    @property
    def age(self) -> float:
        """For how many seconds that time has gone on."""
        return (self.dates.now - self.clock.since) / SECOND

    @property
    def next(self) -> Ns | None:
        return self._deadlines.next

    # What is known

    def take_up(self, ask: Ask, sender: Sender) -> str:
        return self.handler.take_up(ask, sender)

    def dated(self, request: ArcRequest) -> ArcRequest:
        return self.dates.dated(request)

    def record(self, booking: str) -> BookingRecord | None:
        return self._records.get(booking)

    def recovered(self, taken: Collection[str]) -> Sequence[Event]:
        """The events by which the core knows of all dates; `taken`: those that ARCs have taken up."""
        return [self.dates.recovered(taken)]

    def proposal(self, asked: Propose) -> Proposed:
        return self.handler.proposal(asked)

    # What happens

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
                self._deadlines.set(self.handler.undecided[-1].until + SLACK, (_Due.TRY, None))
        except Refused as refused:
            self.dates.out.answers.append((ticket, refused.problem))
        except BadName as error:
            self.dates.out.answers.append((ticket, Problem("bad_name", str(error))))
        return self._out()

    def again(self, again: RetryBooking) -> Outbox:
        self.handler.again(again.undecided)
        return self._out()

    def kept(self, keep: Keep, why: str) -> Outbox:
        self.handler.kept(keep, why)
        return self._out()

    def shared(self) -> Outbox:
        """Others know what was not known here."""
        self._once(_Due.NEWS, 0)
        return self._out()

    def set_clock(self, read: ClocksRead) -> Outbox:
        """Set fleet time by what hosts have heard of it, and by their clocks."""
        clock, (at, heard, walls, kept) = self.clock, read
        if heard is not None and heard[0] > self.age + SAME:
            # This reign began where nobody knew the time of the others.
            clock.since, self._is_found_out = at - round(heard[0] * SECOND), False
            clock.step(heard[1], at)
        elif self._is_found_out and not self.settled:
            clock.step(agreed(walls.values(), kept=[walls[host] for host in kept]), at)
        elif moved := clock.correct(walls, at, kept):
            words = f"{span(abs(moved) / SECOND)} {'forward' if moved > 0 else 'back'}"
            self.dates.out.strange.append(("clock", f"fleet time is put {words}, to what most hosts' clocks say"))
        if self.dates.redate(settled=self.settled):
            self._reconcile()
        return self._out()

    def note(self, events: Collection[Event], effects: Iterable[Effect]) -> Outbox:
        """What has happened in an instant: what follows of it follows in another one."""
        if self.dates.note(effects, settled=self.settled):
            self._once(_Due.NEWS, 0)
        kinds = {*map(type, events), *map(type, effects)}
        if kinds & {BookingThreatened, BookingConflict}:
            self._tell_soon()
        if Dates in kinds:
            self._once(_Due.LOOK, GATHERS)
        if (drained := self._core.drained()) != self.drained:
            self.drained = drained
            self.dates.out.drained.append(drained)
        if self.handler.undecided and kinds & {Vote, VoteOverdue}:
            self._once(_Due.TRY, BALLOTS)
        return self._out()

    def tick(self) -> Outbox:
        """Carries out what is due."""
        while (due := self._deadlines.pop_due(self.dates.now)) is not None:
            self._set.discard(due[0])
            match due:
                case (_Due.NEWS, _):
                    self._reconcile()
                case (_Due.ANOTHER, at) if at == self._another:
                    self._another = None
                    self._once(_Due.NEWS, 0)
                case (_Due.RENEW, at) if at == self._renewal and self.settled:
                    self.dates.renew()
                    self._once(_Due.NEWS, 0)
                case (_Due.LOOK, _):
                    self._await_another()
                case (_Due.TRY, _):
                    again, self.handler.undecided = self.handler.undecided, []
                    self.dates.out.then += map(RetryBooking, again)
                    self.dates.out.events += [Tick()] if again else []
                case (_Due.TELL, _):
                    self._tell()
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
        self._tell_soon()
        self._await_another()

    def _await_another(self) -> None:
        """What is repeated is to have its dates in time, and maintenance without an end is to last."""
        renewal, self._renewal = self.dates.until_renewal(), None
        if math.isfinite(renewal):
            self._renewal = self.dates.now + round(max(0.0, renewal) * SECOND) + SLACK
            self._deadlines.set(self._renewal, (_Due.RENEW, self._renewal))
        until, self._another = self.dates.until_another(), None
        if math.isfinite(until):
            self._another = self.dates.now + round(max(0.0, until) * SECOND) + SLACK
            self._deadlines.set(self._another, (_Due.ANOTHER, self._another))

    def _tell_soon(self) -> None:
        if self.dates.dangers() != self._told:
            self._once(_Due.TELL, LASTS)

    def _tell(self) -> None:
        """Reports what is not as it was reported last, and has been so for a while: the next dates first, as there are
        bounds to what people get, and once for all dates of a booking."""
        before, self._told = self._told, self.dates.dangers()
        news = dict[tuple[str, str], list[Date]]()
        for name in before.keys() | self._told.keys():
            why, date = self._told.get(name, ""), self.dates.date(name)
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
    """Those of a new term. `kept`: what keepers answered as the lead was taken."""
    now, known = keeper.mesh.now(), _is_known(keeper, kept, fleet)
    time, age = _time(keeper, kept)
    keeper.records.take(record for told in kept for record in told.records)
    clock, settles_at = FleetClock(time, now, now - round(age * SECOND)), now + round(fleet.mesh.lease * SECOND)
    return Bookings(fleet, core, admission, device_check, keeper.records, clock, runtimes, 0 if known else settles_at)


def oldest(answers: Iterable[BookingsKept]) -> tuple[float, Ns] | None:
    """Of the fleet times that hosts have heard the one that has gone on for longest: for how many seconds, and it. Of
    two that did, as some hosts missed a correction, what more have heard, or what is nearer to their clocks."""
    heard = [one for one in answers if one.time is not None]
    age = max((one.time_age for one in heard), default=None)
    if age is None:
        return None
    times = [wall_ns(one.time) for one in heard if one.time is not None and one.time_age > age - SAME]
    return age, agreed(times, agreed(wall_ns(one.wall) for one in heard))


def _time(keeper: BookingKeeper, kept: Sequence[BookingsKept]) -> tuple[Ns, float]:
    """Fleet time, and for how many seconds it has gone on: the oldest that was heard, here or elsewhere. Where nobody
    has heard any it is found out now: the median of the clocks."""
    found = oldest([*kept, keeper.told("", durable=False)])
    if found is not None:
        return found[1], found[0]
    hosts = {one.host: one for one in (*kept, keeper.told("", durable=False))}.values()
    return agreed(
        (wall_ns(one.wall) for one in hosts), kept=[wall_ns(one.wall) for one in hosts if one.synchronised]
    ), 0.0


def _is_known(keeper: BookingKeeper, kept: Sequence[BookingsKept], fleet: Fleet) -> bool:
    if keeper.time is not None or any(one.time is not None for one in kept):
        return True
    answered = {keeper.mesh.me.host, *(one.host for one in kept)} & {*fleet.candidates}
    return 2 * len(answered) > len(fleet.candidates) > 0
