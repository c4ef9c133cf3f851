"""Repetition rules of calendar events (RFC 5545, section 3.3.10), as far as zscout can book them. Pure.

Not dateutil: calendar files are untrusted, and dateutil searches to the year 9999 if nothing matches, and for ever at
an interval of 0."""

from __future__ import annotations

from calendar import monthrange
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from itertools import count
from typing import Any, Final

from zscout.messages.bookings import DAYS

PARTS: Final = {
    "DAILY": frozenset[str](),
    "WEEKLY": frozenset({"BYDAY", "WKST"}),
    "MONTHLY": frozenset({"BYDAY", "BYMONTHDAY", "BYMONTH", "BYSETPOS", "WKST"}),
    "YEARLY": frozenset({"BYDAY", "BYMONTHDAY", "BYMONTH", "BYSETPOS", "WKST"}),
}
"""By FREQ: the parts allowed beside FREQ, INTERVAL, COUNT and UNTIL."""
MAX_INTERVAL: Final = 1_000
MAX_COUNT: Final = 1_000
MAX_LISTED: Final = 100
"""Values in one part, as weekdays or days of the month."""
DAYS_OF_WEEK: Final = ("MO", "TU", "WE", "TH", "FR", "SA", "SU")


@dataclass(frozen=True, slots=True)
class RepeatRule:
    """`by_day`: (number in the month or 0 for all, weekday from Monday, 0). Empty parts follow the first date."""

    freq: str
    interval: int = 1
    count: int | None = None
    until: date | None = None
    """A date, or a datetime in UTC; without a zone it is local time of the event."""
    by_day: tuple[tuple[int, int], ...] = ()
    by_monthday: tuple[int, ...] = ()
    by_month: tuple[int, ...] = ()
    positions: tuple[int, ...] = ()
    week_start: int = 0

    @property
    def step(self) -> int:
        """Days between two dates (WEEKLY: of one weekday); 0: not constant, or too long for a repeated booking."""
        days = {"DAILY": 1, "WEEKLY": 7}.get(self.freq, 0) * self.interval
        return days if days <= DAYS else 0


def parse_rule(parts: Mapping[str, Sequence[Any]]) -> RepeatRule:
    """Convert a rule as icalendar parses it. Raises ValueError for an unsupported rule."""
    found = {str(name).upper(): list(values) for name, values in parts.items()}
    freq = str(_single_value(found, "FREQ", "")).upper()
    if freq == "DAILY" and "BYDAY" in found and _single_value(found, "INTERVAL", 1) == 1:
        freq = "WEEKLY"  # some programs write it as DAILY with BYDAY
    allowed = PARTS.get(freq)
    if allowed is None:
        raise ValueError(f"its repetition {freq or 'is unknown: it'} can't be booked")
    if odd := sorted(found.keys() - allowed - {"FREQ", "INTERVAL", "COUNT", "UNTIL"}):
        raise ValueError(f"its repetition {freq} with {', '.join(odd)} can't be booked")
    if any(len(values) > MAX_LISTED for values in found.values()):
        raise ValueError(f"its rule lists more than {MAX_LISTED} values in one part")
    interval, most = _single_value(found, "INTERVAL", 1), _single_value(found, "COUNT", None)
    if not 1 <= interval <= MAX_INTERVAL or (most is not None and not 1 <= most <= MAX_COUNT):
        raise ValueError(f"its INTERVAL or COUNT is not from 1 to {MAX_COUNT}")
    days = tuple((day.relative or 0, DAYS_OF_WEEK.index(str(day.weekday))) for day in found.get("BYDAY", []))
    rule = RepeatRule(
        freq,
        interval,
        most,
        _single_value(found, "UNTIL", None),
        days,
        tuple(map(int, found.get("BYMONTHDAY", []))),
        tuple(map(int, found.get("BYMONTH", []))),
        tuple(map(int, found.get("BYSETPOS", []))),
        DAYS_OF_WEEK.index(str(_single_value(found, "WKST", "MO"))),
    )
    if rule.until is not None and not isinstance(rule.until, date):
        raise ValueError("its UNTIL is not a date, such as 20261231")
    if freq == "WEEKLY" and any(which for which, _ in days):
        raise ValueError("it repeats WEEKLY on numbered days, which RFC 5545 forbids")
    if freq == "YEARLY" and (days or rule.by_monthday) and not rule.by_month:
        raise ValueError("it repeats YEARLY on days without a month, which can't be booked")
    return rule


