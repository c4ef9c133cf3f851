"""Dates as people write them: what is taken, and what is refused."""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, date, datetime, time
from decimal import Decimal
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zscout.cli.dates import (
    date_words,
    every_words,
    host_zone,
    local,
    parse_date,
    parse_every,
    parse_zone,
    remarks,
    span_words,
)
from zscout.config.strict import BadInput
from zscout.messages import BookingRecord
from zscout.services.bookings.dates import dates

BERLIN, NEW_YORK = ZoneInfo("Europe/Berlin"), ZoneInfo("America/New_York")
NOW = datetime(2026, 11, 26, 12, 0, tzinfo=BERLIN).timestamp()
"""A Thursday."""


def when(text: str, zone: ZoneInfo = BERLIN, now: float = NOW) -> str:
    return parse_date(text, "--at").found(now, zone).at.isoformat()


@pytest.mark.parametrize(
    ("text", "at"),
    [
        ("tue 14:00", "2026-12-01T14:00:00+01:00"), ("Tuesday  14:00", "2026-12-01T14:00:00+01:00"),
        ("thu 14:00", "2026-11-26T14:00:00+01:00"), ("thu 12:00", "2026-12-03T12:00:00+01:00"),
        ("next tuesday 14:00", "2026-12-01T14:00:00+01:00"), ("next thu 14:00", "2026-12-03T14:00:00+01:00"),
        ("thu 9:00", "2026-12-03T09:00:00+01:00"), ("tomorrow 9:00", "2026-11-27T09:00:00+01:00"),
        ("today 23:59:58", "2026-11-26T23:59:58+01:00"), ("14:30", "2026-11-26T14:30:00+01:00"),
        ("9:05", "2026-11-27T09:05:00+01:00"), ("2pm", "2026-11-26T14:00:00+01:00"),
        ("12:30 am", "2026-11-27T00:30:00+01:00"), ("2026-12-01 14:00", "2026-12-01T14:00:00+01:00"),
        ("2026-12-01 9:00", "2026-12-01T09:00:00+01:00"), ("2026-12-01T14:00:05", "2026-12-01T14:00:05+01:00"),
        ("2026-12-01T14:00Z", "2026-12-01T15:00:00+01:00"), ("2026-12-01 14:00-05:00", "2026-12-01T20:00:00+01:00"),
        ("in 2h", "2026-11-26T14:00:00+01:00"), ("in 1d 12h", "2026-11-28T00:00:00+01:00"),
        ("2028-02-29 08:00", "2028-02-29T08:00:00+01:00"),
    ],
)  # fmt: skip
def test_a_date_is_taken_as_it_is_meant(text: str, at: str) -> None:
    assert when(text) == at


def test_the_day_is_that_of_the_zone() -> None:
    late = datetime(2026, 11, 26, 23, 30, tzinfo=UTC).timestamp()
    assert when("tomorrow 9:00", BERLIN, late) == "2026-11-28T09:00:00+01:00"
    assert when("tomorrow 9:00", NEW_YORK, late) == "2026-11-27T09:00:00-05:00"


def test_what_is_soon_is_never_before_it_was_asked() -> None:
    assert parse_date("in 5m", "--at").found(NOW + 0.3, BERLIN).at.timestamp() == NOW + 301
    assert parse_date("in 2h", "--at").found(NOW + 0.3, BERLIN).at.timestamp() == NOW + 7260, "to the minute"


@pytest.mark.parametrize(
    "text",
    [
        *("next", "next week", "next tomorrow 9:00", "next 14:00", "next 2026-12-01 9:00"),
        *("", "soon", "tue", "14", "25:00", "14:60", "13pm", "0am", "2026-02-29 10:00", "2026-13-01 10:00", "t 14:00"),
        *("in", "in -2h", "in two hours", "2026-12-01", "tue 14:00 sharp", "s 14:00", "2026-12-01T14:00+99:00"),
        *("٣:30", "0001-01-01 00:00", "in 400d"),
    ],
)
def test_what_is_no_date_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(BadInput, match=r"^--at: ") as refused:
        when(text)
    assert "write" in str(refused.value)


