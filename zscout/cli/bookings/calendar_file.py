"""Read the events of an iCalendar file. Pure; the file is untrusted.

icalendar unfolds lines and parses values, but only of the properties used here, and never a VTIMEZONE, whose rules may
be endless: zones come from the IANA database, by their IANA or Windows names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from typing import Any, Final, NamedTuple
from zoneinfo import ZoneInfo

from icalendar import vDDDTypes, vDuration, vRecur
from icalendar.parser import Contentline, Contentlines
from icalendar.timezone.windows_to_olson import WINDOWS_TO_OLSON

from zscout.behaviors.client.identity import bounded
from zscout.cli.bookings.recurrence import RepeatRule, parse_rule
from zscout.cli.dates import YEARS
from zscout.config.strict import BadInput, Where, quoted
from zscout.services.bookings.calendar_text import NEEDS
from zscout.services.bookings.dates import zone_of

MAX_BYTES: Final = 5_000_000
"""Size of a file."""
MAX_EVENTS: Final = 5_000
MAX_DEPTH: Final = 8
MAX_LINE: Final = 100_000
"""Characters of a line."""
MAX_VALUES: Final = 1_000
"""Lines of one property in one event, and dates in all of them."""
MAX_WORDS: Final = 200
"""Characters of a title, a place, a resource."""
MAX_TEXTS: Final = 50
READ: Final = frozenset(
    "UID SUMMARY LOCATION RESOURCES ATTENDEE DTSTART DTEND DURATION RRULE RDATE EXDATE RECURRENCE-ID STATUS "
    f"TRANSP {NEEDS}".split()
)
_NAME: Final = re.compile(r"[ \t]*([A-Za-z0-9-]{1,32})[ \t]*[;:]")
_COMMA: Final = re.compile(r"(?<!\\),")


class Moment(NamedTuple):
    """A date or local time of a file, in `zone`; None: in the reader's zone."""

    local: datetime
    zone: ZoneInfo | None
    whole_day: bool = False

    def instant(self, zone: ZoneInfo) -> int:
        """Return whole seconds since 1970. `zone`: the reader's."""
        return round(self.local.replace(tzinfo=self.zone or zone).timestamp())


@dataclass(slots=True)
class CalendarEvent:
    """A VEVENT. `problem`: the reason that it can't be booked, in words."""

    uid: str = ""
    title: str = ""
    words: list[str] = field(default_factory=list)
    """Texts that may name its devices: resources, places, title."""
    resources: list[str] = field(default_factory=list)
    needs: str = ""
    """Devices as zscout's own export writes them."""
    start: Moment | None = None
    end: Moment | None = None
    duration: timedelta | None = None
    rule: RepeatRule | None = None
    more: list[Moment] = field(default_factory=list)
    without: list[Moment] = field(default_factory=list)
    instead_of: Moment | None = None
    """The date of the repeated event of this `uid` that this event replaces (RECURRENCE-ID)."""
    cancelled: bool = False
    free: bool = False
    """TRANSP:TRANSPARENT: the owner of the calendar is free at this time."""
    problem: str = ""


def read_calendar(data: bytes, source: str) -> list[CalendarEvent]:
    """In the file's order; an unreadable event has a `problem`. Raises BadInput for no calendar, or a large file."""
    where = Where(source)
    if len(data) > MAX_BYTES:
        raise where.bad(f"has more than {MAX_BYTES:,} bytes", "export less, such as only the coming year")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise where.bad("is not UTF-8, so it is not an iCalendar file", "export it as .ics again") from None
    return [_event(lines) for lines in _components(_lines(text), where)]


def _lines(text: str) -> Contentlines:
    found: Contentlines = Contentlines.from_ical(text)  # type: ignore[no-untyped-call]
    return found


def _components(lines: Contentlines, where: Where) -> Iterator[dict[str, list[Contentline]]]:
    """Yield the lines of each VEVENT, by property, for the properties in READ. Raises BadInput."""
    inside: list[str] = []
    found: dict[str, list[Contentline]] = {}
    events = calendars = 0
    for line in lines:
        named = _NAME.match(line)
        name = named[1].upper() if named is not None else ""
        if not inside and name != "BEGIN":
            if line.strip():
                raise where.bad("is not an iCalendar file", "export it as .ics, beginning with BEGIN:VCALENDAR")
        elif name == "BEGIN":
            inside.append(line.partition(":")[2].strip().upper()[:32])
            if inside[0] != "VCALENDAR" or len(inside) > MAX_DEPTH:
                raise where.bad("is not an iCalendar file, or is nested too deep", "export it as .ics again")
            if inside == ["VCALENDAR", "VEVENT"]:
                events, found = events + 1, {}
                if events > MAX_EVENTS:
                    raise where.bad(f"has more than {MAX_EVENTS} events", "export less, such as only the coming year")
        elif name == "END":
            if inside.pop() != line.partition(":")[2].strip().upper()[:32]:
                raise where.bad("has an END without its BEGIN", "export it again")
            calendars += not inside
            if inside == ["VCALENDAR"] and line.upper().endswith("VEVENT"):
                yield found
        elif inside == ["VCALENDAR", "VEVENT"] and name in READ:
            found.setdefault(name, []).append(line)
    if inside or not calendars:
        # In half a file events would seem to have been deleted.
        raise where.bad("ends before its END:VCALENDAR", "download or export it again")


