"""What `zscout book` makes of its options, before anybody is asked."""

from __future__ import annotations

import time
from datetime import datetime
from decimal import Decimal
from zoneinfo import ZoneInfo

import pytest

from tests.cli.tools import zscout_here
from zscout.cli.bookings.book import Asked
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
        ("2026-11-26 11:59", None, None, "--at: .* 11:59 is past; the fleet's clock has Thu 2026-11-26 12:00"),
        ("2028-01-01 10:00", None, None, "--at: .* is more than a year ahead"),
        ("tue 14:00", 7, "2026-11-30", "--until is before the first date"),
        ("tue 14:00", 7, "2027-12-30", "--until is more than a year ahead; write 2027-11-26 or an earlier"),
        ("2027-03-28 02:30", 1, None, "--at: 2027-03-28 02:30 does not exist .* begin with another date"),
    ],
)  # fmt: skip
def test_what_can_not_be_is_refused(at: str, every: int | None, until: str | None, why: str) -> None:
    with pytest.raises(BadInput, match=why):
        asked(at, every, until)


def test_hours_that_a_day_has_not_or_twice_are_told() -> None:
    assert asked("2026-12-01 14:00").remarks() == []
    [note] = asked("2027-03-28 02:30").remarks()
    assert note.endswith("03:30 is taken")
    summer = datetime(2026, 10, 20, 12, 0, tzinfo=BERLIN).timestamp()
    twice, never = asked("2026-10-21 02:30", 1, now=summer).remarks()
    assert twice.startswith("2026-10-25 02:30 comes twice in Europe/Berlin")
    assert never.startswith("2027-03-28 02:30 does not exist")


def test_a_year_of_days_is_told_in_a_moment() -> None:
    # In the time that this process ran.
    began = time.process_time()
    asked("2026-12-01 14:00", 1).remarks()
    assert time.process_time() - began < 2


AT = ("--for", "1h", "--at", "tue 14:00")


@pytest.mark.parametrize(
    ("args", "why"),
    [
        (("book", "robot/a", "--for", "1h"), "--at is missing"),
        (("book", *AT), "DEVICE... is missing"),
        (("book", "robot/a", "--for", "1h", "--at", "tue"), '--at: "tue" has no time; write "tue 14:00"'),
        (("book", "robot/a", "--for", "soon", "--at", "9:00"), '--for: "soon" is not a duration'),
        (("book", "robot/a", "--for", "1h", "--at", "9999-12-31 23:59"), "is more than a year ahead; write an earlier"),
        (("book", "robot/a", "--for", "1h", "--at", "0001-01-01"), "is long past; write a later date"),
        (("book", "robot", *AT), 'device "robot" is not valid'),
        (("book", "robot/a", *AT, "--until", "2026-12-24"), "--until ends a repeated booking"),
        (("book", "robot/a", *AT, "--every", "month"), '--every: "month" is not 1 to 366 days'),
        (("book", "robot/a", *AT, "--patience", "2h"), "--patience is longer than the booking; write at most 1 h"),
        (("book", "robot/a", *AT, "--zone", "Berlin"), "did you mean Europe/Berlin?"),
        (("book", "robot/a", "robot/a", *AT), "robot/a is named twice"),
        (("book", "robot/a", *AT, "--name", "a b"), "--name"),
        (("maintain", "robot/*", *AT), "robot/* is a pattern; name each"),
        (("maintain", "robot/a", "robot/a", *AT), "a device is named twice"),
        (
            ("slots", "robot/a", "--for", "1h", "--within", "500d"),
            "--within: 500 d is not within 1.0 s and 366 d; write",
        ),
        (("slots", "robot/a", "--for", "1h", "--limit", "0"), "--limit"),
        (("unbook", "x" * 65), "can't be the name of a booking"),
        (("unbook", "x", "--date", "someday"), "--date: "),
        (("request",), "DEVICE... is missing"),
        (("request", "--booking", "x", "--min-runtime", "5"), "--min-runtime can't be used with --booking"),
        (("request", "--booking", "x", "--release-after", "5"), "--release-after can't be used with --booking"),
        (("request", "--booking", "x", "--dry-run"), "--dry-run can't be used with --booking"),
        (("take",), "DEVICE... is missing"),
    ],
)
def test_bad_input_is_one_line_and_code_2(
    args: tuple[str, ...], why: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    code = zscout_here(*args)
    said = capsys.readouterr()
    assert (code, said.out) == (2, "")
    assert why in said.err
    assert "after --" not in said.err
    assert said.err.count("\n") == 1
