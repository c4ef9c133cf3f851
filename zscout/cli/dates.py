"""Dates as people write them, in the zone of `--zone`, else in `host_zone`. Pure, except `host_zone`.

When clocks are put back or forward, a local time may come twice or never. RFC 5545 (3.3.5) decides: the first of the
two; or the time as if clocks had not been put forward yet. A note explains the choice to the user."""

from __future__ import annotations

import difflib
import math
import os
import re
import time as clocks
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path
from typing import Final
from zoneinfo import ZoneInfo, available_timezones

from zscout.config.strict import BadInput, parse_duration, quoted
from zscout.messages.bookings import DAYS, MAX_AHEAD
from zscout.types import whole_second

DATE_FORMS: Final = (
    '"now", "tue 14:00", "tomorrow 9:00", "14:30", "2026-12-01 14:00", "2026-12-01T14:00+01:00" or "in 2h"'
)
EVERY_FORMS: Final = 'day, week, "2 weeks" or "10 days"'
WEEKDAYS: Final = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
WHOLE_MINUTES_FROM_S: Final = 600.0
"""Durations at least this long, as in `in 2h`, are rounded up to a whole minute."""
YEARS: Final = range(1971, 9000)
"""Years in which every time of every zone is a valid timestamp."""
_TIME: Final = re.compile(r"(?P<hour>\d{1,2})(:(?P<minute>\d\d)(:(?P<second>\d\d))?)? ?(?P<half>am|pm)?", re.ASCII)
_DAY: Final = re.compile(r"(?P<name>[a-z]{3,9})|(?P<date>\d{4}-\d\d-\d\d)", re.ASCII)
_INSTANT: Final = re.compile(r"\d{4}-\d\d-\d\d[t ]\d\d:\d\d(:\d\d)?(?P<offset>z|[+-]\d\d:?\d\d)?", re.ASCII)
_EVERY: Final = re.compile(r"(?:(\d{1,3}) ?)?(d|day|days|w|week|weeks)", re.ASCII)
_FOLDERS: Final = re.compile(r".*/zoneinfo/(?:posix/)?")
_WORDS: Final = {"daily": 1, "weekly": 7}


@dataclass(frozen=True, slots=True)
class Found:
    """An instant in its zone; `note` explains the choice if the local time comes twice, or never."""

    at: datetime
    note: str = ""
    exists: bool = True


@dataclass(frozen=True, slots=True)
class WrittenDate:
    """A parsed date, before the current time and the zone are known."""

    text: str
    option: str
    after: float | None = None
    """Seconds from now."""
    day: date | int | str | None = None
    """A date, a weekday (0: Monday), `today`, `tomorrow`; None: the next occurrence of `time`."""
    not_today: bool = False
    """A weekday is searched after today."""
    time: time | None = None
    """None: a whole day."""
    instant: datetime | None = None

    def found(self, now: float, zone: ZoneInfo) -> Found:
        """Return the instant. `now`: seconds since 1970. Raises BadInput for a whole day."""
        if self.instant is not None:
            return Found(self.instant.astimezone(zone))
        if self.after is not None:
            unit = 1 if self.after < WHOLE_MINUTES_FROM_S else 60
            return Found(datetime.fromtimestamp(math.ceil((now + self.after) / unit) * unit, zone))
        if self.time is None:
            raise BadInput(f"{self.option}: {quoted(self.text)} has no time; write {quoted(f'{self.text} 14:00')}")
        today = datetime.fromtimestamp(now, zone).date()
        found = local(datetime.combine(self._day(today), self.time), zone)
        if found.at.timestamp() <= now and (self.day is None or isinstance(self.day, int)):
            later = timedelta(days=1 if self.day is None else 7)
            found = local(datetime.combine(self._day(today) + later, self.time), zone)
        return found

    def whole_day(self, now: float, zone: ZoneInfo) -> date | None:
        """Return the day; None if the date has a time."""
        if self.instant is not None or self.after is not None or self.time is not None:
            return None
        return self._day(datetime.fromtimestamp(now, zone).date())

    def _day(self, today: date) -> date:
        """Return the day as a date. A weekday is the next, today included."""
        match self.day:
            case date():
                return self.day
            case int():
                days = (self.day - today.weekday()) % 7
                return today + timedelta(days=days or 7 * self.not_today)
        return today + timedelta(days=self.day == "tomorrow")


def parse_date(text: str, option: str) -> WrittenDate:
    """Parse a date in one of DATE_FORMS. Raises BadInput."""
    words = " ".join(text.lower().split())
    bad = BadInput(f"{option}: {quoted(text)} is not a date; write {DATE_FORMS}")
    if words == "now":
        return WrittenDate(text, option, after=0.0)
    if words.startswith("in "):
        if (seconds := parse_duration(words.removeprefix("in ").replace(" ", ""))) is None:
            raise bad
        if seconds > MAX_AHEAD:
            raise BadInput(f"{option}: {quoted(text)} is more than a year ahead; write an earlier date")
        return WrittenDate(text, option, after=float(seconds))
    try:
        if (whole := _INSTANT.fullmatch(words)) is not None:
            at = datetime.fromisoformat(words.upper())
            if at.year not in YEARS:
                raise _out_of_reach(text, option, at.year)
            if whole["offset"]:
                return WrittenDate(text, option, instant=at)
            return WrittenDate(text, option, day=at.date(), time=at.time())
        following = words.startswith("next ")
        first, _, rest = words.removeprefix("next ").partition(" ")
        if (day := _DAY.fullmatch(first)) is None:
            return WrittenDate(text, option, time=_time(words, bad))
        meant = date.fromisoformat(day["date"]) if day["date"] else _named_day(day["name"], bad)
        if following and not isinstance(meant, int):
            raise bad
        if isinstance(meant, date) and meant.year not in YEARS:
            raise _out_of_reach(text, option, meant.year)
        return WrittenDate(text, option, day=meant, time=_time(rest, bad) if rest else None, not_today=following)
    except ValueError:  # the 30th of February, 25:00
        raise bad from None


