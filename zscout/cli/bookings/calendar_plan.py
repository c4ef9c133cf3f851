"""Plan the bookings for a calendar's events. Pure: the same events and options give the same ids, so a second import
recognizes what it imported before.

A booking repeats every n days: an event on two weekdays becomes two bookings, and a monthly or yearly event a booking
for each date. Nothing is booked more than a year ahead, and many events have no end: repeated events are booked in
half years, each as soon as all of it is within a year."""

from __future__ import annotations

import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from decimal import Decimal
from typing import Any, Final
from zoneinfo import ZoneInfo

from msgspec.structs import replace

from zscout.behaviors.client.bookings import PATIENCE
from zscout.behaviors.client.identity import bounded
from zscout.cli.bookings.calendar_file import CalendarEvent, Moment
from zscout.cli.bookings.recurrence import occurrences
from zscout.cli.requests.options import Needs, gather_needs, parse_need
from zscout.config.strict import BadInput
from zscout.keyexpr import BadName, check_maintained, check_need, host_in, valid_name
from zscout.messages import MAX_AHEAD, MAX_BOOKINGS, MAX_COMMENT, Book, Instant, Who
from zscout.services.bookings.dates import DAY

MAX_TIMES_BOOKED: Final = 8
"""How often one event is booked: again with --again after each cancellation."""
LOOK_BACK_S: Final = 31 * DAY
"""Events that began this long ago may not be over yet."""
OVER, FREE, CANCELLED = "over, or begun", "of people who are free then", "cancelled"
NO_RC = "naming no device"
NO_DATE = "without a date to come"
LATER = "more than a year ahead: import it again then"