@given(st.text(max_size=24) | st.from_regex(r"[a-z0-9:+ T-]{1,24}", fullmatch=True))
def test_any_text_is_a_date_or_bad_input(text: str) -> None:
    with suppress(BadInput):
        assert parse_date(text, "--at").found(NOW, BERLIN).at.tzinfo is BERLIN


def test_a_whole_day_is_only_one_where_days_are_asked_for() -> None:
    assert parse_date("next thu", "--date").whole_day(NOW, BERLIN) == date(2026, 12, 3)
    with pytest.raises(BadInput, match='has no time; write "next tuesday 14:00"'):
        parse_date("next tuesday", "--at").found(NOW, BERLIN)
    written = parse_date("tue", "--date")
    assert written.whole_day(NOW, BERLIN) == date(2026, 12, 1)
    assert parse_date("tue 14:00", "--date").whole_day(NOW, BERLIN) is None
    with pytest.raises(BadInput, match='has no time; write "tue 14:00"'):
        written.found(NOW, BERLIN)


@pytest.mark.parametrize(
    ("zone", "text", "at", "note"),
    [
        # Clocks go forward: as if they had not yet (RFC 5545, 3.3.5).
        (BERLIN, "2027-03-28 02:30", "2027-03-28T03:30:00+02:00",
         "does not exist in Europe/Berlin: 03:30 is used instead"),
        (NEW_YORK, "2007-03-11 02:30", "2007-03-11T03:30:00-04:00",
         "does not exist in America/New_York: 03:30 is used instead"),
        # Clocks go back: the first.
        (BERLIN, "2026-10-25 02:30", "2026-10-25T02:30:00+02:00",
         "comes twice in Europe/Berlin: the first is used, the other is 2026-10-25T02:30+01:00"),
        (NEW_YORK, "2026-11-01 01:30", "2026-11-01T01:30:00-04:00",
         "comes twice in America/New_York: the first is used, the other is 2026-11-01T01:30-05:00"),
        (BERLIN, "2026-10-25 03:00", "2026-10-25T03:00:00+01:00", ""),
        (BERLIN, "2027-03-28 03:00", "2027-03-28T03:00:00+02:00", ""),
    ],
)  # fmt: skip
def test_summer_time_comes_and_goes(zone: ZoneInfo, text: str, at: str, note: str) -> None:
    found = parse_date(text, "--at").found(NOW, zone)
    assert (found.at.isoformat(), found.note) == (at, f"{text} {note}" if note else "")
    assert found.exists == ("does not exist" not in note)


def test_the_other_of_the_two_is_had_by_its_offset() -> None:
    assert when("2026-10-25T02:30+01:00") == "2026-10-25T02:30:00+01:00"


def series(start: datetime, every: int, until: float, zone: ZoneInfo) -> list[datetime]:
    """As the leader has them."""
    at, day = int(start.timestamp()), Decimal(3600)
    record = BookingRecord("id", "n", {"robot/a": {}}, 0, at, day, day, zone.key, every, int(until))
    return [datetime.fromtimestamp(one, zone) for one in dates(record, at, until + 1)]


def test_of_a_series_the_hours_that_a_day_has_not_or_twice_are_told() -> None:
    start = datetime(2026, 10, 23, 2, 30, tzinfo=BERLIN)
    found = series(start, 1, datetime(2027, 3, 30, tzinfo=BERLIN).timestamp(), BERLIN)
    assert [f"{one:%m-%d %H:%M}" for one in found if one.hour != 2] == ["03-28 03:30"]
    assert remarks([int(one.timestamp()) for one in found], BERLIN, time(2, 30)) == [
        "2026-10-25 02:30 comes twice in Europe/Berlin: the first is used, the other is 2026-10-25T02:30+01:00",
        "2027-03-28 02:30 does not exist in Europe/Berlin: 03:30 is used instead",
    ]


