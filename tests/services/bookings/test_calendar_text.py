"""Bookings as iCalendar: the text, held against icalendar's own reading of it and the zones of the IANA database."""

from __future__ import annotations

import io
import os
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from dateutil.tz import tzical  # type: ignore[import-untyped]
from icalendar import Calendar

from zscout.messages import BookedDate, BookingView, Who
from zscout.services.bookings.calendar_text import CalendarSelection, calendar_text

GOLDEN = Path(__file__).with_name("fleet.ics")
BERLIN = ZoneInfo("Europe/Berlin")


def at(*when: int) -> int:
    return int(datetime(*when, tzinfo=UTC).timestamp())  # type: ignore[misc,arg-type]


def booking(id: str, start: int, **more: object) -> BookingView:  # noqa: A002 - the field's name
    fields: dict[str, object] = {"name": "survey", "needs": {"robot/arm1": {}}, "priority": 3}
    fields |= {"runtime": Decimal(7200), "patience": Decimal(900), "owner": "anvil", "since": at(2026, 11, 1)}
    return BookingView(id=id, start=start, **(fields | more))  # type: ignore[arg-type]


def fleet() -> list[BookingView]:
    """One of each kind."""
    first, once = at(2026, 12, 1, 13), at(2026, 12, 3, 9)
    bound = {"framegrabber/*": "framegrabber/f1", "framegrabber/*#2": "framegrabber/f2"}
    needs = {"robot/arm1": {}, "radio/rf0": {"command_rate": Decimal("5.0")}, "framegrabber/*": {}}
    dates = [
        BookedDate(first, first + 7200, "open", {"framegrabber/*": "framegrabber/f1"}),
        BookedDate(at(2026, 12, 15, 13), at(2026, 12, 15, 15), "conflict", danger="booking x of bellows stands"),
    ]
    return [
        booking(
            "weekly",
            first,
            needs=needs,
            zone="Europe/Berlin",
            every=7,
            until=at(2027, 6, 1),
            dropped=[at(2026, 12, 8, 13)],
            dates=dates,
            who=Who("alice", "anvil", "", "the visitors;\tall, of them\n"),
        ),
        booking(
            "once",
            once,
            owner="bellows",
            needs={pattern: {} for pattern in bound},
            dates=[BookedDate(once, once + 3600, "open", bound)],
            runtime=Decimal("3600.5"),
        ),
        booking("service", at(2026, 12, 4, 6), maintenance=True, runtime=Decimal(2 * 86_400), name="grease"),
        booking("gone", at(2026, 12, 5, 6), unbooked=True, runtime=Decimal(90_061)),
        booking("tenth", at(2026, 12, 5, 6), every=10, zone="America/New_York"),
    ]


def events(text: bytes) -> list[Any]:
    """Untyped: a property may be of any kind."""
    calendar = Calendar.from_ical(text)
    assert isinstance(calendar, Calendar)
    return calendar.events


def test_the_text_of_a_fleet() -> None:
    text = calendar_text("lab", fleet())
    if os.environ.get("ZSCOUT_REWRITE"):
        GOLDEN.write_bytes(text)
    assert text == GOLDEN.read_bytes()


def test_it_is_the_same_in_whichever_order_they_are_told() -> None:
    assert calendar_text("lab", reversed(fleet())) == calendar_text("lab", fleet())


def test_another_program_reads_what_was_meant() -> None:
    found = {str(event["UID"]): event for event in reversed(events(calendar_text("lab", fleet())))}
    weekly = found["weekly@lab"]
    assert weekly.start == datetime(2026, 12, 1, 14, tzinfo=BERLIN)
    assert weekly.end - weekly.start == timedelta(hours=2)
    assert weekly.rrules[0]["FREQ"] == ["WEEKLY"]
    assert weekly.exdates == [datetime(2026, 12, 8, 14, tzinfo=BERLIN)]
    assert (weekly["STATUS"], weekly["SUMMARY"]) == ("CONFIRMED", "survey (anvil)")
    assert weekly["DESCRIPTION"] == "the visitors; all, of them"
    assert weekly["X-ZSCOUT-NEEDS"] == "framegrabber/* radio/rf0:command_rate=5 robot/arm1"
    assert found["once@lab"]["LOCATION"] == "framegrabber/f1, framegrabber/f2"
    assert found["once@lab"].end == datetime(2026, 12, 3, 10, 0, 1, tzinfo=UTC)
    assert found["service@lab"]["SUMMARY"] == "maintenance: grease (anvil)"
    assert found["service@lab"].end == datetime(2026, 12, 6, 6, tzinfo=UTC)
    assert found["gone@lab"]["STATUS"] == "CANCELLED"
    assert found["gone@lab"].end - found["gone@lab"].start == timedelta(days=1, hours=1, minutes=1, seconds=1)
    assert found["tenth@lab"].rrules[0]["INTERVAL"] == [10]