Pairs = tuple[tuple[str, dict[str, Decimal]], ...]


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Options of an import. `calendar`: its name, part of the ids. `zone`: for times without a zone."""

    fleet: str
    calendar: str
    zone: ZoneInfo
    needs: Pairs = ()
    """Devices of every event."""
    mapped: Mapping[str, Pairs] = field(default_factory=dict)
    """Devices of events with these words in title, place or resources."""
    priority: int = 0
    patience: Decimal | None = None
    maintenance: bool = False
    who: Who | None = None

    @property
    def suffix(self) -> str:
        """The end of all ids of this calendar; their beginnings differ, since users name bookings by them."""
        return _hashed([self.fleet, self.calendar], 12)


@dataclass(frozen=True, slots=True)
class Wanted:
    """Uses the first of its `ids` that was not cancelled: a cancelled id can't be booked again. `book`: None if all its
    dates are dropped. `dropped`: coming dates without the event."""

    ids: tuple[str, ...]
    title: str
    book: Book | None
    dropped: tuple[Instant, ...] = ()


@dataclass(frozen=True, slots=True)
class Skipped:
    """An event that is not booked. `failed`: it needs RCs and should have been booked."""

    title: str
    why: str
    failed: bool = False


@dataclass(slots=True)
class ImportPlan:
    wanted: list[Wanted] = field(default_factory=list)
    """Repeated bookings first: an event that replaces one of their dates is free once that date is dropped."""
    skipped: list[Skipped] = field(default_factory=list)
    ids: set[str] = field(default_factory=set)
    """Ids of all events of the calendar, also of events that are over or have begun."""


def plan_import(events: Iterable[CalendarEvent], options: ImportOptions, now: float) -> ImportPlan:
    """`now`: seconds since 1970. Raises BadInput for too many."""
    events = list(events)
    moved: dict[str, set[Instant]] = defaultdict(set)
    for event in events:
        if event.uid and event.instead_of is not None:
            moved[event.uid].add(event.instead_of.instant(options.zone))
    plan = ImportPlan()
    for event in events:
        title = event.title or event.uid or "event"
        try:
            if why := _not_booked(event):
                plan.skipped.append(Skipped(title, why))
            elif event.problem:
                raise ValueError(event.problem)
            elif not (needs := _needs(event, options)):
                plan.skipped.append(Skipped(title, NO_RC))
            else:
                others = moved[event.uid] if event.instead_of is None else set[Instant]()
                _EventPlanner(plan, event, title, needs, options, now).add(others)
        except (ValueError, OverflowError, BadInput) as error:
            plan.skipped.append(Skipped(title, str(error), failed=True))
        if len(plan.wanted) > MAX_BOOKINGS:
            raise BadInput(f"the calendar would make more than {MAX_BOOKINGS} bookings; export less of it")
    plan.wanted.sort(key=lambda wanted: wanted.book is not None and not wanted.book.every)
    return plan


def _not_booked(event: CalendarEvent) -> str:
    return CANCELLED if event.cancelled else FREE if event.free else ""


def _needs(event: CalendarEvent, options: ImportOptions) -> Needs:
    """Return the needs that the options give an event, else the RCs that it names itself. Raises BadInput."""
    pairs = [*options.needs]
    for words, needs in options.mapped.items():
        pattern = re.compile(rf"(?<!\w){re.escape(words)}(?!\w)", re.IGNORECASE)
        if any(pattern.search(text) for text in event.words):
            pairs += needs
    if not pairs:
        named = event.needs.split() or [text for text in event.resources if _is_need(text)]
        pairs = [_host(text) if options.maintenance and host_in(text) else parse_need(text) for text in named]
    return gather_needs([*dict(pairs).items()])


def _host(text: str) -> tuple[str, dict[str, Decimal]]:
    """Parse `@HOST`, all devices of a host. Raises BadInput."""
    try:
        return check_maintained(text), {}
    except BadName as error:
        raise BadInput(str(error)) from None


def _is_need(text: str) -> bool:
    try:
        return bool(check_need(text))
    except BadName:
        return False


class _EventPlanner:
    def __init__(
        self, plan: ImportPlan, event: CalendarEvent, title: str, needs: Needs, options: ImportOptions, now: float
    ) -> None:
        """Raises ValueError."""
        if event.start is None:
            raise ValueError("it has no DTSTART")
        self._plan, self._event, self._title, self._needs = plan, event, title, needs
        self._options, self._now, self._start = options, now, event.start
        self._zone = event.start.zone or options.zone
        self._runtime(self._start.local)

    def add(self, moved: set[Instant]) -> None:
        """Raises ValueError."""
        event = self._event
        given_up = moved | {self._instant(moment) for moment in event.without}
        single: set[Instant] = {self._instant(moment) for moment in event.more}
        if event.rule is not None and not single and next(self._dates(), None) is None:
            later = self._start.instant(self._zone) > self._now + MAX_AHEAD
            self._plan.skipped.append(Skipped(self._title, LATER if later else NO_DATE))
        if event.rule is None:
            single.add(self._start.instant(self._zone))
        elif event.rule.step:
            for dates in self._by_half_years():
                self._add_repeated(dates, event.rule.step, given_up)
                single -= {*map(self._at, dates)}
        else:
            single |= {self._at(at) for at in self._dates()}
        for at in sorted(single - given_up):
            self._add_once(at)

    def _at(self, local: datetime) -> Instant:
        return Moment(local, self._zone).instant(self._zone)

    def _instant(self, moment: Moment) -> Instant:
        """A moment without an hour means the event's date of that day."""
        local = moment.local
        if moment.whole_day and not self._start.whole_day:
            local = datetime.combine(local.date(), self._start.local.time())
        return Moment(local, moment.zone or self._zone).instant(self._zone)

    def _dates(self) -> Iterator[datetime]:
        """Yield the local times of the event's rule in the half years that are booked now."""
        rule = self._event.rule
        if rule is None:
            return
        since = _half_year(self._local(self._now - LOOK_BACK_S))[0]
        before = _half_year(self._local(self._now + MAX_AHEAD))[1]
        until = rule.until
        if isinstance(until, datetime):
            last: float = (until.replace(tzinfo=self._zone) if until.tzinfo is None else until).timestamp()
        elif until is not None:
            last = self._at(datetime(until.year, until.month, until.day, 23, 59, 59))  # noqa: DTZ001
        for at in occurrences(rule, self._start.local, since, before):
            if until is not None and self._at(at) > last:
                return
            yield at

    def _by_half_years(self) -> list[list[datetime]]:
        found: dict[Any, list[datetime]] = defaultdict(list)
        weekly = self._event.rule is not None and self._event.rule.freq == "WEEKLY"
        for at in self._dates():
            found[_half_year(at), at.weekday() if weekly else 0].append(at)
        return [*found.values()]

    def _local(self, at: float) -> datetime:
        return datetime.fromtimestamp(at, self._zone).replace(tzinfo=None)

    def _runtime(self, begin: datetime) -> int:
        """Return the length in seconds of the date that begins at `begin`. Raises ValueError."""
        start, end, length = self._start, self._event.end, self._event.duration
        if start.whole_day:
            default = length if length is not None else timedelta(days=1)
            days = (default if end is None else end.local - start.local).days
            seconds = self._at(begin + timedelta(days=days)) - self._at(begin)
        elif end is not None:
            seconds = end.instant(self._zone) - start.instant(self._zone)
        else:
            seconds = round((length or timedelta()).total_seconds())
        if not 0 < seconds <= MAX_AHEAD:
            raise ValueError("it has no length" if seconds <= 0 else "it is longer than a year")
        return seconds

    def _add_once(self, at: Instant) -> None:
        runtime = self._runtime(self._local(at))
        if at + runtime < self._now - LOOK_BACK_S:
            self._plan.skipped.append(Skipped(self._title, OVER))
            return
        ids = self._ids(at, at, 0, runtime)
        if ids[0] in self._plan.ids:
            return
        self._plan.ids.update(ids)
        if at <= self._now or at > self._now + MAX_AHEAD:
            self._plan.skipped.append(Skipped(self._title, OVER if at <= self._now else LATER))
        else:
            self._plan.wanted.append(Wanted(ids, self._title, self._book(ids[0], at, runtime)))

    def _add_repeated(self, dates: list[datetime], step: int, given_up: set[Instant]) -> None:
        instants = [*map(self._at, dates)]
        runtime = min(map(self._runtime, dates))
        if self._start.whole_day:
            # The RCM refuses overlapping dates, and a day may be an hour shorter.
            runtime = min(runtime, step * DAY - 3_600)
        ids = self._ids(instants[0], instants[-1], step, runtime)
        if ids[0] in self._plan.ids:
            return
        self._plan.ids.update(ids)
        if instants[-1] > self._now + MAX_AHEAD:
            self._plan.skipped.append(Skipped(self._title, LATER))
            return
        coming = [at for at in instants if at > self._now]
        left = [at for at in coming if at not in given_up]
        # A booking that began on a date moved by a change of clocks would move all later dates too.
        while left and self._local(left[0]).time() != self._start.local.time():
            no_hour = f"its hour does not exist on {self._local(left.pop(0)):%Y-%m-%d}; book that date by itself"
            self._plan.skipped.append(Skipped(self._title, no_hour, failed=True))
        dropped = tuple(at for at in coming if at in given_up)
        if not coming:
            self._plan.skipped.append(Skipped(self._title, OVER))
            return
        book = None
        if left:
            every, until = (step, left[-1]) if len(left) > 1 else (0, None)
            book = self._book(ids[0], left[0], runtime, every, until)
        self._plan.wanted.append(Wanted(ids, self._title, book, dropped))

    def _book(self, booking: str, start: Instant, runtime: int, every: int = 0, until: Instant | None = None) -> Book:
        options = self._options
        patience = min(Decimal(runtime), Decimal(str(PATIENCE)) if options.patience is None else options.patience)
        return Book(
            id=booking,
            name=re.sub("-{2,}", "-", valid_name(self._title)).strip("-") or "event",
            needs=self._needs,
            priority=options.priority,
            start=start,
            runtime=Decimal(runtime),
            patience=Decimal(runtime) if options.maintenance else patience,
            zone=self._zone.key,
            every=every,
            until=until,
            maintenance=options.maintenance,
            who=replace(options.who or Who(), comment=bounded(self._title, MAX_COMMENT)),
        )

    def _ids(self, first: Instant, last: Instant, step: int, runtime: int) -> tuple[str, ...]:
        """Return the ids, which change with the event, except its title."""
        options, event = self._options, self._event
        needs = sorted(
            (name, sorted((key, str(value)) for key, value in of.items())) for name, of in self._needs.items()
        )
        of: Callable[[Moment], Instant] = self._instant
        which = None if event.instead_of is None else of(event.instead_of)
        terms = [options.priority, options.maintenance, self._zone.key if step else ""]
        known = [event.uid or self._title, which, first, last, step, runtime, needs, terms]
        return tuple(_hashed([*known, number], 20) + options.suffix for number in range(MAX_TIMES_BOOKED))


def _half_year(at: datetime) -> tuple[datetime, datetime]:
    second = at.month > 6
    begin = datetime(at.year, 7 if second else 1, 1)  # noqa: DTZ001 - local times
    return begin, datetime(at.year + second, 1 if second else 7, 1)  # noqa: DTZ001


def _hashed(parts: list[Any], digits: int) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:digits]
