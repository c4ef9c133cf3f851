"""Bookings as people make them, on a live mesh: booked, listed, found, taken up, given up; and maintenance."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import end
from tests.hang import HANG
from zscout.behaviors.client.blocking import connect
from zscout.behaviors.client.bookings import BookingsClient
from zscout.messages import Who

pytestmark = pytest.mark.live

DATE = r"\w\w\w [-\d]+ \d\d:\d\d"
RCS = ("robot/a", "robot/b", "robot/c", "framegrabber/f1", "framegrabber/f2", "radio/rf0:command_rate=10")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("booked"), *RCS, env={"TZ": "Europe/Berlin"}) as fleet:
        yield fleet


@pytest.fixture(autouse=True)
def nothing_is_left(fleet: CliFleet) -> Iterator[None]:
    yield
    for one in told(fleet, "bookings")["bookings"]:
        said(fleet, "unbook", one["id"], "--yes")


def said(fleet: CliFleet, *args: str, code: int = 0) -> str:
    """What a command prints: lines on stdout, or the one on stderr of one that fails."""
    done = fleet.zscout(*args)
    assert done.returncode == code, done
    return done.stderr if code else done.stdout


def told(fleet: CliFleet, *args: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(said(fleet, *args, "--json"))
    return found


@pytest.mark.slow
def test_booked_listed_found_taken_up_and_given_up(fleet: CliFleet) -> None:
    needs = ("robot/a", "framegrabber/*", "radio/rf0:command_rate=5")
    made = said(fleet, "book", *needs, "--for", "2h", "--at", "in 3h", "--name", "survey", "--comment", "visitors")
    devices = r"framegrabber/f[12] for framegrabber/\*, radio/rf0 \(command_rate=5\), robot/a"
    first, second = made.splitlines()
    assert re.fullmatch(
        rf"survey \([0-9a-f]{{8}}\) is booked: {devices}: {DATE} to .*\d\d:\d\d \(Europe/Berlin\), in 3 h( 1 min)?",
        first,
    )
    assert second.endswith("zscout request --booking survey -- COMMAND")

    [listed] = told(fleet, "bookings", "--mine", "--rc", "framegrabber/f2")["bookings"]
    assert (listed["name"], listed["own"], listed["who"]["comment"]) == ("survey", True, "visitors")
    assert [date["state"] for date in listed["dates"]] == ["open"]
    assert told(fleet, "bookings", "--rc", "robot/b")["bookings"] == []
    found = {
        rc: len(told(fleet, "bookings", "--rc", rc)["bookings"]) for rc in ("robot/*", "framegrabber/*", "other/*")
    }
    assert found == {"robot/*": 1, "framegrabber/*": 1, "other/*": 0}
    columns, row = said(fleet, "bookings", "--zone", "UTC").splitlines()
    assert columns.split()[:3] == ["NAME", "ID", "WHO"]
    assert row.startswith(f"survey  {listed['id'][:8]}  ")

    # What is in its way is said, with when it is free; slots says the same.
    refused = said(fleet, "book", "robot/a", "--for", "2h", "--at", "in 2h", code=1)
    assert "booked then: survey of" in refused
    assert re.search(rf"; free together from {DATE} on \(Europe/Berlin\): write another --at\n", refused)
    slots = told(fleet, "slots", *needs, "--for", "2h", "--within", "1d")
    assert [[*slot["bound"]] for slot in slots["slots"]] == [["framegrabber/*"]] * 2
    assert slots["slots"][0]["latest"] < listed["dates"][0]["start"]
    assert slots["slots"][1]["start"] == listed["dates"][0]["end"]
    line = said(fleet, "slots", "robot/a", "--for", "30h", "--within", "2h", code=1)
    assert line == "zscout: the devices are not free together within 2 h; raise --within\n"

    # Taken up before its date it waits; given up, it goes on waiting as any other.
    waiting, said_first = fleet.begun("survey waits", "request", "--booking", "survey", "--", "sleep", "1")
    try:
        waits = said_first[-1]
        assert re.search(
            r"waits: the time of its booking is still to come; starts at .* \(in 2 h 59 min\)|\(in 3 h\)", waits
        )
        [taken] = told(fleet, "bookings")["bookings"]
        assert taken["dates"][0]["state"] == "taken"
    finally:
        end(waiting)
    assert said(fleet, "unbook", listed["id"][:6]).endswith("is cancelled\n")
    assert said(fleet, "bookings") == "nothing is booked\n"


@pytest.mark.slow
def test_at_its_date_it_is_held_and_the_command_runs(fleet: CliFleet) -> None:
    said(fleet, "book", "robot/b", "--for", "1m", "--at", "in 2s", "--name", "soon")
    done = fleet.zscout("request", "--booking", "soon", "--json", "--", "sh", "-c", "exit 7")
    assert done.returncode == 7, done
    events = [json.loads(line) for line in done.stderr.splitlines()]
    [granted] = [event for event in events if event["event"] == "granted"]
    assert (granted["arc"], granted["rcs"]) == ("soon", ["robot/b"])
    assert 0 < granted["remaining"] <= 60
    assert told(fleet, "bookings")["bookings"] == []
    gone = said(fleet, "request", "--booking", "soon", "--", "true", code=1)
    assert gone == 'zscout: unknown booking "soon", and there are none\n'


def test_a_booking_has_its_own_needs_and_priority(fleet: CliFleet) -> None:
    said(fleet, "book", "robot/b", "--for", "1h", "--at", "in 1d", "--name", "fixed", "--priority", "2")
    other = said(fleet, "request", "robot/c", "--booking", "fixed", "--", "true", code=2)
    assert other == "zscout: fixed is booked with other devices: robot/b; leave the devices out\n"
    higher = said(fleet, "request", "--booking", "fixed", "--priority", "3", "--", "true", code=2)
    assert higher == "zscout: --priority: fixed is booked with priority 2; leave --priority out\n"
    same = said(fleet, "request", "robot/b", "--booking", "fixed", "--priority", "2", "--timeout", "0.5", code=1)
    assert "fixed was not granted within 0.5 s" in same


def test_a_plain_script_books_and_takes_up(fleet: CliFleet) -> None:
    with connect("script", fleet=fleet.lab.fleet, host="test") as lab:
        bookings = BookingsClient(lab.client)
        needs: dict[str, dict[str, Any]] = {"robot/a": {}, "radio/rf0": {"command_rate": 0.5}}
        start = datetime.now(UTC) + timedelta(seconds=2)
        booking = lab.run(bookings.book(needs, start, 60, name="script", priority=1))
        with lab.hold("script", **bookings.terms(booking), timeout=HANG) as held:
            assert held.rcs == ["radio/rf0", "robot/a"]
            [listed] = lab.run(bookings.list(owner="test")).bookings
            [date] = listed.dates
            assert date.state == "taken"
            assert date.arc is not None
            assert date.arc.startswith("test/script/")
        assert not lab.run(bookings.list(owner="test")).bookings


@pytest.mark.slow
def test_what_is_repeated_is_given_up_date_by_date(fleet: CliFleet) -> None:
    made = said(fleet, "book", "robot/c", "--for", "1h", "--at", "tomorrow 9:00", "--every", "day", "--until", "in 4d")
    assert re.search(r"^robot-c \(", made)
    assert re.search(r"^repeated every day until \w\w\w [-\d]+: [34] dates within 60 days$", made, re.MULTILINE)
    # In whichever zone the list is read, its last day is that of its own.
    listed = [said(fleet, "bookings", "--zone", zone) for zone in ("Pacific/Honolulu", "Pacific/Kiritimati")]
    days = re.findall(r"every day until ([-\d]+)", "".join(listed))
    assert len(days) == 2
    assert len(set(days)) == 1
    [there] = told(fleet, "bookings", "--date", "tomorrow")["bookings"]
    assert len(there["dates"]) == 1
    assert len(said(fleet, "bookings", "--date", "tomorrow").splitlines()) == 2
    assert said(fleet, "bookings", "--date", "2030-01-01") == "nothing is booked on Tue 2030-01-01\n"
    again = said(fleet, "book", "robot/b", "--for", "1h", "--at", "in 2d", "--name", "robot-c")
    assert again.splitlines()[-1].startswith("you have another booking called robot-c: name it by its id")
    assert '2 bookings are called "robot-c": ' in said(fleet, "unbook", "robot-c", code=1)
    both = told(fleet, "bookings")["bookings"]
    series, single = sorted(both, key=lambda one: -one["every"])
    said(fleet, "unbook", single["id"])
    gone = said(fleet, "unbook", "robot-c", "--date", "tomorrow")
    assert re.search(r"no longer has \w\w\w [-\d]+ 09:00\n$", gone)
    [left] = told(fleet, "bookings")["bookings"]
    assert [date["start"] for date in left["dates"]] == [date["start"] for date in series["dates"]][1:]
    assert "robot-c has no such date; it has " in said(fleet, "unbook", "robot-c", "--date", "tomorrow", code=1)
    assert said(fleet, "unbook", "robot-c").endswith("is cancelled, with all its dates\n")


def test_who_would_run_into_maintenance_is_told_until_when(fleet: CliFleet) -> None:
    made = said(fleet, "maintain", "robot/c", "--at", "in 10m", "--for", "1h", "--comment", "new gripper")
    assert re.search(r"^maintenance \([0-9a-f]{8}\): robot/c: .* in 1\d min", made)
    assert made.endswith("to end it early: zscout booking cancel maintenance\n")
    waiting, said_first = fleet.begun("request waits", "request", "robot/c", "--min-runtime", "20m")
    try:
        waits = said_first[-1]
        assert re.search(
            r"^request waits: maintenance of robot/c by .*, until .* at the latest: new gripper; starts at ", waits
        )
    finally:
        end(waiting)
    assert fleet.zscout("request", "robot/c", "--min-runtime", "1m", "--", "true").returncode == 0, "it is over by then"
    nobody = said(fleet, "request", "--booking", "maintenance", "--", "true", code=1)
    assert nobody.startswith("zscout: maintenance is maintenance, not for requests; end it: zscout booking cancel ")
    assert "; 1 booking within 24 h" in said(fleet, "status").splitlines()[0]
    assert told(fleet, "status")["booked_soon"] == 1


def test_status_shows_what_is_in_maintenance(fleet: CliFleet) -> None:
    said(fleet, "maintain", "robot/b", "--at", "now", "--for", "1h", "--name", "greased")
    for state in ("maintenance", "free"):
        by = r"\S+ +greased \(\S+\) until \d\d:\d\d" if state == "maintenance" else ""
        row = re.compile(rf"^robot/b +exclusive +{state} +{by}", re.MULTILINE)
        fleet.shown("status", until=row.search)
        if state == "maintenance":
            said(fleet, "unbook", "greased")


def test_what_the_rcm_refuses_is_bad_input(fleet: CliFleet) -> None:
    assert "longer than a year" in said(fleet, "slots", "robot/a", "--for", "370d", code=2)
    assert "more than a year ahead" in said(
        fleet, "slots", "robot/a", "--for", "1h", "--from", "2100-01-01 9:00", code=2
    )
    args = ("--for", "24h", "--at", "9:00", "--every", "day")
    assert "each date would overlap the next; make it shorter, or less often" in said(
        fleet, "book", "robot/a", *args, code=2
    )
    assert "speed" in said(fleet, "book", "radio/rf0:speed=1", "--for", "1h", "--at", "9:00", code=2)
    assert "command_rate" in said(fleet, "slots", "radio/rf0:command_rate=11", "--for", "1h", code=2)
    assert 'unknown booking "surveys", and there are none' in said(fleet, "unbook", "surveys", code=1)


def test_anothers_booking_is_asked_about(fleet: CliFleet) -> None:
    with connect("script", fleet=fleet.lab.fleet_of("bob"), host="bob") as lab:
        lab.client.who = Who("bob", "test")
        bookings = BookingsClient(lab.client)
        booking = lab.run(bookings.book({"robot/a": {}}, datetime.now(UTC) + timedelta(days=5), 60, name="1"))
    whose = f"1 ({booking.id[:8]}) of bob@test is not yours; to"
    assert said(fleet, "unbook", "1", code=1) == f"zscout: {whose} cancel it all the same, add --yes\n"
    used = said(fleet, "request", "--booking", "1", "--timeout", "0.2", "--", "true", code=1)
    assert used == f"zscout: {whose} use it all the same, add --yes\n"
    taken = said(fleet, "request", "--booking", "1", "--yes", "--timeout", "0.2", "--", "true", code=1)
    assert "was not granted within" in taken
    assert said(fleet, "unbook", "1", "--yes").endswith("of bob@test is cancelled\n")
