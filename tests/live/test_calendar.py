"""Calendars of a real fleet: imported, exported, and served to programs that subscribe to them."""

from __future__ import annotations

import asyncio
import json
import signal
import urllib.error
import urllib.request
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from icalendar import Calendar, Event

from tests.hang import HANG
from tests.live.lab import Lab
from tests.ports import free_port
from zscout.behaviors.client.bookings import BookingsClient
from zscout.behaviors.client.client import Client

pytestmark = pytest.mark.live

SOON = datetime.now(UTC).replace(hour=9, minute=0, second=0, microsecond=0) + timedelta(days=3)
MAP = ("--map", "Arm 1=robot/arm1", "--zone", "Europe/Berlin")


def event(uid: str, begin: datetime, *more: str, title: str = "Arm 1") -> str:
    lines = (f"UID:{uid}", f"SUMMARY:{title}", f"DTSTART:{begin:%Y%m%dT%H%M%SZ}", "DURATION:PT1H", *more)
    return "\n".join(("BEGIN:VEVENT", *lines, "END:VEVENT"))


class Fleet:
    """Whoever has calendars, and a fleet to book in."""

    def __init__(self, lab: Lab, client: Client, port: int) -> None:
        self.lab, self.client, self.port = lab, client, port

    async def zscout(self, *args: object, code: int = 0) -> str:
        done = await self.lab.zscout("calendar", *args)
        assert done.returncode == code, done
        return done.stdout

    async def take(self, *events: str, options: tuple[str, ...] = (), code: int = 0) -> list[tuple[str, str]]:
        """Imports these; what became of each."""
        file = self.lab.folder / "robots.ics"
        file.write_text("\n".join(("BEGIN:VCALENDAR", *events, "END:VCALENDAR", "")))
        told: dict[str, Any] = json.loads(await self.zscout("import", file, *MAP, "--json", *options, code=code))
        return [(one["title"], one["result"]) for one in told["events"]]

    async def dates(self) -> list[datetime]:
        told = await BookingsClient(self.client).list()
        there = [one for one in told.bookings if not one.unbooked]
        found = sorted(date.start for one in there for date in one.dates if date.state == "open")
        return [datetime.fromtimestamp(at, UTC) for at in found]

    async def served(self, path: str = "/fleet.ics", method: str = "GET") -> tuple[int, bytes]:
        def ask() -> tuple[int, bytes]:
            request = urllib.request.Request(f"http://127.0.0.1:{self.port}{path}", method=method)
            try:
                with urllib.request.urlopen(request, timeout=HANG) as answer:  # noqa: S310 - on loopback
                    return int(answer.status), answer.read()
            except urllib.error.HTTPError as error:
                return error.code, error.read()

        return await asyncio.to_thread(ask)

    async def served_as(self, path: str, text: bytes) -> None:
        """Waits until it is: it may be what the leader told some seconds ago."""
        async with asyncio.timeout(HANG):
            while await self.served(path) != (200, text):  # noqa: ASYNC110 - another process
                await asyncio.sleep(0.2)


def events(text: bytes) -> list[Event]:
    calendar = Calendar.from_ical(text)
    assert isinstance(calendar, Calendar)
    return calendar.events