def test_a_date_that_another_booking_has_is_tentative() -> None:
    other = next(event for event in events(calendar_text("lab", fleet())) if "RECURRENCE-ID" in event)
    assert (str(other["UID"]), other["STATUS"]) == ("weekly@lab", "TENTATIVE")
    assert other.start == other["RECURRENCE-ID"].dt == datetime(2026, 12, 15, 14, tzinfo=BERLIN)
    assert other["DESCRIPTION"].endswith("booking x of bellows stands")


def test_a_first_date_in_the_second_of_two_hours_is_told_by_itself() -> None:
    """The rule of a series can only mean the first of the two."""
    second = at(2026, 10, 25, 1, 30)  # 02:30 in Berlin, for the second time
    found = events(calendar_text("lab", [booking("a", second, every=7, zone="Europe/Berlin", until=at(2026, 12, 1))]))
    series, first = found
    assert series.start.timestamp() == second - 3600
    assert (first.start, first["RECURRENCE-ID"].dt) == (datetime(2026, 10, 25, 1, 30, tzinfo=UTC), series.start)


def test_a_zone_that_is_not_known_here_is_told_as_dates() -> None:
    dates = [BookedDate(at(2026, 12, day), at(2026, 12, day, 2), "open") for day in (1, 8)]
    found = events(calendar_text("lab", [booking("a", dates[0].start, every=7, zone="Mars/Olympus", dates=dates)]))
    assert [int(one.start.timestamp()) for one in found] == [one.start for one in dates]
    assert len({str(one["UID"]) for one in found}) == 2


@pytest.mark.parametrize(
    ("zone", "year", "regular"),
    [
        ("Europe/Berlin", 2026, True),
        ("Europe/Dublin", 2026, True),
        ("America/New_York", 2026, True),
        ("Australia/Lord_Howe", 2026, True),
        ("Asia/Tokyo", 2026, True),
        # Clocks are changed by the moon.
        ("Africa/Casablanca", 2026, False),
        # From 2011 on they are changed no more.
        ("Europe/Moscow", 2010, False),
    ],
)
def test_a_zone_is_told_as_it_is(zone: str, year: int, regular: bool) -> None:
    """Of programs that do not know it by its name."""
    text = calendar_text("lab", [booking("a", at(year, 12, 1), every=1, zone=zone, until=at(year + 1, 11, 1))]).decode()
    told = text[text.index("BEGIN:VTIMEZONE") : text.index("BEGIN:VEVENT")].replace("\r\n", "\n")
    # Outlook and others read rules alone: of dates they know the first, and are an hour off from the next summer on.
    assert ("RDATE" not in told) is regular
    read, real = tzical(io.StringIO(told)).get(zone), ZoneInfo(zone)
    moment = datetime(year, 1, 1, tzinfo=UTC)
    while moment < datetime(year + 2, 12, 1, tzinfo=UTC):
        local = moment.astimezone(real)
        twice = local.replace(fold=0).utcoffset() != local.replace(fold=1).utcoffset()
        assert twice or local.replace(tzinfo=read).utcoffset() == local.utcoffset(), moment
        moment += timedelta(minutes=30)


def test_what_a_selection_has() -> None:
    def ids(selection: CalendarSelection) -> list[str]:
        return [one.id for one in selection.of(fleet())]

    assert ids(CalendarSelection()) == ["weekly", "once", "service", "gone", "tenth"]
    assert ids(CalendarSelection(owner="bellows")) == ["once"]
    assert ids(CalendarSelection(rc="radio/rf0")) == ["weekly"]
    # Of a pattern: what is kept for it; where nothing is kept yet, any that it may be.
    assert ids(CalendarSelection(rc="framegrabber/f1")) == ["weekly", "once"]
    assert ids(CalendarSelection(rc="framegrabber/f3")) == []
    unbound = [booking("a", at(2027, 6, 1), needs={"framegrabber/*": {}})]
    assert CalendarSelection(rc="framegrabber/f3").of(unbound) == unbound
    assert CalendarSelection(rc="robot/arm1").of(unbound) == []
    paths = [one.path for one in (CalendarSelection(), CalendarSelection("anvil"), CalendarSelection(rc="robot/arm1"))]
    assert paths == ["fleet.ics", "owner/anvil.ics", "rc/robot/arm1.ics"]
