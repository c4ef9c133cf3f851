"""What `zscout book` makes of its options, before anybody is asked."""

from __future__ import annotations

import time
from datetime import datetime
from decimal import Decimal
from zoneinfo import ZoneInfo

import pytest

from zscout.cli.bookings.book import Asked, _named_after
from zscout.cli.dates import parse_date
from zscout.config.strict import BadInput

BERLIN = ZoneInfo("Europe/Berlin")
NOW = datetime(2026, 11, 26, 12, 0, tzinfo=BERLIN).timestamp()
HOUR = Decimal(3600)


def asked(at: str, every: int | None = None, until: str | None = None, now: float = NOW) -> Asked:
    last = None if until is None else parse_date(until, "--until")
    return Asked.of(parse_date(at, "--at"), HOUR, every, last, BERLIN, now)


def test_the_last_day_is_one_on_which_it_may_begin() -> None:
    last = asked("tue 14:00", 7, "2026-12-08").last
    assert last is not None
    assert last.isoformat() == "2026-12-08T23:59:59+01:00"
    exactly = asked("tue 14:00", 7, "2026-12-08 14:00").last
    assert exactly is not None
    assert exactly.isoformat() == "2026-12-08T14:00:00+01:00"
    year = asked("tue 14:00", 7).last
    assert year is not None
    assert year.isoformat() == "2027-11-26T23:59:59+01:00"


def test_what_began_can_be_booked_for_as_long_as_it_can_be_taken_up() -> None:
    written = parse_date("2026-11-26 11:50", "--at")
    assert Asked.of(written, HOUR, None, None, BERLIN, NOW, 900).start.at.minute == 50
    with pytest.raises(BadInput, match="11:50 is past"):
        Asked.of(written, HOUR, None, None, BERLIN, NOW, 600)


@pytest.mark.parametrize(
    ("at", "every", "until", "why"),
    [
        ("2026-11-26 11:59", None, None, "--at: .* 11:59 is past; the fleet's clock shows Thu 2026-11-26 12:00"),
        ("2028-01-01 10:00", None, None, "--at: .* is more than a year ahead"),
        ("tue 14:00", 7, "2026-11-30", "--until is before the first date"),
        ("tue 14:00", 7, "2027-12-30", "--until is more than a year ahead; write 2027-11-26 or an earlier"),
        ("2027-03-28 02:30", 1, None, "--at: 2027-03-28 02:30 does not exist .* begin with another date"),
    ],
)  # fmt: skip
def test_what_can_not_be_is_refused(at: str, every: int | None, until: str | None, why: str) -> None:
    with pytest.raises(BadInput, match=why):
        asked(at, every, until)


def test_a_year_of_days_is_told_in_a_moment() -> None:
    # In the time that this process ran.
    began = time.process_time()
    asked("2026-12-01 14:00", 1).remarks()
    assert time.process_time() - began < 2


@pytest.mark.parametrize(
    ("need", "name"),
    [
        ("gpu/1", "gpu-1"),
        ("robot/arm1", "robot-arm1"),
        ("framegrabber/*", "framegrabber"),
        ("robot/scout$*", "robot"),
        ("gpu/" + "x" * 64, "gpu-" + "x" * 56),
    ],
)
def test_a_booking_is_named_after_its_first_device(need: str, name: str) -> None:
    assert _named_after({need: {}}) == name