@pytest.mark.slow
async def test_a_calendar_in_and_out_and_in_again(tmp_path: Path, lab: Lab) -> None:
    port = free_port()
    lab.node("anvil", "robot/arm1", "robot/arm2")
    lab.node("bellows", extra=f"candidate = false\n[calendar]\nport = {port}")
    client = await lab.begun("worker")
    fleet = Fleet(lab, client, port)
    once = event("once", SOON)
    without = SOON + timedelta(days=8)
    weekly = event("weekly", SOON + timedelta(days=1), "RRULE:FREQ=WEEKLY;COUNT=3", f"EXDATE:{without:%Y%m%dT%H%M%SZ}")
    wanted = [SOON, SOON + timedelta(days=1), SOON + timedelta(days=15)]

    assert {*await fleet.take(once, weekly, options=("--dry-run",))} == {("Arm 1", "would be booked")}
    assert await fleet.dates() == []
    assert {*await fleet.take(once, weekly)} == {("Arm 1", "booked")}
    assert await fleet.dates() == wanted
    assert {*await fleet.take(once, weekly)} == {("Arm 1", "already there")}
    assert await fleet.dates() == wanted
    # Not free, and not read; the rest is booked.
    other = event("other", SOON + timedelta(minutes=30)), event("odd", SOON, "RRULE:FREQ=SECONDLY")
    later = event("later", SOON + timedelta(hours=2), title="Arm 1 later")
    seen = await fleet.take(*other, later, options=("--calendar", "others", "--dry-run"), code=1)
    assert seen == [("Arm 1", "not free"), ("Arm 1 later", "would be booked"), ("Arm 1", "not booked")]
    results = await fleet.take(*other, later, options=("--calendar", "others"), code=1)
    assert results == [("Arm 1", "not free"), ("Arm 1 later", "booked"), ("Arm 1", "not booked")]

    # Out: the same text by file, folder and HTTP, changed only where bookings are.
    text = (await fleet.zscout("export")).replace("\n", "\r\n").encode()
    begins = [SOON, SOON + timedelta(hours=2), SOON + timedelta(days=1)]
    assert [one.start for one in events(text)] == begins
    out = tmp_path / "out"
    mine = next(iter((await BookingsClient(client).list()).bookings)).owner
    paths = ["fleet.ics", f"owner/{mine}.ics", "rc/robot/arm1.ics", "rc/robot/arm2.ics"]
    assert "4 calendars" in await fleet.zscout("export", "--folder", out)
    assert "0 of them changed" in await fleet.zscout("export", "--folder", out)
    assert sorted(str(path.relative_to(out)) for path in out.rglob("*.ics")) == paths
    assert (out / "fleet.ics").read_bytes() == text
    for path in paths:
        await fleet.served_as(f"/{path}", (out / path).read_bytes())
    assert events((out / "rc/robot/arm2.ics").read_bytes()) == []
    assert (await fleet.served("/other"))[0] == 404
    assert (await fleet.served("/fleet.ics", "POST"))[0] == 405

    # What is no more in the calendar is given up where that is said; that of others is left alone.
    assert ("Arm 1", "kept") in await fleet.take(once)
    # What was moved would be in its own way, if it were not given up first.
    later = event("once", SOON + timedelta(minutes=20))
    seen = await fleet.take(later, options=("--sync", "--dry-run"))
    assert ("Arm 1", "would be booked") in seen
    # Not where it may be what could not be read.
    torn = event("weekly", SOON + timedelta(days=1), "RRULE:FREQ=SECONDLY")
    assert ("Arm 1", "kept") in await fleet.take(once, torn, options=("--sync",), code=1)
    assert ("Arm 1", "given up") in await fleet.take(once, options=("--sync",))
    assert await fleet.dates() == [SOON, SOON + timedelta(hours=2)]
    assert "3 of them changed" in await fleet.zscout("export", "--folder", out)
    # And comes back where that is said.
    assert ("Arm 1", "given up before") in await fleet.take(once, weekly)
    assert {*await fleet.take(once, weekly, options=("--again",))} == {("Arm 1", "already there"), ("Arm 1", "booked")}
    assert await fleet.dates() == sorted([*wanted, SOON + timedelta(hours=2)])
    assert {*await fleet.take(once, weekly, options=("--sync",))} == {("Arm 1", "already there")}

    # Maintenance, by an operator.
    await fleet.take(event("grease", SOON + timedelta(days=4)), options=("--maintenance", "--calendar", "service"))
    told = await BookingsClient(client).list()
    assert [one.name for one in told.bookings if one.maintenance] == ["Arm-1"]

    # Nobody leads: a program that subscribes goes on to show what it has.
    lab.signal("anvil", signal.SIGTERM)
    async with asyncio.timeout(HANG):
        while (await fleet.served())[0] != 503:  # noqa: ASYNC110 - another process
            await asyncio.sleep(0.2)