def _single_value(parts: Mapping[str, Sequence[Any]], name: str, default: Any) -> Any:
    """Raises ValueError for several."""
    values = parts.get(name, [default])
    if len(values) != 1:
        raise ValueError(f"its rule has more than one {name}")
    return values[0]


def occurrences(rule: RepeatRule, start: datetime, since: datetime, before: datetime) -> Iterator[datetime]:
    """Yield the local times in [`since`, `before`) of an event from `start` on, all without a zone. UNTIL is not
    applied: the caller knows the zone."""
    number = 0
    for period in count(0 if rule.count is not None else _periods(rule, start, since)):
        begin, days = _period(rule, start.date(), period)
        if begin > before.date():
            return
        for day in days:
            at = datetime.combine(day, start.time())
            if at < start:
                continue
            number += 1
            if at >= before or (rule.count is not None and number > rule.count):
                return
            if at >= since:
                yield at


def _periods(rule: RepeatRule, start: datetime, since: datetime) -> int:
    """Return a lower bound of the number of periods that are over at `since`."""
    months = (since.year - start.year) * 12 + since.month - start.month
    over = {"DAILY": (since - start).days, "WEEKLY": (since - start).days // 7, "MONTHLY": months}
    return max(0, over.get(rule.freq, since.year - start.year) // rule.interval - 1)


def _period(rule: RepeatRule, first: date, number: int) -> tuple[date, Iterable[date]]:
    """Return the first day of period `number` (a day, week, month or year), and its matching days in order."""
    over = rule.interval * number
    if rule.freq == "DAILY":
        day = first + timedelta(days=over)
        return day, [day]
    if rule.freq == "WEEKLY":
        week = first + timedelta(days=7 * over - (first.weekday() - rule.week_start) % 7)
        weekdays = {day for _, day in rule.by_day} or {first.weekday()}
        return week, sorted(week + timedelta(days=(day - rule.week_start) % 7) for day in weekdays)
    if rule.freq == "MONTHLY":
        year, month = divmod(first.year * 12 + first.month - 1 + over, 12)
        months = [month + 1] if not rule.by_month or month + 1 in rule.by_month else []
        begin = date(year, month + 1, 1)
    else:
        months, begin = sorted({*rule.by_month} or {first.month}), date(first.year + over, 1, 1)
    days = [day for month in months if 1 <= month <= 12 for day in _days(rule, first.day, begin.year, month)]
    if rule.positions:
        chosen = {at - 1 if at > 0 else len(days) + at for at in rule.positions if at}
        days = [day for at, day in enumerate(days) if at in chosen]
    return begin, days


def _days(rule: RepeatRule, default: int, year: int, month: int) -> list[date]:
    length = monthrange(year, month)[1]
    days = range(1, length + 1)
    found = set(days)
    if rule.by_monthday:
        found &= {day if day > 0 else length + 1 + day for day in rule.by_monthday}
    if rule.by_day:
        meant = set[int]()
        for which, weekday in rule.by_day:
            alike = [day for day in days if date(year, month, day).weekday() == weekday]
            at = which - 1 if which > 0 else len(alike) + which
            meant |= {day for number, day in enumerate(alike) if not which or number == at}
        found &= meant
    if not (rule.by_monthday or rule.by_day):
        found &= {default}
    return [date(year, month, day) for day in sorted(found)]