def _out_of_reach(text: str, option: str, year: int) -> BadInput:
    if year < YEARS.start:
        return BadInput(f"{option}: {quoted(text)} is long past; write a later date")
    return BadInput(f"{option}: {quoted(text)} is more than a year ahead; write an earlier date")


def _named_day(name: str, bad: BadInput) -> int | str:
    if name in ("today", "tomorrow"):
        return name
    found = [number for number, day in enumerate(WEEKDAYS) if day.startswith(name)]
    if len(found) != 1:
        raise bad
    return found[0]


def _time(text: str, bad: BadInput) -> time:
    """Parse `14:00`, `9:00`, `2pm`. Raises BadInput, ValueError."""
    found = _TIME.fullmatch(text)
    if found is None or not (found["minute"] or found["half"]):
        raise bad
    hour = int(found["hour"])
    if found["half"]:
        if not 1 <= hour <= 12:
            raise bad
        hour = hour % 12 + 12 * (found["half"] == "pm")
    return time(hour, int(found["minute"] or 0), int(found["second"] or 0))


def local(naive: datetime, zone: ZoneInfo) -> Found:
    first, second = (naive.replace(tzinfo=zone, fold=fold) for fold in (0, 1))
    before, after = first.utcoffset(), second.utcoffset()
    if before is None or after is None or before == after:
        return Found(first)
    if before < after:  # clocks go forward
        at = datetime.fromtimestamp(first.timestamp(), zone)
        return Found(
            at, f"{naive:%Y-%m-%d %H:%M} does not exist in {zone.key}: {at:%H:%M} is used instead", exists=False
        )
    other = f"{second:%Y-%m-%dT%H:%M}{second.isoformat()[-6:]}"
    return Found(first, f"{naive:%Y-%m-%d %H:%M} comes twice in {zone.key}: the first is used, the other is {other}")


def remarks(dates: Iterable[int], zone: ZoneInfo, hour: time) -> list[str]:
    """Return the notes on dates repeated at the same `hour`: days on which that local time comes twice, or never."""
    days = {in_zone(at, zone).date() for at in dates}
    return [note for day in sorted(days) if (note := local(datetime.combine(day, hour), zone).note)]


def parse_every(text: str, option: str) -> int:
    """Parse an interval of EVERY_FORMS; return days. Raises BadInput."""
    words = " ".join(text.lower().split()).removeprefix("every ")
    if words in _WORDS:
        return _WORDS[words]
    found = _EVERY.fullmatch(words)
    days = 0 if found is None else int(found[1] or 1) * (7 if found[2].startswith("w") else 1)
    if not 1 <= days <= DAYS:
        raise BadInput(f"{option}: {quoted(text)} is not 1 to {DAYS} days; write {EVERY_FORMS}")
    return days


def every_words(days: int) -> str:
    count, unit = (days // 7, "week") if days % 7 == 0 else (days, "day")
    return f"every {unit}" if count == 1 else f"every {count} {unit}s"


def parse_zone(text: str, option: str) -> ZoneInfo:
    """Parse the name of a zone of the IANA database. Raises BadInput."""
    try:
        return ZoneInfo(text)
    except (LookupError, ValueError, OSError):  # none; `../etc`; `Europe`, which is a folder
        near = difflib.get_close_matches(text, available_timezones(), n=3)
        hint = f"did you mean {' or '.join(near)}?" if near else "write one, as in Europe/Berlin or UTC"
        raise BadInput(f"{option}: {quoted(text)} is not a time zone of the IANA database; {hint}") from None


def host_zone(environ: Mapping[str, str] = os.environ, etc: Path = Path("/etc")) -> ZoneInfo:
    """Return this host's zone. Raises BadInput if its name is unknown."""
    names = [environ["TZ"].removeprefix(":")] if environ.get("TZ") else []
    if not names:
        with suppress(OSError):  # none, or a copy
            names.append(str((etc / "localtime").readlink()))
        with suppress(OSError):
            names.append((etc / "timezone").read_text(errors="replace").strip())
    for name in names:
        try:
            return parse_zone(_FOLDERS.sub("", name), "")
        except BadInput:
            continue
    if not environ.get("TZ") and not clocks.daylight and clocks.timezone == 0:
        return ZoneInfo("UTC")
    raise BadInput("the name of this host's time zone is unknown; write --zone Europe/Berlin, or set TZ")


def in_zone(at: float, zone: ZoneInfo | None) -> datetime:
    """None: of this host."""
    return datetime.fromtimestamp(at, UTC).astimezone(zone)


def date_words(at: float, zone: ZoneInfo | None) -> str:
    there = in_zone(whole_second(at), zone)
    return f"{there:%a %Y-%m-%d %H:%M}" + (f":{there:%S}" if there.second else "")


def span_words(start: float, end: float, zone: ZoneInfo | None) -> str:
    """`Tue 2026-12-01 14:00 to 16:00`; with the end's UTC offset if clocks change between them on the same day."""
    first, last, words = in_zone(start, zone), in_zone(whole_second(end), zone), date_words(end, zone)
    if first.date() == last.date():
        words = words.split()[-1] + (last.isoformat()[-6:] if first.utcoffset() != last.utcoffset() else "")
    return f"{date_words(start, zone)} to {words}"