def test_a_series_ends_with_its_last_date_and_passes_a_leap_day() -> None:
    start = datetime(2028, 2, 28, 8, 0, tzinfo=BERLIN)
    last = datetime(2028, 3, 1, 8, 0, tzinfo=BERLIN).timestamp()
    assert [one.day for one in series(start, 1, last, BERLIN)] == [28, 29, 1]
    assert [one.day for one in series(start, 1, last - 1, BERLIN)] == [28, 29]


@given(st.integers(0, 400 * 1440), st.sampled_from(["Europe/Berlin", "America/New_York", "Australia/Lord_Howe", "UTC"]))
def test_a_local_time_is_told_as_it_was_asked_or_does_not_exist(minutes: int, name: str) -> None:
    naive = datetime.fromtimestamp(1_767_225_600 + 60 * minutes, UTC).replace(tzinfo=None)
    found = local(naive, ZoneInfo(name))
    assert (datetime.fromtimestamp(found.at.timestamp(), ZoneInfo(name)).replace(tzinfo=None, fold=0) == naive) == (
        found.exists
    )


@pytest.mark.parametrize(
    ("text", "days"),
    [
        ("day", 1), ("week", 7), ("2 weeks", 14), ("2w", 14), ("10 days", 10), ("weekly", 7), ("every week", 7),
        ("3d", 3),
    ],
)  # fmt: skip
def test_how_often_it_comes_again(text: str, days: int) -> None:
    assert parse_every(text, "--every") == days


@pytest.mark.parametrize("text", ["", "0 days", "month", "400 days", "60 weeks", "-1 days", "1.5 days", "hour"])
def test_how_often_it_can_not_come_again(text: str) -> None:
    with pytest.raises(BadInput, match=r"^--every: "):
        parse_every(text, "--every")


def test_words() -> None:
    assert [every_words(days) for days in (1, 7, 14, 10)] == [
        "every day",
        "every week",
        "every 2 weeks",
        "every 10 days",
    ]
    start = datetime(2026, 12, 1, 14, 0, tzinfo=BERLIN).timestamp()
    assert date_words(start, NEW_YORK) == "Tue 2026-12-01 08:00"
    assert {date_words(start + late, BERLIN) for late in (-0.2, 0.2)} == {"Tue 2026-12-01 14:00"}
    assert span_words(start, start + 7200, BERLIN) == "Tue 2026-12-01 14:00 to 16:00"
    assert span_words(start, start + 86_400 + 5, BERLIN) == "Tue 2026-12-01 14:00 to Wed 2026-12-02 14:00:05"
    # As clocks are put back its end is by the clock where it began.
    twice = datetime(2027, 10, 31, 2, 30, tzinfo=BERLIN).timestamp()
    assert span_words(twice, twice + 3600, BERLIN) == "Sun 2027-10-31 02:30 to 02:30+01:00"


def test_a_zone_is_one_of_the_database() -> None:
    assert parse_zone("Europe/Berlin", "--zone").key == "Europe/Berlin"
    for text in ("Europe/Berlinn", "Europe", "../etc/passwd", "", "/etc/localtime", "x" * 500, "a\0b"):
        with pytest.raises(BadInput, match=r"^--zone: .* is not a time zone"):
            parse_zone(text, "--zone")
    with pytest.raises(BadInput, match="did you mean Europe/Berlin"):
        parse_zone("Europe/Berlinn", "--zone")


def test_the_zone_of_this_host_is_told_by_tz_then_by_its_files(tmp_path: Path) -> None:
    assert host_zone({"TZ": "Europe/Berlin"}, tmp_path).key == "Europe/Berlin"
    assert host_zone({"TZ": ":/usr/share/zoneinfo/Asia/Tokyo"}, tmp_path).key == "Asia/Tokyo"
    (tmp_path / "timezone").write_text("America/New_York\n")
    assert host_zone({}, tmp_path).key == "America/New_York"
    (tmp_path / "localtime").symlink_to("../usr/share/zoneinfo/Europe/Berlin")
    assert host_zone({}, tmp_path).key == "Europe/Berlin"
    with pytest.raises(BadInput, match="--zone Europe/Berlin"):
        host_zone({"TZ": "CEST-2"}, tmp_path)
