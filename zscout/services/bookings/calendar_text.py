"""Bookings as iCalendar (RFC 5545). Pure; equal bookings give equal texts.

A repeated booking is one event in its zone; all others are in UTC, without ambiguous hours. Durations are in hours:
days vary where clocks change."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import Final, NamedTuple
from zoneinfo import ZoneInfo

from icalendar import Calendar, Event, Timezone, TimezoneDaylight, TimezoneStandard, vRecur, vText

from zscout.keyexpr import is_pattern, matcher
from zscout.messages import MAX_AHEAD, BookedDate, BookingView, Instant
from zscout.services.bookings.dates import zone_of
from zscout.types import clean

CONTENT_TYPE: Final = "text/calendar; charset=utf-8"
REFRESH: Final = "PT15M"  # suggested reload interval; programs may ignore it
NEEDS, PRIORITY, PATIENCE = "X-ZSCOUT-NEEDS", "X-ZSCOUT-PRIORITY", "X-ZSCOUT-PATIENCE"


class CalendarSelection(NamedTuple):
    owner: str | None = None
    rc: str | None = None

    def name(self, fleet: str) -> str:
        return " ".join(filter(None, (fleet, self.rc, self.owner)))

    @property
    def path(self) -> str:
        """The path on the server: `fleet.ics`, `rc/robot/arm1.ics`, `owner/anvil.ics`."""
        if self.rc is not None:
            return f"rc/{self.rc}.ics"
        return f"owner/{self.owner}.ics" if self.owner is not None else "fleet.ics"

    def of(self, bookings: Iterable[BookingView]) -> list[BookingView]:
        return [
            view
            for view in bookings
            if self.owner in (None, view.owner)
            and (self.rc is None or self.rc in (*view.needs, *view.maintained) or _may_have(view, self.rc))
        ]


EVERYTHING: Final = CalendarSelection()


def calendar_text(fleet: str, bookings: Iterable[BookingView], selection: CalendarSelection = EVERYTHING) -> bytes:
    """The calendar of the selected bookings. Lines end in CR LF, as the format requires."""
    calendar = Calendar()
    calendar.add("VERSION", "2.0")
    calendar.add("PRODID", "-//zscout//zscout//EN")
    calendar.add("X-WR-CALNAME", selection.name(fleet))
    calendar.add("REFRESH-INTERVAL", vText(REFRESH, params={"VALUE": "DURATION"}), encode=False)
    calendar.add("X-PUBLISHED-TTL", REFRESH)
    zones: dict[str, list[int]] = {}
    events: list[Event] = []
    for view in sorted(selection.of(bookings), key=lambda booking: (booking.start, booking.id)):
        zone = _zone(view)
        if zone is None:
            events += [_event(fleet, view, date.start, date) for date in view.dates] or [
                _event(fleet, view, view.start)
            ]
            continue
        zones.setdefault(view.zone, []).extend((view.start, _until(view)))
        events += _repeated(fleet, view, zone)
    for name, instants in sorted(zones.items()):
        first, last = (datetime.fromtimestamp(at, UTC).year for at in (min(instants), max(instants)))
        calendar.add_component(_timezone(name, first, last))
    for event in events:
        calendar.add_component(event)
    return bytes(calendar.to_ical())


def _may_have(view: BookingView, rc: str) -> bool:
    """Return True if the booking has `rc` for a pattern, or may get it."""
    bound = {name for date in view.dates for name in date.bound.values()} or view.maintained
    return rc in bound if bound else any(is_pattern(need) and matcher(need)(rc) for need in view.needs)


def _zone(view: BookingView) -> ZoneInfo | None:
    """The booking's zone; None if it is not repeated or the zone is unknown here: then each date is an event."""
    try:
        return zone_of(view.zone) if view.every else None
    except ValueError:
        return None


def _until(view: BookingView) -> Instant:
    return view.start + MAX_AHEAD if view.until is None else view.until


@lru_cache(1_024)  # a call takes milliseconds, and there are 600 zones
def _timezone(name: str, first: int, last: int) -> Timezone:
    """The zone in these years, by yearly rules where possible: some programs ignore dates after the first. icalendar's
    own function misses short periods, such as Morocco's Ramadan."""
    zone, timezone = zone_of(name), Timezone()
    timezone.add("TZID", name)
    begins, ends = (datetime(year, 1, 1, tzinfo=UTC) for year in (first - 1, last + 2))
    changes = dict[tuple[timedelta, timedelta, str], list[datetime]]()
    for at in _changes(zone, begins, ends):
        before, after = _offset(at - timedelta(seconds=1), zone), _offset(at, zone)
        change = before, after, at.astimezone(zone).tzname() or ""
        changes.setdefault(change, []).append((at + before).replace(tzinfo=None))
    if not any(times[0].year < first for times in changes.values()):
        offset = _offset(begins, zone)
        change = offset, offset, begins.astimezone(zone).tzname() or ""
        changes = {change: [(begins + offset).replace(tzinfo=None)], **changes}
    for (before, after, called), times in changes.items():
        part = TimezoneDaylight() if after > before else TimezoneStandard()
        part.add("DTSTART", times[0])
        if len(times) > 1:
            rule = _rule(times) if [at.year for at in times] == [*range(first - 1, last + 2)] else None
            part.add("RDATE" if rule is None else "RRULE", rule or times[1:])
        part.add("TZNAME", called)
        part.add("TZOFFSETFROM", before)
        part.add("TZOFFSETTO", after)
        timezone.add_component(part)
    return timezone


