"""Which bookings `zscout booking list` shows."""

from __future__ import annotations

import datetime
from decimal import Decimal
from zoneinfo import ZoneInfo

import pytest

from zscout.cli.bookings.listing import _day, _on_day
from zscout.cli.dates import parse_date
from zscout.config.strict import BadInput
from zscout.messages import BookedDate, BookingView

BERLIN = ZoneInfo("Europe/Berlin")
NOW = datetime.datetime(2026, 11, 28, 12, 0, tzinfo=BERLIN).timestamp()


def at(day: int, hour: int) -> int:
    return round(datetime.datetime(2026, 12, day, hour, tzinfo=BERLIN).timestamp())


def test_a_day_lists_the_dates_that_have_a_part_of_it() -> None:
    dates = [BookedDate(at(day, 22), at(day + 1, end), "open") for day, end in ((1, 0), (2, 3), (3, 3))]
    nightly = BookingView(
        id="b1",
        name="nightly",
        needs={},
        priority=0,
        start=at(1, 22),
        runtime=Decimal(7200),
        patience=Decimal(0),
        dates=dates,
    )

    def on(text: str) -> list[BookedDate]:
        return _on_day(nightly, _day(parse_date(text, "--date"), NOW, BERLIN), BERLIN).dates

    assert on("tue") == dates[:1]
    assert on("2026-12-02") == dates[1:2]
    assert on("2026-12-03") == dates[1:]
    assert on("tomorrow") == []
    with pytest.raises(BadInput, match="write a day without a time"):
        on("tue 14:00")
