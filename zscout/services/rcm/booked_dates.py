"""The dates of bookings in the core of a leader: as claims, as the records that are kept say it.

What of two halves of a fleet can't both be is not in the core: higher priority stands, then what was made earlier."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from functools import partial
from typing import NamedTuple

from msgspec.structs import replace

from zscout.keyexpr import check_need, is_pattern
from zscout.mesh.sparse_log import SparseLog
from zscout.messages import (
    MAX_AHEAD,
    WINDOW,
    BookedDate,
    BookingRecord,
    BookingView,
    DateState,
    Instant,
    duration,
    exact_amounts,
)
from zscout.scheduling.booking import (
    Booked,
    Booking,
    BookingChanged,
    BookingState,
    BookingThreatened,
    Redated,
    Unbooked,
)
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, Effect, Event, Propose, Rc, RcJoined, Vote, VoteOverdue
from zscout.scheduling.reason import Reason
from zscout.scheduling.votes import HolderSet
from zscout.services.bookings.dates import DAY, dates, told
from zscout.services.bookings.fleet_clock import FleetClock
from zscout.services.bookings.records import Records
from zscout.types import SECOND, ArcId, Grant, Need, Ns, RcName

log = logging.getLogger(__name__)

MAX_CLAIMS = 4_000
"""Dates of all bookings that a leader keeps free: of what is repeated those of the next 60 days."""
MAX_DIGITS = 11
"""Of an instant."""
STEPPED: Ns = SECOND
"""By how much it is moved only where another time goes on."""
REDATED: Ns = SECOND // 50
"""By how much fleet time is slewed before dates are put right."""


class Date(NamedTuple):
    """One date of a booking."""

    record: BookingRecord
    start: Instant

    @property
    def id(self) -> str:
        """The core's name of it."""
        return f"{self.record.id}@{self.start}"

    @property
    def bound(self) -> dict[Need, RcName]:
        return self.record.kept.get(self.start, {})

    @property
    def rank(self) -> tuple[int, Grant, str, Instant]:
        """Of two that can't both be the lesser stands."""
        return -self.record.priority, self.record.made, self.record.id, self.start


