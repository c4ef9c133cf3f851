# ruff: noqa: DTZ001 - times in UTC
"""What is booked of a calendar: of the programs' samples, of what zscout writes itself, and over and over again."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from msgspec import structs

from tests.thorough import times
from zscout.cli.bookings.calendar import parse_needs
from zscout.cli.bookings.calendar_file import read_calendar
from zscout.cli.bookings.calendar_plan import ImportOptions, ImportPlan, Pairs, Wanted, plan_import
from zscout.config.strict import BadInput
from zscout.messages import MAX_AHEAD, MAX_BOOKINGS, Book, BookingRecord, BookingView
from zscout.services.bookings.calendar_text import calendar_text
from zscout.services.bookings.dates import DAY, dates

SAMPLES = Path(__file__).with_name("calendars")
NOW = datetime(2026, 11, 26, 12, tzinfo=UTC).timestamp()
BERLIN = ZoneInfo("Europe/Berlin")
ARM: Pairs = (("robot/arm1", {}),)
ZONES = ("UTC", "Europe/Berlin", "America/New_York", "Australia/Lord_Howe", "America/Sao_Paulo")
OTHER = ImportOptions("other", "lab", ZoneInfo("Asia/Tokyo"))
MISSING = "its hour does not exist on"


def options(**more: Any) -> ImportOptions:
    return ImportOptions("lab", "sample", BERLIN, **({"mapped": {"arm 1": ARM}} | more))


def plan(name: str, **more: Any) -> ImportPlan:
    return plan_import(read_calendar((SAMPLES / f"{name}.ics").read_bytes(), name), options(**more), NOW)


def plan_of(*events: str, now: float = NOW, **more: Any) -> ImportPlan:
    inner = "".join(
        f"BEGIN:VEVENT\nUID:a{number}\nSUMMARY:arm 1\n{event}\nEND:VEVENT\n" for number, event in enumerate(events)
    )
    text = f"BEGIN:VCALENDAR\n{inner}END:VCALENDAR\n"
    return plan_import(read_calendar(text.encode(), "a.ics"), options(**more), now)


def begins(book: Book) -> list[int]:
    fields = {name: getattr(book, name) for name in ("id", "name", "needs", "priority", "start", "runtime", "patience")}
    record = BookingRecord(**fields, zone=book.zone, every=book.every, until=book.until)
    return dates(record, 0, NOW + 6 * MAX_AHEAD)


def left(wanted: Wanted) -> list[int]:
    """The dates of a booking once those are given up that are not in the calendar."""
    return [] if wanted.book is None else [at for at in begins(wanted.book) if at not in wanted.dropped]


def words(found: ImportPlan) -> list[str]:
    """Each booking in a line, by the clocks of Berlin."""
    lines = []
    for one in found.wanted:
        assert one.book is not None
        first = datetime.fromtimestamp(one.book.start, BERLIN)
        rcs = ", ".join(sorted(one.book.needs))
        line = f"{one.book.name} {first:%a %m-%d %H:%M} for {one.book.runtime / 60} min: {rcs}"
        if one.book.until is not None:
            line += f"; every {one.book.every} days until {datetime.fromtimestamp(one.book.until, BERLIN):%y-%m-%d}"
        without = [f"{datetime.fromtimestamp(at, BERLIN):%m-%d}" for at in one.dropped]
        lines.append(f"{line}; without {', '.join(without)}" if without else line)
    return lines


def skipped(found: ImportPlan) -> list[str]:
    return [f"{one.title}: {one.why}{' (failed)' if one.failed else ''}" for one in found.skipped]


def test_a_calendar_of_google() -> None:
    found = plan("google")
    assert words(found) == [
        # The half year is over at its last date; January is another booking.
        "Grasping-practical Mon 11-30 10:00 for 90 min: robot/arm1; every 7 days until 26-12-28",
        "Grasping-practical Wed 12-09 10:00 for 90 min: robot/arm1; every 7 days until 26-12-30; without 12-02, 12-23",
        "Grasping-practical Mon 01-04 10:00 for 90 min: robot/arm1; every 7 days until 27-01-25",
        "Grasping-practical Wed 01-06 10:00 for 90 min: robot/arm1; every 7 days until 27-01-27",
        "Grasping-practical-moved Wed 12-02 14:00 for 90 min: robot/arm1",
        "Calibration Tue 12-01 09:00 for 90 min: robot/arm1",
        "Arm-1-service-by-the-maker Mon 12-07 00:00 for 2880 min: robot/arm1",
    ]
    assert skipped(found) == [
        "Holiday, arm 1 is off: of people who are free then",
        "Lunch: naming no device",
        "Arm 1 demo: cancelled",
        "Arm 1 demo: over, or begun",
    ]
    book = found.wanted[0].book
    assert book is not None
    assert book.who is not None
    assert (book.who.comment, book.patience, book.zone) == ("Grasping practical", Decimal(900), "Europe/Berlin")


def test_a_calendar_of_outlook() -> None:
    found = plan("outlook")
    assert words(found) == [
        "Einmessen Mon 11-30 08:00 for 60 min: robot/arm1", "Einmessen Tue 12-01 08:00 for 60 min: robot/arm1",
        "Einmessen Wed 12-02 08:00 for 60 min: robot/arm1", "Einmessen Thu 12-03 08:00 for 60 min: robot/arm1",
        "Einmessen Fri 12-04 08:00 for 60 min: robot/arm1", "Arm-1-Wartung Tue 12-01 16:00 for 60 min: robot/arm1",
        "Arm-1-Wartung Tue 01-05 16:00 for 60 min: robot/arm1", "Arm-1-Wartung Tue 02-02 16:00 for 60 min: robot/arm1",
        "Arm-1-Wartung Tue 03-02 16:00 for 60 min: robot/arm1",
    ]  # fmt: skip
    assert skipped(found) == ['Arm 1 Besuch: its time zone "Customized Time Zone 1" is not an IANA zone (failed)']


def test_a_calendar_of_nextcloud() -> None:
    """Its resources are named as RCs are. What has no end is booked by half years, each once it ends within a year."""
    found = plan("nextcloud")
    assert words(found) == [
        (
            "Morgenrunde Fri 11-27 09:00 for 45 min: framegrabber/*, robot/arm1; every 2 days until 26-12-31; "
            "without 12-01, 12-03"
        ),
        "Morgenrunde Sat 01-02 09:00 for 45 min: framegrabber/*, robot/arm1; every 2 days until 27-06-29",
        "Ohne-Zone Wed 12-02 15:00 for 60 min: robot/arm1",
        "Drei-Termine Thu 12-10 15:00 for 60 min: robot/arm1",
        "Drei-Termine Sat 12-12 15:00 for 60 min: robot/arm1",
        "Drei-Termine Mon 12-14 15:00 for 60 min: robot/arm1",
    ]
    assert skipped(found) == ["Morgenrunde: more than a year ahead: import it again then"]


def test_what_options_say_goes_before_what_an_event_names() -> None:
    radio: Pairs = (("radio/rf0", {"command_rate": Decimal(5)}),)
    event = "DTSTART:20261201T080000Z\nDURATION:PT1H\nRESOURCES:robot/arm2"
    (every,) = plan_of(event, needs=radio).wanted
    assert every.book is not None
    assert every.book.needs == {"radio/rf0": {"command_rate": Decimal(5)}, "robot/arm1": {}}
    (mapped,) = plan_of(event).wanted
    assert mapped.book is not None
    assert mapped.book.needs == {"robot/arm1": {}}
    (named,) = plan_of(event, mapped={}).wanted
    assert named.book is not None
    assert named.book.needs == {"robot/arm2": {}}
    # Whole words: arm 12 is another arm.
    assert plan_of(f"{event}2\nLOCATION:arm 12", mapped={"arm 2": ARM, "rm 1": ARM}).wanted[0].book != mapped.book
    assert plan_of(event.replace("robot/arm2", "the arm 12"), mapped={"rm 12": ARM}).wanted == []


def test_a_pattern_that_is_written_twice_is_two_rcs() -> None:
    wanted = parse_needs("camera/*,camera/*,radio/rf0:command_rate=5", "--needs")
    assert [need for need, _ in wanted] == ["camera/*", "camera/*#2", "radio/rf0"]
    with pytest.raises(BadInput, match="robot/a is named twice"):
        parse_needs("robot/a,robot/a", "--needs")


def test_maintenance_is_of_rcs_patterns_and_hosts() -> None:
    event = "DTSTART:20261201T080000Z\nDURATION:PT1H"
    (one,) = plan_of(event, maintenance=True).wanted
    assert one.book is not None
    assert one.book.maintenance
    assert one.book.patience == 3600
    for need in ("robot/*", "@anvil"):
        own = event.replace("DTSTART", f"X-ZSCOUT-NEEDS:{need}\nDTSTART")
        (one,) = plan_of(own, maintenance=True, mapped={}).wanted
        assert one.book is not None
        assert one.book.needs == {need: {}}
    plain = plan_of(event.replace("DTSTART", "X-ZSCOUT-NEEDS:@anvil\nDTSTART"), mapped={})
    assert skipped(plain) == ['arm 1: device "@anvil" is not valid; write kind/name, as in robot/scout33 (failed)']


@pytest.mark.parametrize(
    ("event", "why"),
    [
        ("DTSTART:20261201T080000Z", "it has no length"),
        ("DTSTART:20261201T080000Z\nDTEND:20261201T070000Z", "it has no length"),
        ("DTSTART;VALUE=DATE:20261201\nDTEND;VALUE=DATE:20261201", "it has no length"),
        ("DTSTART:20261201T080000Z\nDURATION:P400D", "it is longer than a year"),
        ("DTSTART:20261201T080000Z\nDTEND:89991201T080000Z", "it is longer than a year"),
    ],
)
def test_what_should_have_been_booked_and_can_not_be_is_told(event: str, why: str) -> None:
    assert skipped(plan_of(event)) == [f"arm 1: {why} (failed)"]


@pytest.mark.parametrize(
    ("start", "rule", "why"),
    [
        ("20261201", "FREQ=YEARLY;BYMONTH=2;BYMONTHDAY=30", "without a date to come"),
        ("20201201", "FREQ=WEEKLY;UNTIL=20210101T000000Z", "without a date to come"),
        ("20301201", "FREQ=WEEKLY", "more than a year ahead: import it again then"),
    ],
)
def test_what_is_repeated_without_a_date_to_come_is_counted(start: str, rule: str, why: str) -> None:
    assert skipped(plan_of(f"DTSTART:{start}T080000Z\nDURATION:PT1H\nRRULE:{rule}")) == [f"arm 1: {why}"]


def test_a_day_is_as_long_as_it_is() -> None:
    def minutes(*days: str) -> list[int]:
        found = plan_of(*(f"DTSTART;VALUE=DATE:{day}" for day in days))
        return [int(one.book.runtime / 60) for one in found.wanted if one.book is not None]

    assert minutes("20261201", "20270328", "20271031") == [24 * 60, 23 * 60, 25 * 60]
    # Days in a row are booked an hour short: none may overlap the next.
    (row,) = plan_of("DTSTART;VALUE=DATE:20261201\nRRULE:FREQ=DAILY;COUNT=9").wanted
    assert row.book is not None
    assert (row.book.runtime, row.book.every) == (Decimal(23 * 3600), 1)


def test_a_series_keeps_its_hour_over_summer_time() -> None:
    (one,) = plan_of("DTSTART;TZID=Europe/Berlin:20270315T090000\nDURATION:PT1H\nRRULE:FREQ=WEEKLY;COUNT=4").wanted
    assert [datetime.fromtimestamp(at, BERLIN).hour for at in left(one)] == [9] * 4
    assert [datetime.fromtimestamp(at, UTC).hour for at in left(one)] == [8, 8, 7, 7]


def test_a_series_does_not_begin_with_an_hour_that_is_left_out() -> None:
    """All that follow would be at the hour that is taken instead."""
    found = plan_of("DTSTART;TZID=Europe/Berlin:20270328T023000\nDURATION:PT1H\nRRULE:FREQ=WEEKLY;COUNT=3")
    assert [datetime.fromtimestamp(at, BERLIN).strftime("%m-%d %H:%M") for at in left(found.wanted[0])] == [
        "04-04 02:30",
        "04-11 02:30",
    ]
    assert skipped(found) == [f"arm 1: {MISSING} 2027-03-28; book that date by itself (failed)"]


def test_the_same_event_is_booked_once_and_a_changed_one_again() -> None:
    event = "DTSTART:20261201T080000Z\nDURATION:PT1H"
    twice = f"BEGIN:VEVENT\nUID:a\nSUMMARY:arm 1\n{event}\nEND:VEVENT\n" * 2
    text = f"BEGIN:VCALENDAR\n{twice}END:VCALENDAR\n"
    assert len(plan_import(read_calendar(text.encode(), "a"), options(), NOW).wanted) == 1
    (first,) = plan_of(event).wanted
    assert plan_of(event, "SUMMARY:arm 1").wanted == [first]
    for changed in (event.replace("PT1H", "PT2H"), event.replace("1201", "1202")):
        assert not set(first.ids) & set(plan_of(changed).wanted[0].ids)
    assert not set(first.ids) & set(plan_of(event, priority=1).wanted[0].ids)
    # It is known again by the calendar's name, and stays the same when it is over.
    assert all(one.endswith(options().suffix) and len(one) == 32 for one in first.ids)
    assert plan_of(event, now=NOW + 30 * DAY).ids == {*first.ids}


def test_too_many_are_refused() -> None:
    monthly = [
        f"DTSTART:202612{day:02}T{hour:02}0000Z\nDURATION:PT5M\nRRULE:FREQ=MONTHLY"
        for day in range(1, 29)
        for hour in (1, 2, 3, 4)
    ]
    with pytest.raises(BadInput, match=f"the calendar would make more than {MAX_BOOKINGS} bookings"):
        plan_of(*monthly)


# Out and in again


def _near_changes_of_clocks() -> st.SearchStrategy[int]:
    changes = [datetime(2026, 12, 1), datetime(2027, 3, 28, 1), datetime(2027, 3, 14, 7), datetime(2027, 4, 3, 15)]
    changes += [datetime(2027, 10, 31, 1), datetime(2027, 11, 7, 6), datetime(2027, 10, 2, 15, 30)]
    return st.builds(
        lambda at, quarters: int(at.replace(tzinfo=UTC).timestamp()) + 900 * quarters,
        st.sampled_from(changes),
        st.integers(-16, 16),
    )


@st.composite
def views(draw: st.DrawFn) -> BookingView:
    start = draw(_near_changes_of_clocks())
    every = draw(st.sampled_from([0, 1, 2, 7, 14, 30]))
    until = min(start + draw(st.integers(0, 200)) * DAY, int(NOW) + MAX_AHEAD) if every else None
    assume(until is None or until >= start)
    view = BookingView(
        id=draw(st.text("0123456789abcdef", min_size=32, max_size=32)),
        name="survey",
        needs={"robot/arm1": {}, "radio/rf0": {"command_rate": Decimal("0.5")}, "framegrabber/*": {}},
        priority=2,
        start=start,
        runtime=Decimal(draw(st.sampled_from([900, 7200, 40_000]))),
        patience=Decimal(900),
        zone=draw(st.sampled_from(ZONES)),
        every=every,
        until=until,
        owner="anvil",
    )
    found = dates(_record(view), 0, NOW + 3 * MAX_AHEAD)
    dropped = draw(st.lists(st.sampled_from(found), max_size=3, unique=True)) if every else []
    return structs.replace(view, dropped=sorted(dropped))


def _record(view: BookingView) -> BookingRecord:
    return BookingRecord(**{name: getattr(view, name) for name in Book.__struct_fields__})


@pytest.mark.slow
@given(st.lists(views(), min_size=1, max_size=3, unique_by=lambda view: view.id))
def test_what_is_exported_is_booked_at_the_same_dates(told: list[BookingView]) -> None:
    found = plan_import(read_calendar(calendar_text("lab", told), "a"), OTHER, NOW)
    booked = sorted((at, one.book.runtime) for one in found.wanted if one.book is not None for at in left(one))
    expected = sorted(
        (at, view.runtime)
        for view in told
        for at in dates(_record(view), 0, NOW + 3 * MAX_AHEAD)
        if at not in view.dropped
    )
    missing = sum(one.why.startswith(MISSING) for one in found.skipped)
    assert not [one for one in found.skipped if one.failed and not one.why.startswith(MISSING)]
    assert len(booked) == len(expected) - missing
    assert not {*booked} - {*expected}
    for one in found.wanted:
        assert one.book is None or one.book.needs == told[0].needs


@given(
    st.sampled_from(
        ["DAILY", "DAILY;INTERVAL=3", "WEEKLY;BYDAY=MO,TH", "WEEKLY;INTERVAL=2", "MONTHLY", "MONTHLY;BYDAY=-1FR"]
    ),
    st.sampled_from(["", ";COUNT=40", ";UNTIL=20270820T000000Z"]),
    st.lists(st.integers(0, 120), min_size=1, max_size=12),
)
@settings(max_examples=times(20))
def test_imported_again_and_again_each_date_is_booked_once(rule: str, end: str, pauses: list[int]) -> None:
    """Some days after another; and always for at least half a year, less a day."""
    event = f"DTSTART;TZID=Europe/Berlin:20261105T090000\nDURATION:PT1H\nRRULE:FREQ={rule}{end}"
    known: dict[str, Wanted] = {}
    now = NOW
    for pause in pauses:
        now += pause * DAY
        found = plan_of(event, now=now)
        assert not [one for one in found.skipped if one.failed]
        for one in found.wanted:
            known.setdefault(one.ids[0], one)
        booked = [at for one in known.values() for at in left(one)]
        assert len(booked) == len({*booked})
        # None that is not over yet would be given up by --sync.
        assert {one.ids[0] for one in known.values() if left(one) and max(left(one)) > now} <= found.ids
        every = {at for at in _all_dates(event) if now < at <= now + 180 * DAY}
        assert every <= {*booked}


def _all_dates(event: str) -> list[int]:
    from dateutil.rrule import rrulestr  # type: ignore[import-untyped]

    rule = event.split("RRULE:")[1]
    start = datetime(2026, 11, 5, 9, tzinfo=BERLIN)
    found = rrulestr(rule, dtstart=start).between(start - timedelta(days=1), datetime(2032, 1, 1, tzinfo=UTC), inc=True)
    return [int(at.timestamp()) for at in found]
