"""Dates of bookings that are repeated, over both changes of summer time."""

from __future__ import annotations

from datetime import datetime, timedelta
from decimal import Decimal
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zscout.messages import BookingRecord
from zscout.services.bookings.dates import DAY, dates, last_end

BERLIN = ZoneInfo("Europe/Berlin")


def daily(first: datetime, days: int, every: int = 1) -> BookingRecord:
    zone = first.tzinfo
    assert isinstance(zone, ZoneInfo)
    start = round(first.timestamp())
    until = round((first + timedelta(days=days)).timestamp())
    how: dict[str, Any] = {"zone": zone.key, "every": every, "until": until}
    return BookingRecord("b", "b", {"robot/a": {}}, 0, start, Decimal(60), Decimal(60), **how)


def hours(booking: BookingRecord) -> list[str]:
    zone = ZoneInfo(booking.zone)
    return [f"{datetime.fromtimestamp(at, zone):%m-%d %H:%M %z}" for at in dates(booking, 0, last_end(booking))]


def test_an_hour_is_kept_over_the_beginning_of_summer_time() -> None:
    assert hours(daily(datetime(2027, 3, 27, 9, tzinfo=BERLIN), 2)) == [
        "03-27 09:00 +0100",
        "03-28 09:00 +0200",
        "03-29 09:00 +0200",
    ]


def test_an_hour_that_a_day_has_not_is_taken_by_the_offset_before() -> None:
    assert hours(daily(datetime(2027, 3, 27, 2, 30, tzinfo=BERLIN), 2)) == [
        "03-27 02:30 +0100",
        "03-28 03:30 +0200",
        "03-29 02:30 +0200",
    ]


def test_an_hour_that_a_day_has_twice_is_its_first() -> None:
    assert hours(daily(datetime(2027, 10, 30, 2, 30, tzinfo=BERLIN), 2)) == [
        "10-30 02:30 +0200",
        "10-31 02:30 +0200",
        "11-01 02:30 +0100",
    ]


def test_the_second_of_both_is_where_it_was_made_and_the_first_later() -> None:
    booking = daily(datetime(2027, 10, 31, 2, 30, tzinfo=BERLIN, fold=1), 1)
    assert hours(booking) == ["10-31 02:30 +0100", "11-01 02:30 +0100"]


@given(
    st.integers(0, 365 * DAY),
    st.sampled_from(["UTC", "Europe/Berlin", "America/New_York", "Australia/Lord_Howe", "Asia/Kathmandu"]),
    st.integers(1, 8),
    st.integers(0, 60),
    st.integers(-5 * DAY, 70 * DAY),
    st.integers(0, 60 * DAY),
)
def test_a_window_has_the_dates_in_it(second: int, zone: str, every: int, times: int, after: int, within: int) -> None:
    first = datetime(2027, 1, 1, tzinfo=ZoneInfo(zone)) + timedelta(seconds=second)
    booking = daily(first, every * times, every)
    everything = dates(booking, 0, 10**11)
    begin = booking.start + after
    assert dates(booking, begin, begin + within) == [at for at in everything if begin <= at < begin + within]
    assert everything == sorted({*everything})
    assert booking.start in everything
    assert all(at + 60 <= last_end(booking) for at in everything)


def test_a_zone_that_is_none_is_told() -> None:
    booking = daily(datetime(2027, 3, 27, 9, tzinfo=BERLIN), 2)
    wrong = BookingRecord(**{name: getattr(booking, name) for name in booking.__struct_fields__} | {"zone": "Mars"})
    with pytest.raises(ValueError, match=r".Mars. is not a time zone"):
        dates(wrong, 0, 10**11)