class BookedDates:
    """`emit` takes events of one instant, `vote` sends proposals, `changed` is told of records that are not as they
    were."""

    def __init__(
        self,
        core: Core,
        records: Records,
        clock: FleetClock,
        now: Callable[[], Ns],
        emit: Callable[..., None],
        vote: Callable[[Iterable[Propose]], None],
        changed: Callable[[Iterable[BookingRecord]], None],
    ) -> None:
        self._core, self._records, self.clock, self._now = core, records, clock, now
        self._emit, self._vote, self._changed = emit, vote, changed
        self._strange = SparseLog(log, now)
        self._conflicts: dict[str, str] = {}
        """Dates that are not in the core, with the one that stands; nothing where no RC of a pattern is free."""
        self._judged: dict[str, tuple[str, int, Mapping[Need, RcName]]] = {}
        """In which situation each of those was found to be in conflict."""
        self._joined = 0
        """How many times an RC has joined."""
        self._danger: dict[str, str] = {}
        """Why dates may not be kept, in words."""
        self._dated_by: Ns = clock.at(now()) - now()
        """By how much fleet time is ahead of the host's clock for all dates in the core, so that what follows upon
        another does so there as well."""
        self._waits_for_votes = False

    @property
    def time(self) -> float:
        """Fleet time, in seconds since 1970 (UTC)."""
        return self.clock.at(self._now()) / SECOND

    def local(self, instant: Instant) -> Ns:
        """When that is, on the core's clock."""
        return instant * SECOND - self._dated_by

    def to_fleet(self, time: Ns) -> Ns:
        """The same the other way: ns since 1970 (UTC)."""
        return time + self._dated_by

    def claim(self, date: Date, *, taken: bool = False) -> Booking:
        """As the core takes it; one that is `taken` has no patience to lapse by. Raises ValueError for a record that
        is none."""
        record = date.record
        for need in record.needs:
            check_need(need)
        runtime = duration(record.runtime, "runtime")
        return Booking(
            date.id,
            {need: exact_amounts(params) for need, params in record.needs.items()},
            record.priority,
            self.local(date.start),
            runtime,
            runtime if taken else duration(record.patience, "patience"),
            self.local(record.since),
            date.bound,
            record.owner,
            record.name,
            record.who,
            maintenance=record.maintenance,
        )

    def dated(self, request: ArcRequest) -> ArcRequest:
        """With the date that it waits for where what it takes up is not in the core."""
        start = start_of(request.booking)
        return request if start is None else replace(request, not_before=self.local(start))

    def open_dates(self, record: BookingRecord, taken: Collection[str] = ()) -> list[Date]:
        """Those of a booking that are not over; of what is repeated within the next 60 days."""
        if record.unbooked:
            return []
        time = self.time
        if not 0 < record.runtime <= MAX_AHEAD:
            return []
        try:
            ahead = WINDOW if record.every else MAX_AHEAD + DAY  # the clock that it was booked by may have been ahead
            starts = dates(record, time - float(record.runtime), time + ahead)
        except (ValueError, OverflowError) as error:
            self._strange.warning(record.id, "booking %s is not kept: %s", record.id, error)
            return []
        final = {*record.dropped, *record.over}
        left = [Date(record, start) for start in starts if start not in final]
        return [date for date in left if date.id in taken or not self._lapsed(date)]

    def until_another(self, since: float) -> float:
        """Seconds until what is repeated has one more date within 60 days than it had then (fleet time); infinite where
        nothing is."""
        first, coming = since + WINDOW, list[Instant]()
        for record in self._records:
            if record.every and not record.unbooked:
                with suppress(ValueError, OverflowError):  # it is not kept, and that was said
                    coming += dates(record, first, first + (record.every + 1) * DAY)[:1]
        return min(coming, default=math.inf) - WINDOW - self.time

    def _lapsed(self, date: Date) -> bool:
        """Whether nobody took it up in time: that follows from the time alone, and is not kept."""
        waits = date.record.runtime if date.record.maintenance else min(date.record.patience, date.record.runtime)
        if self.local(date.start) + round(waits * SECOND) > self._now():
            return False
        kept = self._core.booking(date.id)
        return kept is None or kept.arc is None

    # The core's claims

    def recovered(self, taken: Collection[str]) -> list[Event]:
        """The events by which a core that begins to lead knows of all dates; `taken`: those that ARCs have taken up."""
        return [
            booked for date in self._all(taken) if (booked := self._booked(date, taken=date.id in taken)) is not None
        ]

    def _all(self, taken: Collection[str] = ()) -> list[Date]:
        found = list[Date]()
        for record in sorted(self._records, key=lambda one: (-one.priority, one.made, one.id)):
            found += self.open_dates(record, taken)
            if len(found) > MAX_CLAIMS:
                self._strange.warning("", "more than %d dates are booked: the last are not kept", MAX_CLAIMS)
                break
        return sorted(found[:MAX_CLAIMS], key=lambda one: one.rank)

    def _booked(self, date: Date, *, taken: bool = False) -> Booked | None:
        try:
            return Booked(self.claim(date, taken=taken))
        except ValueError as error:
            self._strange.warning(date.record.id, "booking %s is not kept: %s", date.record.id, error)
            return None

    def reconcile(self) -> None:
        """Brings the core's claims to what the records say, and finds which can't be."""
        wanted = {date.id: date for date in self._all()}
        known = {booking.id for booking, _ in self._core.bookings()}
        # What is only forgotten here, as it could be kept nowhere, another host may have.
        gone = [Unbooked(name, at_present=not self._has(name)) for name in known if name not in wanted]
        missing = [date for name, date in wanted.items() if name not in known and not self._is_settled(name)]
        found = (self._booked(date) for date in missing if not _unbound(date))
        coming = [replace(one, tentative=self._core.is_wanted(one.booking.id)) for one in found if one is not None]
        if events := [*gone, *coming]:
            self._emit(*events)
        for date in missing:
            if _unbound(date):
                self._bind(date, "")
        self._judge(wanted)
        left = [one for one in coming if one.tentative and self._core.booking(one.booking.id) is not None]
        if left:
            self._emit(*(replace(one, tentative=False) for one in left))
        self._conflicts = {name: by for name, by in self._conflicts.items() if name in wanted}
        self._judged = {name: found for name, found in self._judged.items() if name in self._conflicts}
        self._danger = {name: why for name, why in self._danger.items() if name in wanted}

    def _has(self, name: str) -> bool:
        """Whether there is a record of the booking whose date this is."""
        return self._records.get(name.partition("@")[0]) is not None

    def _is_settled(self, name: str) -> bool:
        """Whether a date is in conflict as it was when that was found: to enter it again would only ask RCs again for
        votes that are forgotten as it goes."""
        by = self._conflicts.get(name)
        if by is None or (by and self._core.booking(by) is None):
            return False
        return self._judged.get(name) == self._situation(by)

    def _situation(self, by: str) -> tuple[str, int, Mapping[Need, RcName]]:
        """What a conflict with that date follows from. For its patterns other RCs may be kept later."""
        kept = self._core.booking(by)
        return self._records.digest(), self._joined, {} if kept is None else kept.bound

    def _judge(self, wanted: dict[str, Date]) -> None:
        # What is held was not moved as fleet time was slewed: what comes right after it would seem to meet it.
        starts = {name: self.local(date.start) for name, date in wanted.items()}
        found = self._core.overlaps(wanted, starts)
        self._waits_for_votes = bool(found.unknown)
        self.ask(found.unknown)
        self._conflicts = {name: by for name, by in self._conflicts.items() if self._core.booking(name) is None}
        for name, by in found.losers.items():
            self._emit(Unbooked(name, at_present=True))
            # The core does not tell of it any more, and begins anew where it is entered again.
            self._danger.pop(name, None)
            self._bind(wanted[name], by)

    def _bind(self, date: Date, by: str) -> None:
        """Enters a date with RCs for its patterns that are free then; if there are none, `by` is in its way."""
        if any(map(is_pattern, date.record.needs)):
            record = replace(date.record, kept={})
            if (booked := self._booked(Date(record, date.start))) is None:
                return
            found = self._core.slots(booked.booking, booked.booking.start, 1, bookings_only=True)
            if found.unknown:
                self._waits_for_votes = True
                self.ask(found.unknown, booked.booking)
                if not by:
                    return  # it is looked at again when they are in
            elif found.found:
                # Another of its dates may have been bound just now.
                latest = self._records.get(date.record.id) or date.record
                self._conflicts.pop(date.id, None)
                new = self.change(latest, kept={**latest.kept, date.start: dict(found.found[0].bound)})
                if (again := self._booked(Date(new, date.start))) is not None:
                    self._emit(again)
                return
        self._conflicts[date.id], self._judged[date.id] = by, self._situation(by)

    def ask(self, unknown: Iterable[tuple[Rc, HolderSet]], wanted: Booking | None = None) -> None:
        """Has RCs vote; `wanted` is not among the claims yet."""
        self._vote(self._core.ask_votes(unknown, wanted))

    def redate(self) -> bool:
        """Puts right the dates that fleet time, which was slewed, has moved; whether another time goes on, by which
        others may be to come."""
        now = self._now()
        ahead = self.clock.at(now) - now
        moved = self._dated_by - ahead
        if abs(moved) < REDATED:
            return False
        self._dated_by = ahead
        if events := [Redated(one.id, one.start + moved) for one, _ in self._core.bookings()]:
            self._emit(*events)
        return abs(moved) > STEPPED

    def number(self) -> Grant:
        """(term, seq) of what is made or changed now: above all that is known. Where all hosts were started anew terms
        began anew."""
        own = Grant(self._core.term, self._core.number())
        latest = max((record.changed for record in self._records), default=own)
        return own if own > latest else Grant(latest.term, latest.seq + 1)

    def change(self, record: BookingRecord, **to: object) -> BookingRecord:
        """The record, changed in this term."""
        changed = self.number()
        new = replace(record, changed=changed, **to)
        self._records.take([new])
        self._changed([new])
        return self._records.get(record.id) or new

    def note(self, events: Collection[Event], effects: Iterable[Effect], *, settled: bool) -> bool:
        """What became of dates in an instant; whether `reconcile` is to be called, in another one. What was used by a
        time that is not `settled` may still be to come."""
        over: dict[str, list[Instant]] = {}
        lapsed = False
        for effect in effects:
            match effect:
                case BookingChanged(booking=name, state=BookingState.USED, arc=str()) if settled:
                    booking, _, start = name.partition("@")
                    over.setdefault(booking, []).append(int(start))
                case BookingChanged(state=BookingState.LAPSED | BookingState.USED):
                    # That follows from the time alone, and so is not kept.
                    lapsed = True
                case BookingThreatened(booking=name, reason=None):
                    self._danger.pop(name, None)
                case BookingThreatened(name, Reason() as reason) if (date := self.date(name)) is not None:
                    self._danger[name] = reason.text(partial(self._told, date.record.zone))
        for booking, starts in over.items():
            if (record := self._records.get(booking)) is not None:
                self.change(record, over=sorted({*record.over, *starts}))
        self._joined += (joined := sum(isinstance(event, RcJoined) for event in events))
        votes = self._waits_for_votes and any(isinstance(event, (Vote, VoteOverdue)) for event in events)
        relieved = not all(map(self._is_settled, self._conflicts))
        return bool(over) or lapsed or votes or bool(joined) or relieved

    def _told(self, zone: str, time: Ns) -> str:
        return told(self.to_fleet(time) / SECOND, zone)

    def dangers(self) -> dict[str, str]:
        """By date, as the core calls it: what may keep it from its start, in words."""
        return self._danger | {name: self._conflict(by) for name, by in self._conflicts.items()}

    def date(self, name: str) -> Date | None:
        """What the core calls so; None: its booking is forgotten."""
        booking, _, start = name.partition("@")
        record = self._records.get(booking)
        return None if record is None else Date(record, int(start))

    def _conflict(self, by: str) -> str:
        return f"{self._name(by)} takes precedence" if by else "no matching device is free then"

    # For people and programs

    def standing(self, record: BookingRecord) -> list[Date]:
        """The dates of a booking that are in the core."""
        return [date for date in self.open_dates(record) if self._core.booking(date.id) is not None]

    def view(self, record: BookingRecord) -> BookingView:
        told, runtime = [], round(record.runtime)
        for date in self.open_dates(record):
            kept, by = self._core.booking(date.id), self._conflicts.get(date.id)
            taken = kept.arc if kept is not None else None
            state: DateState = "conflict" if by is not None else "open" if taken is None else "taken"
            danger = self._danger.get(date.id, "") if by is None else self._conflict(by)
            if kept is None and by is None and self._waits_for_votes:
                danger = "a shared device has not yet answered whether it can carry it"
            bound = dict(kept.bound) if kept is not None else date.bound
            told.append(BookedDate(date.start, date.start + runtime, state, bound, taken, danger))
        fields = {name: getattr(record, name) for name in BookingView.__struct_fields__ if name != "dates"}
        return BookingView(**fields, dates=told)

    def _name(self, date: str) -> str:
        record = self._records.get(date.partition("@")[0])
        return date if record is None else f"{record.name} of {record.owner}"

    def taken_by(self, date: Date) -> ArcId | None:
        kept = self._core.booking(date.id)
        return kept.arc if kept is not None else None


def start_of(name: str) -> Instant | None:
    """When the date begins that the core calls so, as others may tell of it; None: it is none."""
    _, _, start = name.partition("@")
    return int(start) if start.isascii() and start.isdecimal() and len(start) <= MAX_DIGITS else None


def _unbound(date: Date) -> bool:
    return not date.bound and any(map(is_pattern, date.record.needs))
