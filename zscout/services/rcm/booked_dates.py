"""The ranked dates of all bookings, for the core of a leader. Of two dates that conflict the core keeps the date of
higher priority, else of the older booking. Its decisions are reported in views, and stored in records where needed."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from decimal import Decimal
from functools import partial
from operator import attrgetter
from typing import NamedTuple

from msgspec.structs import replace

from zscout.keyexpr import check_maintained, check_need
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
from zscout.rcm.steps import BookedDanger, Outbox
from zscout.scheduling.booking import (
    Booking,
    BookingBound,
    BookingChanged,
    BookingConflict,
    BookingState,
    BookingThreatened,
    Dates,
)
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, Effect
from zscout.scheduling.reason import Reason
from zscout.services.bookings.dates import DAY, Repetition, in_zone
from zscout.services.bookings.fleet_clock import FleetClock
from zscout.services.bookings.records import Records
from zscout.types import SECOND, Grant, Need, Ns, RcName

MAX_CLAIMS = 4_000
"""Dates of all bookings in the core at most; repeated bookings have their dates of the next 60 days there."""
PART = 100
"""Dates in one event for the core, which takes it some 5 ms."""
MAX_DIGITS = 11
"""Digits of an instant at most."""
SKIPPED = "the fleet's clock was put forward past it"


class Date(NamedTuple):
    """One date of a booking."""

    record: BookingRecord
    start: Instant

    @property
    def id(self) -> str:
        """The core's name of this date."""
        return f"{self.record.id}@{self.start}"

    @property
    def bound(self) -> dict[Need, RcName]:
        return self.record.kept.get(self.start, {})


class _Expanded(NamedTuple):
    record: BookingRecord
    rank: tuple[int, Grant, str]
    ahead: Ns
    """Fleet time less the host's clock, for the start of each date."""
    until: float
    """The fleet time until which `bookings` are complete and current."""
    next: float
    """The first date beyond the window, if the booking is repeated; else infinite."""
    bookings: list[Booking]