def _event(lines: Mapping[str, list[Contentline]]) -> CalendarEvent:
    event = CalendarEvent()
    try:
        if any(len(some) > MAX_VALUES or any(len(line) > MAX_LINE for line in some) for some in lines.values()):
            raise ValueError("it is too long")
        values = {name: [_parts(line) for line in some] for name, some in lines.items()}
        _read_words(event, values)
        _read_dates(event, values)
    except (ValueError, TypeError, OverflowError, LookupError, ArithmeticError, AttributeError, BadInput) as error:
        event.problem = bounded(str(error), MAX_WORDS)
    return event


def _parts(line: Contentline) -> tuple[Mapping[str, Any], str]:
    _, params, value = line.raw_parts()
    return params, value.strip()


_Values = Mapping[str, list[tuple[Mapping[str, Any], str]]]


def _read_words(event: CalendarEvent, values: _Values) -> None:
    def texts(name: str, *, several: bool = False) -> list[str]:
        found = [value for _, value in values.get(name, [])[:MAX_TEXTS]]
        parts = [part for value in found for part in (_COMMA.split(value) if several else [value])]
        return [bounded(_plain(part), MAX_LINE if name == NEEDS else MAX_WORDS) for part in parts[:MAX_TEXTS]]

    def first(name: str) -> str:
        return next(iter(texts(name)), "")

    event.uid, event.title = first("UID"), first("SUMMARY")
    event.resources = texts("RESOURCES", several=True)
    rooms = [params for params, _ in values.get("ATTENDEE", []) if params.get("CUTYPE") in ("RESOURCE", "ROOM")]
    invited = [bounded(str(params.get("CN", "")), MAX_WORDS) for params in rooms[:MAX_TEXTS]]
    event.words = [text for text in (*event.resources, *invited, *texts("LOCATION"), event.title) if text]
    event.needs = first(NEEDS)
    event.cancelled = first("STATUS").upper() == "CANCELLED"
    event.free = first("TRANSP").upper() == "TRANSPARENT"


def _plain(text: str) -> str:
    return re.sub(r"\\(.)", lambda found: " " if found[1] in "nN" else found[1], text)


def _read_dates(event: CalendarEvent, values: _Values) -> None:
    """Raises ValueError."""
    for name in ("DTSTART", "DTEND", "DURATION", "RRULE", "RECURRENCE-ID"):
        if len(values.get(name, [])) > 1:
            raise ValueError(f"it has {name} more than once")
    if "RECURRENCE-ID" in values:
        params, value = values["RECURRENCE-ID"][0]
        if "RANGE" in params:
            raise ValueError("it replaces a whole range of dates (RANGE), which zscout can't import")
        event.instead_of = _moment(params, value)
    if "DTSTART" not in values:
        raise ValueError("it has no DTSTART")
    event.start = _moment(*values["DTSTART"][0])
    if "DTEND" in values:
        event.end = _moment(*values["DTEND"][0])
    elif "DURATION" in values:
        event.duration = vDuration(values["DURATION"][0][1]).td
    if "RRULE" in values:
        event.rule = parse_rule(vRecur.from_ical(values["RRULE"][0][1]))
    event.more, event.without = (_moments(values.get(name, [])) for name in ("RDATE", "EXDATE"))


def _moments(values: list[tuple[Mapping[str, Any], str]]) -> list[Moment]:
    """Raises ValueError."""
    found = [(params, text) for params, value in values for text in value.split(",")]
    if len(found) > MAX_VALUES:
        raise ValueError(f"it has more than {MAX_VALUES} dates")
    return [_moment(params, text.strip()) for params, text in found]


def _moment(params: Mapping[str, Any], value: str) -> Moment:
    """Raises ValueError."""
    at = vDDDTypes.from_ical(value)  # type: ignore[no-untyped-call]
    if not isinstance(at, date) or at.year not in YEARS:
        raise ValueError(f"{quoted(value)} is not a date")
    if not isinstance(at, datetime):
        return Moment(datetime(at.year, at.month, at.day), None, whole_day=True)  # noqa: DTZ001 - a local time
    if at.tzinfo is not None:
        return Moment(at.astimezone(UTC).replace(tzinfo=None), zone_of("UTC"))
    named = params.get("TZID")
    return Moment(at, None if named is None else _zone(str(named)))


def _zone(named: str) -> ZoneInfo:
    """Find a zone by its TZID, which may have a prefix: `/example.org/20260101/Europe/Berlin`. Raises ValueError."""
    name = named.strip().strip('"')
    parts = WINDOWS_TO_OLSON.get(name, name).strip("/").split("/")
    for count in (len(parts), 3, 2, 1):
        try:
            return zone_of("/".join(parts[-count:])[:64])
        except ValueError:
            continue
    raise ValueError(f"its time zone {quoted(name)} is not an IANA zone")
