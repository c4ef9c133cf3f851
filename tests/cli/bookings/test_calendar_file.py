"""iCalendar files as they come: of other programs, and of who wants to harm."""

from __future__ import annotations

import time
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.thorough import times
from zscout.cli.bookings.calendar_file import MAX_BYTES, MAX_EVENTS, CalendarEvent, read_calendar
from zscout.config.strict import BadInput

START = "DTSTART:20261201T080000Z\n"


def read(*events: str) -> list[CalendarEvent]:
    inner = "".join(f"BEGIN:VEVENT\nUID:a\n{event}\nEND:VEVENT\n" for event in events)
    return read_calendar(f"BEGIN:VCALENDAR\n{inner}END:VCALENDAR\n".encode(), "a.ics")


def problem(event: str) -> str:
    return read(event)[0].problem


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "ends before its END:VCALENDAR; download or export it again"),
        (b"<html>Sign in</html>", "is not an iCalendar file; export it as .ics, beginning with BEGIN:VCALENDAR"),
        (b"\x00\xff\xfe" * 99, "is not UTF-8, so it is not an iCalendar file; export it as .ics again"),
        (b"\x00" * 99, "is not an iCalendar file; export it as .ics, beginning with BEGIN:VCALENDAR"),
        (b"BEGIN:VEVENT\nEND:VEVENT\n", "is not an iCalendar file, or is nested too deep; export it as .ics again"),
        (b"BEGIN:VCALENDAR\nBEGIN:VEVENT\nEND:VEVENT\n", "ends before its END:VCALENDAR; download or export it again"),
        (b"BEGIN:VCALENDAR\nEND:VEVENT\n", "has an END without its BEGIN; export it again"),
        (b"BEGIN:VCALENDAR\n" * 100_000, "is not an iCalendar file, or is nested too deep; export it as .ics again"),
        (b"BEGIN:VCALENDAR\n" + b"BEGIN:VEVENT\nEND:VEVENT\n" * (MAX_EVENTS + 1) + b"END:VCALENDAR\n",
         "has more than 5000 events; export less, such as only the coming year"),
        (b"x" * (MAX_BYTES + 1), "has more than 5,000,000 bytes; export less, such as only the coming year"),
    ],
)  # fmt: skip
def test_what_is_no_calendar(data: bytes, why: str) -> None:
    began = time.process_time()
    with pytest.raises(BadInput) as error:
        read_calendar(data, "a.ics")
    assert str(error.value) == f"a.ics: {why}"
    assert time.process_time() - began < 5


@pytest.mark.parametrize(
    ("event", "why"),
    [
        ("SUMMARY:x", "it has no DTSTART"),
        (START + START, "it has DTSTART more than once"),
        ("DTSTART:2026", 'Expected datetime, date, or time. Got: \'2026\''),
        ("DTSTART:00010101T000000Z", '"00010101T000000Z" is not a date'),
        ("DTSTART:20261301T000000Z", "Wrong datetime format: 20261301T000000Z"),
        ("DTSTART;TZID=../../etc/passwd:20261201T080000", 'its time zone "../../etc/passwd" is not an IANA zone'),
        ("DTSTART;TZID=:20261201T080000", 'its time zone "" is not an IANA zone'),
        (START + "RRULE:FREQ=SECONDLY", "its repetition SECONDLY can't be booked"),
        (START + "RRULE:FREQ=DAILY\nRRULE:FREQ=WEEKLY", "it has RRULE more than once"),
        (START + "EXDATE:" + ",".join(["20261201T080000Z"] * 1_001), "it has more than 1000 dates"),
        (START + "SUMMARY:x\n" * 1_001, "it is too long"),
        (START + "SUMMARY:" + "x" * 200_000, "it is too long"),
        (START + "RDATE;VALUE=PERIOD:20261201T080000Z/PT1H", '"20261201T080000Z/PT1H" is not a date'),
        (START + "RECURRENCE-ID;RANGE=THISANDFUTURE:20261201T080000Z",
         "it replaces a whole range of dates (RANGE), which zscout can't import"),
    ],
)  # fmt: skip
def test_an_event_that_can_not_be_read_tells_why(event: str, why: str) -> None:
    assert problem(event) == why
    # All others can.
    assert [one.problem for one in read(event, START)] == [why, ""]


def test_a_zone_of_the_file_is_never_worked_out() -> None:
    """Its rules may go on for ever: icalendar follows them when it reads a file."""
    zone = "BEGIN:VTIMEZONE\nTZID:x\nBEGIN:STANDARD\nDTSTART:16010101T000000\nRRULE:FREQ=SECONDLY\n"
    zone += "TZOFFSETFROM:+0000\nTZOFFSETTO:+0100\nEND:STANDARD\nEND:VTIMEZONE\n"
    event = "BEGIN:VEVENT\nUID:a\nDTSTART;TZID=x:20261201T080000\nEND:VEVENT\n"
    began = time.process_time()
    (found,) = read_calendar(f"BEGIN:VCALENDAR\n{zone}{event}END:VCALENDAR\n".encode(), "a.ics")
    assert found.problem == 'its time zone "x" is not an IANA zone'
    assert time.process_time() - began < 1


def test_what_an_event_holds_inside_is_not_its_own() -> None:
    (event,) = read(START + "BEGIN:VALARM\nDTSTART:20300101T000000Z\nSUMMARY:alarm\nEND:VALARM\nSUMMARY:own")
    assert (event.problem, event.title) == ("", "own")


def test_words_are_bounded_and_draw_nothing() -> None:
    (event,) = read(START + "SUMMARY:\x1b[2Ja\\nb" + "c" * 300 + "\nLOCATION:" + "d," * 99)
    assert event.title.startswith("[2Ja bccc")
    assert len(event.title) == 200
    assert all(text.isprintable() for text in event.words)


values = st.text(max_size=20)
names = st.sampled_from(["DTSTART", "DURATION", "RRULE", "EXDATE", "ATTENDEE", "SUMMARY", " "])
params = st.sampled_from(["", ";TZID=Europe/Berlin", ';CN="a', ";", ";=", ";X=\\"])
parts = st.sampled_from(["BEGIN:VCALENDAR", "END:VCALENDAR", "BEGIN:VEVENT", "END:VEVENT", "BEGIN:X", "END:X"])
lines = st.lists(parts | st.builds("{}{}:{}".format, names, params, values) | values, max_size=20)


@settings(max_examples=times(40))
@given(lines)
def test_whatever_a_file_has_it_is_read_or_refused_in_a_line(some: list[str]) -> None:
    text = "\r\n".join(["BEGIN:VCALENDAR", "BEGIN:VEVENT", *some, "END:VEVENT", "END:VCALENDAR", ""])
    with suppress(BadInput):
        for event in read_calendar(text.encode(errors="replace"), "a.ics"):
            assert "\n" not in event.problem