class BookedDates:
    """The caller sets `now`, by the host's clock."""

    def __init__(self, core: Core, records: Records, clock: FleetClock) -> None:
        self._core, self._records, self.clock = core, records, clock
        self.now: Ns = 0
        self.out = Outbox()
        """Results of the present step, until the caller takes them."""
        self._conflicts: dict[str, str] = {}
        """Dates that are not kept, each with the date that takes precedence; empty: no RC matches a pattern."""
        self._repetitions: dict[str, tuple[tuple[object, ...], Repetition]] = {}
        self._expanded: dict[str, _Expanded] = {}
        self._sent: frozenset[str] = frozenset()
        """Dates in the core."""
        self._danger: dict[str, str] = {}
        """By date: the reason that it may not be kept, as text for people."""
        self._dated_by: Ns = clock.at(0)
        """Fleet time less the host's clock, the same for all dates in the core, so that adjacent dates stay adjacent
        there."""
        self._moved: Ns = 0
        """The shift of the dates in the core that `reconcile` has not sent yet."""

    @property
    def time(self) -> float:
        """The core's fleet time, in seconds since 1970 (UTC)."""
        return self.to_fleet(self.now) / SECOND

    def local(self, instant: Instant) -> Ns:
        return instant * SECOND - self._dated_by

    def to_fleet(self, time: Ns) -> Ns:
        """The fleet time, in ns since 1970 (UTC), of a time on the core's clock."""
        return time + self._dated_by

    def claim(self, date: Date, *, taken: bool = False) -> Booking:
        """The core's booking for a date; if `taken`, it lapses only at its end. Raises ValueError if malformed."""
        record = date.record
        for need in record.needs:
            (check_maintained if record.maintenance else check_need)(need)
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
            urgent=record.urgent,
            lasting=record.lasting,
            broken=record.broken,
        )

    def dated(self, request: ArcRequest) -> ArcRequest:
        """The request with the start of the date that it takes up, which the core may not know."""
        start = start_of(request.booking)
        return request if start is None else replace(request, not_before=self.local(start))

    def open_dates(self, record: BookingRecord, taken: Collection[str] = ()) -> list[Date]:
        """Its dates that are not over; of a repeated booking for the next 60 days. `taken` dates do not lapse."""
        if record.unbooked:
            return []
        if not 0 < record.runtime <= MAX_AHEAD or (starts := self._starts(record)) is None:
            return []
        final = {*record.dropped, *record.over}
        left = [Date(record, start) for start in starts if start not in final]
        return [date for date in left if date.id in taken or not self._lapsed(date)]

    def _starts(self, record: BookingRecord) -> list[Instant] | None:
        """The dates of a booking that are not past; None: the record is malformed, which is logged."""
        time = self.time
        try:
            return self._repetition(record).between(time - float(record.runtime), time + _ahead(record))
        except (ValueError, OverflowError) as error:
            self.out.strange.append((record.id, f"booking {record.id} is not kept: {error}"))
            return None

    def _repetition(self, record: BookingRecord) -> Repetition:
        rule = record.start, record.every, record.until, record.zone
        known = self._repetitions.get(record.id)
        if known is None or known[0] != rule:
            known = self._repetitions[record.id] = rule, Repetition(record)
        return known[1]

    def until_next_date(self) -> float:
        """Seconds until a repeated booking has one more date within 60 days; infinite if none is repeated."""
        return min((known.next for known in self._expanded.values()), default=math.inf) - WINDOW - self.time

    def _lasting(self) -> list[BookingRecord]:
        return [
            record for record in self._records if record.lasting and not record.unbooked and _end(record) > self.time
        ]

    def until_renewal(self) -> float:
        """Seconds until maintenance without an end must be renewed; infinite if there is none."""
        return min(map(_end, self._lasting()), default=math.inf) - WINDOW / 2 - self.time

    def renew(self) -> None:
        """To 60 days from now, where less than half of that is left."""
        for record in self._lasting():
            if _end(record) - self.time <= WINDOW / 2:
                self._restart(record)

    def _restart(self, record: BookingRecord) -> None:
        """Let maintenance without an end begin now, for 60 days."""
        self.change(record, start=int(self.time), runtime=Decimal(WINDOW), patience=Decimal(WINDOW))

    def _lapsed(self, date: Date) -> bool:
        """Return True if no request took the date up in time. It follows from the time alone, so it is not stored."""
        waits = date.record.runtime if date.record.maintenance else min(date.record.patience, date.record.runtime)
        if self.local(date.start) + round(waits * SECOND) > self.now:
            return False
        kept = self._core.booking(date.id)
        return kept is None or kept.arc is None

    def recovered(self, taken: Collection[str]) -> Dates:
        """`taken`: dates that ARCs have taken up."""
        found = Dates(tuple(self._ranked(taken)))
        self._sent = frozenset(booking.id for booking in found.ranked)
        return found

    def parts(self) -> Iterator[Dates]:
        """The dates of `recovered` in bounded events, sent before it; without lapsed ones that may prove taken."""
        part = list[Booking]()
        for record in list(self._records):
            known = self._expanded[record.id] = self._expand(record, ())
            part += known.bookings
            if len(part) >= PART:
                yield Dates(tuple(part), more=True)
                part = []

    def _ranked(self, taken: Collection[str] = ()) -> list[Booking]:
        """All dates as bookings of the core, best-ranked first."""
        time, before, ahead = self.time, self._expanded, self._dated_by
        looked_up = {name.partition("@")[0] for name in taken}
        expanded = [
            known
            if (known := before.get(record.id)) is not None
            and known.record is record
            and known.ahead == ahead
            and time < known.until
            and record.id not in looked_up
            else self._expand(record, taken)
            for record in self._records
        ]
        expanded.sort(key=attrgetter("rank"))
        self._expanded = {known.record.id: known for known in expanded}
        found = [booking for known in expanded for booking in known.bookings]
        if len(found) > MAX_CLAIMS:
            self.out.strange.append(("", f"more than {MAX_CLAIMS} dates are booked: the last are not kept"))
        return found[:MAX_CLAIMS]

    def _expand(self, record: BookingRecord, taken: Collection[str]) -> _Expanded:
        time = self.time
        bookings, dates = list[Booking](), self.open_dates(record, taken)
        try:
            if dates:
                first_claim = self.claim(dates[0])
                bookings = [
                    first_claim,
                    *(
                        replace(first_claim, id=date.id, start=self.local(date.start), bound=date.bound)
                        for date in dates[1:]
                    ),
                ]
                bookings = [
                    replace(claim, patience=claim.runtime) if claim.id in taken else claim for claim in bookings
                ]
        except ValueError as error:
            self.out.strange.append((record.id, f"booking {record.id} is not kept: {error}"))
        coming, ahead = math.inf, _ahead(record)
        if not record.unbooked and (bookings or not dates):
            with suppress(ValueError, OverflowError):  # logged by `_starts`
                coming = self._repetition(record).first_from(time + ahead)
        first = min((date.start for date in dates), default=math.inf)
        until = 0.0 if first <= time or taken else min(first, coming - ahead)
        rank = -record.priority, record.made, record.id
        return _Expanded(record, rank, self._dated_by, until, coming if record.every else math.inf, bookings)

    def reconcile(self) -> Dates:
        """The event that replaces the core's claims by the dates of the records."""
        ranked = tuple(self._ranked())
        before, self._sent = self._sent, frozenset(booking.id for booking in ranked)
        # A date without a record may return: no keeper stored the record, but another host may have it.
        gone = before - self._sent
        event = Dates(ranked, frozenset(name for name in gone if self.date(name) is None), moved=self._moved)
        self._moved = 0
        for name in gone:
            self._conflicts.pop(name, None)
            self._danger.pop(name, None)
        if len(self._repetitions) > 2 * len(self._records) + 64:
            self._repetitions = {name: known for name, known in self._repetitions.items() if self._records.get(name)}
        return event

    def redate(self, *, settled: bool) -> bool:
        """Follow a step of fleet time. Return True if there was one: all dates must be reconciled. If fleet time is
        `settled`, skipped dates are reported, and maintenance without an end restarts now. A taken date is over if its
        end is now past, or if its ARC holds RCs and its start is now in the future: the ARC continues without a
        booking, so that no date begins twice."""
        now, ahead = self.now, self.clock.at(self.now) - self.now
        if ahead == self._dated_by:
            return False
        self._moved += self._dated_by - ahead
        self._dated_by = ahead
        skipped, over = dict[str, list[Date]](), dict[str, list[Instant]]()
        for booking, arc in self._core.bookings() if settled else ():
            if (date := self.date(booking.id)) is None:
                continue
            start, status = self.local(date.start), None if arc is None else self._core.arc(arc)
            end, lapses = start + booking.runtime, start + booking.lapses - booking.start
            if date.record.lasting and booking.start <= now:
                self._restart(date.record)
                continue
            if booking.start > now and (lapses if status is None else end) <= now:
                skipped.setdefault(date.record.id, []).append(date)
            if status is not None and (end <= now or (status.hold is not None and now < start)):
                over.setdefault(date.record.id, []).append(date.start)
        for dates in skipped.values():
            first = min(dates, key=lambda date: date.start)
            self.out.dangers.append(BookedDanger(*first, SKIPPED, len(dates) - 1, over=True))
        self._end_dates(over)
        return True

    def _end_dates(self, over: Mapping[str, Collection[Instant]]) -> None:
        """Store that these dates of bookings are over."""
        for booking, starts in over.items():
            if (record := self._records.get(booking)) is not None:
                self.change(record, over=sorted({*record.over, *starts}))

    def number(self) -> Grant:
        """The (term, seq) of a change now: above all known records, even if terms restarted with the fleet."""
        own = Grant(self._core.term, self._core.number())
        latest = self._records.latest
        return own if own > latest else Grant(latest.term, latest.seq + 1)

    def change(self, record: BookingRecord, **to: object) -> BookingRecord:
        """Change a record, store it, and have it shared. Return the stored record."""
        changed = self.number()
        new = replace(record, changed=changed, **to)
        self._records.take([new])
        self.out.changed.append(new)
        return self._records.get(record.id) or new

    def note(self, effects: Iterable[Effect], *, settled: bool) -> bool:
        """Note the effects on dates. Return True if `reconcile` must be called in another instant. Unless fleet time is
        `settled`, used dates are not stored as over: they may still be in the future."""
        over: dict[str, list[Instant]] = {}
        lapsed = False
        for effect in effects:
            match effect:
                case BookingChanged(booking=name, state=BookingState.USED, arc=str()) if settled:
                    booking, _, start = name.partition("@")
                    over.setdefault(booking, []).append(int(start))
                case BookingChanged(state=BookingState.LAPSED | BookingState.USED):
                    # This follows from the time alone, so it is not stored.
                    lapsed = True
                case BookingThreatened(booking=name, reason=None):
                    self._danger.pop(name, None)
                case BookingThreatened(name, Reason() as reason) if (date := self.date(name)) is not None:
                    self._danger[name] = reason.text(partial(self._text, date.record.zone))
                case BookingConflict(booking=name, by=None):
                    self._conflicts.pop(name, None)
                case BookingConflict(booking=name, by=str() as by):
                    # The core no longer reports this date's danger; once the conflict ends, it reports it again.
                    self._danger.pop(name, None)
                    self._conflicts[name] = by
                case BookingBound(booking=name, bound=bound) if (date := self.date(name)) is not None:
                    self.change(date.record, kept={**date.record.kept, date.start: dict(bound)})
        self._end_dates(over)
        return bool(over) or lapsed

    def _text(self, zone: str, time: Ns) -> str:
        return in_zone(self.to_fleet(time) / SECOND, zone)

    def dangers(self) -> dict[str, str]:
        """By the core's name of a date: the reason that it may not begin, as text for people."""
        return self._danger | {name: self._conflict(by) for name, by in self._conflicts.items()}

    def date(self, name: str) -> Date | None:
        """The date of this name in the core; None: there is no record of its booking."""
        booking, _, start = name.partition("@")
        record = self._records.get(booking)
        return None if record is None else Date(record, int(start))

    def _conflict(self, by: str) -> str:
        if not by:
            return "no matching device is free then"
        date = self.date(by)
        return f"{by if date is None else f'{date.record.name} of {date.record.owner}'} takes precedence"

    def dates_in_core(self, record: BookingRecord) -> list[Date]:
        return [date for date in self.open_dates(record) if self._core.booking(date.id) is not None]

    def view(self, record: BookingRecord) -> BookingView:
        views, runtime, maintained = [], round(record.runtime), list[RcName]()
        for date in self.open_dates(record):
            kept, by = self._core.booking(date.id), self._conflicts.get(date.id)
            taken = kept.arc if kept is not None else None
            state: DateState = "conflict" if by is not None else "open" if taken is None else "taken"
            danger = self._danger.get(date.id, "") if by is None else self._conflict(by)
            if by is None and kept is not None and kept.is_unbound and not danger:
                danger = "a shared device has not yet answered whether it can carry it"
            bound = dict(kept.bound) if kept is not None else date.bound
            views.append(BookedDate(date.start, date.start + runtime, state, bound, taken, danger))
            if kept is not None and record.needs.keys() != {*kept.maintained}:
                maintained = sorted(kept.maintained)
        fields = {name: getattr(record, name) for name in BookingView.__struct_fields__ if hasattr(record, name)}
        return BookingView(**fields, dates=views, maintained=maintained)


def start_of(name: str) -> Instant | None:
    """The start in a date's name, which may come from another host; None: it has no valid start."""
    _, _, start = name.partition("@")
    return int(start) if start.isascii() and start.isdecimal() and len(start) <= MAX_DIGITS else None


def _end(record: BookingRecord) -> float:
    """Of a booking that is not repeated."""
    return record.start + float(record.runtime)


def _ahead(record: BookingRecord) -> float:
    return WINDOW if record.every else MAX_AHEAD + DAY  # the clock may have been ahead when it was booked
