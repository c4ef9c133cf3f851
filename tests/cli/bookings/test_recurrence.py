# ruff: noqa: DTZ001 - local times
"""Rules of repeated events, held against dateutil's reading of them."""

from __future__ import annotations

import time
from datetime import date, datetime, timedelta
from typing import Any

import pytest
from dateutil.rrule import rrulestr  # type: ignore[import-untyped]
from hypothesis import given, settings
from hypothesis import strategies as st
from icalendar import vRecur

from zscout.cli.bookings.recurrence import DAYS_OF_WEEK, occurrences, parse_rule

SINCE, BEFORE = datetime(2026, 7, 1), datetime(2028, 1, 1)

weekdays = st.lists(st.sampled_from(DAYS_OF_WEEK), min_size=1, max_size=3, unique=True)
numbers = st.builds("{}{}".format, st.sampled_from([1, 2, -1, -2]), st.sampled_from(DAYS_OF_WEEK))
# Not both kinds: dateutil takes only days that are of both.
numbered = weekdays | st.lists(numbers, min_size=1, max_size=3, unique=True)
# Such as each month has: dateutil goes on to the year 9999 where nothing matches.
days = st.lists(st.sampled_from([1, 13, 28, -1, -5]), min_size=1, max_size=3, unique=True)
months = st.lists(st.integers(1, 12), min_size=1, max_size=3, unique=True)
positions = st.lists(st.sampled_from([1, 2, -1]), min_size=1, max_size=2, unique=True).filter(lambda some: some != [2])
starts = st.datetimes(datetime(2015, 1, 1), datetime(2027, 6, 1)).map(lambda at: at.replace(microsecond=0, fold=0))


@st.composite
def rules(draw: st.DrawFn) -> str:
    freq = draw(st.sampled_from(["DAILY", "WEEKLY", "MONTHLY", "YEARLY"]))
    parts = [f"FREQ={freq}"]

    def some(name: str, values: st.SearchStrategy[Any]) -> bool:
        if chosen := draw(st.none() | values):
            parts.append(f"{name}={','.join(map(str, chosen))}")
        return bool(chosen)

    some("INTERVAL", st.integers(1, 30 if freq in ("DAILY", "WEEKLY") else 3).map(lambda one: [one]))
    some("COUNT", st.integers(1, 300).map(lambda one: [one]))
    if freq == "WEEKLY":
        some("BYDAY", weekdays)
        some("WKST", st.sampled_from([["MO"], ["SU"], ["WE"]]))
    elif freq == "YEARLY":
        some("BYMONTH", months) and (some("BYDAY", numbered) or some("BYMONTHDAY", days)) and some(
            "BYSETPOS", positions
        )
    elif freq == "MONTHLY" and (some("BYDAY", numbered) or some("BYMONTHDAY", days)):
        some("BYSETPOS", positions)
    return ";".join(parts)


@given(rules(), starts)
@settings(deadline=None)
def test_dates_are_those_that_dateutil_finds(text: str, start: datetime) -> None:
    if "YEARLY" in text and start.day > 28:
        start = start.replace(day=28)  # else there may be no such day in the months of the rule
    expected = rrulestr(text, dtstart=start).between(SINCE, BEFORE - timedelta(seconds=1), inc=True)
    assert [*occurrences(parse_rule(vRecur.from_ical(text)), start, SINCE, BEFORE)] == expected


@given(rules(), starts)
@settings(deadline=None)
def test_a_count_is_of_all_dates_from_the_first_on(text: str, start: datetime) -> None:
    rule = parse_rule(vRecur.from_ical(text))
    everything = [*occurrences(rule, start, datetime(2015, 1, 1), BEFORE)]
    assert rule.count is None or len(everything) <= rule.count
    assert [at for at in everything if at >= SINCE] == [*occurrences(rule, start, SINCE, BEFORE)]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("FREQ=SECONDLY", "its repetition SECONDLY can't be booked"),
        ("FREQ=HOURLY;COUNT=3", "its repetition HOURLY can't be booked"),
        ("COUNT=3", "its repetition is unknown: it can't be booked"),
        ("FREQ=DAILY;BYHOUR=9,10", "its repetition DAILY with BYHOUR can't be booked"),
        ("FREQ=WEEKLY;BYMONTH=3", "its repetition WEEKLY with BYMONTH can't be booked"),
        ("FREQ=WEEKLY;BYDAY=2MO", "it repeats WEEKLY on numbered days, which RFC 5545 forbids"),
        ("FREQ=YEARLY;BYWEEKNO=20", "its repetition YEARLY with BYWEEKNO can't be booked"),
        ("FREQ=YEARLY;BYDAY=20MO", "it repeats YEARLY on days without a month, which can't be booked"),
        ("FREQ=DAILY;INTERVAL=0", "its INTERVAL or COUNT is not from 1 to 1000"),
        ("FREQ=DAILY;INTERVAL=2000000000", "its INTERVAL or COUNT is not from 1 to 1000"),
        ("FREQ=DAILY;COUNT=1000000", "its INTERVAL or COUNT is not from 1 to 1000"),
        ("FREQ=DAILY,WEEKLY", "its rule has more than one FREQ"),
        ("FREQ=DAILY;UNTIL=P1D", "its UNTIL is not a date, such as 20261231"),
        (f"FREQ=MONTHLY;BYMONTHDAY={'1,' * 200}1", "its rule lists more than 100 values in one part"),
    ],
)
def test_a_rule_that_is_not_followed_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why.replace("(", r"\(")):
        parse_rule(vRecur.from_ical(text))


@pytest.mark.parametrize(
    "text",
    [
        "FREQ=YEARLY;BYMONTH=2;BYMONTHDAY=30",
        "FREQ=MONTHLY;INTERVAL=12;BYMONTHDAY=31;COUNT=9",
        "FREQ=MONTHLY;BYDAY=MO;BYSETPOS=9",
        "FREQ=DAILY;INTERVAL=1000;COUNT=1000",
    ],
)
def test_a_rule_that_nothing_matches_ends(text: str) -> None:
    """dateutil goes on to the year 9999."""
    rule = parse_rule(vRecur.from_ical(text))
    began = time.process_time()
    found = [*occurrences(rule, datetime(1971, 2, 1), SINCE, BEFORE)]
    assert len(found) <= 1
    assert time.process_time() - began < 1.0


def test_every_weekday_is_a_weekly_rule() -> None:
    """As Outlook and others write it."""
    rule = parse_rule(vRecur.from_ical("FREQ=DAILY;BYDAY=MO,TU,WE,TH,FR"))
    assert (rule.freq, rule.step) == ("WEEKLY", 7)
    found = [*occurrences(rule, datetime(2026, 11, 27, 9), SINCE, datetime(2026, 12, 2))]
    assert [at.date() for at in found] == [date(2026, 11, 27), date(2026, 11, 30), date(2026, 12, 1)]
    assert {at - datetime.combine(at.date(), datetime.min.time()) for at in found} == {timedelta(hours=9)}