def _offset(at: datetime, zone: ZoneInfo) -> timedelta:
    return at.astimezone(zone).utcoffset() or timedelta()


def _changes(zone: ZoneInfo, begins: datetime, ends: datetime) -> Iterator[datetime]:
    day = timedelta(days=1)
    while begins < ends:
        low, high = begins, begins + day
        if _offset(low, zone) != (after := _offset(high, zone)):
            while high - low > timedelta(seconds=1):
                middle = (low + (high - low) / 2).replace(microsecond=0)
                low, high = (low, middle) if _offset(middle, zone) == after else (middle, high)
            yield high
        begins += day


def _rule(times: Sequence[datetime]) -> vRecur | None:
    """The yearly rule of these local times; None if no rule fits."""
    if len({(at.month, at.weekday(), at.time()) for at in times}) > 1:
        return None
    weeks = {(at.day - 1) // 7 + 1 for at in times}
    if all(at.month != (at + timedelta(days=7)).month for at in times):
        weeks = {-1}
    if len(weeks) > 1:
        return None
    day = ("MO", "TU", "WE", "TH", "FR", "SA", "SU")[times[0].weekday()]
    return vRecur({"FREQ": "YEARLY", "BYMONTH": times[0].month, "BYDAY": f"{weeks.pop()}{day}"})


def _repeated(fleet: str, view: BookingView, zone: ZoneInfo) -> list[Event]:
    first = datetime.fromtimestamp(view.start, zone)
    hour = first.time().replace(fold=0)

    def nominal(at: Instant) -> datetime:
        """A date by its rule; the real date differs on a day without that hour."""
        return datetime.combine(datetime.fromtimestamp(at, zone).date(), hour, zone)

    event = _event(fleet, view, first)
    weeks, days = divmod(view.every, 7)
    rule: dict[str, object] = {"FREQ": "DAILY" if days else "WEEKLY", "INTERVAL": view.every if days else weeks}
    event.add("RRULE", vRecur({**rule, "UNTIL": datetime.fromtimestamp(_until(view), UTC)}))
    given_up = {*view.dropped, *(date.start for date in view.dates if date.state == "unbooked")}
    for at in sorted(given_up):
        event.add("EXDATE", nominal(at))
    found = [event]
    exceptions = {date.start: date for date in view.dates if date.state == "conflict"}
    if nominal(view.start).timestamp() != view.start:
        exceptions.setdefault(view.start, BookedDate(view.start, view.start, "open"))
    for at, date in sorted(exceptions.items()):
        if at not in given_up:
            other = _event(fleet, view, at if at == view.start else nominal(at), date)
            other.add("RECURRENCE-ID", nominal(at))
            found.append(other)
    return found


def _event(fleet: str, view: BookingView, start: Instant | datetime, date: BookedDate | None = None) -> Event:
    """`date`: its details, of the first of many."""
    event = Event()
    whole = view.every and not isinstance(start, datetime) and _zone(view) is None
    event.add("UID", f"{view.id}{f'-{start}' if whole else ''}@{fleet}")
    event.add("DTSTAMP", datetime.fromtimestamp(view.since or view.start, UTC))
    event.add("SEQUENCE", len(view.dropped) + view.unbooked)
    event.add("DTSTART", start if isinstance(start, datetime) else datetime.fromtimestamp(start, UTC))
    event.add("DURATION", vText(_duration(math.ceil(view.runtime))), encode=False)
    words = f"{view.name} ({view.owner})" if view.owner else view.name
    event.add("SUMMARY", clean(f"maintenance: {words}" if view.maintenance else words))
    bound = date.bound if date is not None else {}
    rcs = view.maintained or [bound.get(need, need.partition("#")[0]) for need in sorted(view.needs)]
    event.add("LOCATION", ", ".join(rcs))
    event.add("RESOURCES", rcs)
    event.add("CATEGORIES", rcs)
    comment = view.who.comment if view.who is not None else ""
    if lines := [clean(text).strip() for text in (comment, date.danger if date is not None else "") if text]:
        event.add("DESCRIPTION", "\n".join(lines))
    tentative = date is not None and date.state == "conflict"
    event.add("STATUS", "CANCELLED" if view.unbooked else "TENTATIVE" if tentative else "CONFIRMED")
    event.add(NEEDS, " ".join(_need(need, view) for need in sorted(view.needs)))
    event.add(PRIORITY, str(view.priority))
    event.add(PATIENCE, f"{view.patience.normalize():f}")
    return event


def _need(need: str, view: BookingView) -> str:
    """A need as on the command line: `radio/rf0:command_rate=5`."""
    amounts = ",".join(f"{name}={value.normalize():f}" for name, value in sorted(view.needs[need].items()))
    return f"{need}:{amounts}" if amounts else need


def _duration(seconds: int) -> str:
    minutes, seconds = divmod(seconds, 60)
    hours, minutes = divmod(minutes, 60)
    parts = ((hours, "H"), (minutes, "M"), (seconds, "S"))
    # RFC 5545 requires minutes between hours and seconds.
    if hours and seconds:
        return f"PT{hours}H{minutes}M{seconds}S"
    return "PT" + "".join(f"{number}{unit}" for number, unit in parts if number)
