"""Bookings of real nodes outlive them: the leader killed between booking and date, all nodes restarted one after the
other, a whole fleet killed and started again."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.lab import Lab, awaited
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.bookings import BookingsClient
from zscout.behaviors.client.client import Client
from zscout.keyexpr import Role
from zscout.messages import BookingView

pytestmark = [pytest.mark.live, pytest.mark.slow]

BOTH = ("anvil", "bellows")
SOON = 8.0
"""Seconds from a booking to its date: longer than a fleet takes to begin anew on a busy machine, most times; a booking
waits for its owner, so that nothing fails where it is not."""


def in_seconds(seconds: float) -> datetime:
    return datetime.now(UTC) + timedelta(seconds=seconds)


async def listed(bookings: BookingsClient, until: Callable[[dict[str, BookingView]], bool]) -> dict[str, BookingView]:
    """What is booked, by name, as soon as it is so."""

    async def found() -> dict[str, BookingView]:
        return {one.name: one for one in (await bookings.list()).bookings}

    return await awaited(found, until)


async def fleet_of_two(lab: Lab) -> tuple[Client, BookingsClient]:
    """The first leads: the other comes when it does."""
    lab.node(BOTH[0], "robot/a")
    client = await lab.begun("program")
    lab.node(BOTH[1], "robot/b")
    await lab.ready(client, "robot/a", "robot/b")
    await lab.candidates(client, *BOTH)
    return client, BookingsClient(client)


async def taken_up(client: Client, booking: BookingView) -> float:
    """Takes it up; returns by how many seconds its hold began after its date."""
    async with asyncio.timeout(HANG + SOON), hold(client, "taken", **BookingsClient.terms(booking), keep=False) as held:
        assert held.rcs == sorted(booking.needs)
        began = datetime.now(UTC)
    return began.timestamp() - booking.start


async def test_bookings_outlive_a_restart_of_every_node_one_after_the_other(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=BOTH) as lab:
        client, bookings = await fleet_of_two(lab)
        weekly = await bookings.book(
            {"robot/*": {}}, in_seconds(3600), 600, name="weekly", every=7, until=in_seconds(30 * 86_400)
        )
        gone = await bookings.book({"robot/a": {}}, in_seconds(7200), 600, name="gone")
        await bookings.unbook(gone.id)
        await bookings.unbook(weekly.id, weekly.dates[1].start)
        for host, rc in zip(BOTH, ("robot/a", "robot/b"), strict=True):
            other = "bellows" if host == "anvil" else "anvil"
            lab.signal(host, signal.SIGTERM)
            assert lab.nodes[host].wait(timeout=HANG) == 0
            await lab.living(client, Role.RCM, lambda hosts, other=other: hosts == [other])  # type: ignore[misc]
            lab.node(host, rc)
            await lab.candidates(client, *BOTH)
        await lab.ready(client, "robot/a", "robot/b")
        found = await listed(bookings, lambda found: bool(found) and not found["weekly"].dates[0].danger)
        assert [*found] == ["weekly"]
        dates = [date.start for date in weekly.dates]
        assert [date.start for date in found["weekly"].dates] == [dates[0], *dates[2:]]
        # While one robot was away the other was kept.
        assert found["weekly"].dates[0].bound["robot/*"] in ("robot/a", "robot/b")


async def test_a_fleet_that_was_killed_whole_keeps_what_was_booked(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=BOTH) as lab:
        client, bookings = await fleet_of_two(lab)
        booked = await bookings.book({"robot/a": {}, "robot/b": {}}, in_seconds(SOON), 120, name="survey")
        gone = await bookings.book({"robot/a": {}}, in_seconds(7200), 600, name="gone")
        await bookings.unbook(gone.id)
        for host in BOTH:
            lab.signal(host, signal.SIGKILL)
        for host in BOTH:
            lab.nodes[host].wait()
        for host, rc in zip(BOTH, ("robot/a", "robot/b"), strict=True):
            lab.node(host, rc)
        await lab.ready(client, "robot/a", "robot/b")
        assert [*await listed(bookings, lambda found: bool(found))] == ["survey"]
        assert await taken_up(client, booked) > -0.5
        assert not await listed(bookings, lambda found: not found)


WRONG_CLOCK = """
import sys, time
right, ahead = time.time, sys.argv.pop(1)
time.time = lambda: right() + float(open(ahead).read())
from zscout.node import main
main()
"""


async def test_a_host_whose_clock_is_put_right_leads_in_the_right_time_and_its_hold_is_no_longer(lab: Lab) -> None:
    ahead, file = lab.folder / "ahead", lab.folder / "anvil.toml"
    ahead.write_text("-259200")
    rc = '[[rc]]\nname = "robot/a"\ndriver = "exclusive"\n'
    text = f'[node]\nhost = "anvil"\nfleet = "fleet.toml"\nstate = "{lab.folder}/kept"\n{lab.security_of("anvil")}{rc}'
    file.write_text(text)
    lab.nodes["anvil"] = lab.spawn([sys.executable, "-c", WRONG_CLOCK, str(ahead), str(file)], log="anvil.log")
    client = await lab.client("program")
    await lab.ready(client, "robot/a")
    bookings = BookingsClient(client)
    assert abs((await bookings.list()).time - time.time() + 259_200) < HANG
    # Until it is known that no other host knows the time of the fleet, the leader refuses, and the clock just counts.
    await bookings.book({"robot/a": {}}, in_seconds(3_000 - 259_200), 60, name="skipped")
    async with hold(client, "mine", {"robot/a": {}}, min_runtime=600) as held:
        began = time.monotonic()
        ahead.write_text("0")
        told = await awaited(bookings.list, lambda told: told.corrected is not None)
        assert told.corrected is not None
        assert abs(told.corrected.by - 259_200) < 1
        assert abs(told.time - time.time()) < HANG
        assert not told.clocks
        assert held.active
        booking = await bookings.book({"robot/a": {}}, in_seconds(3_000), 60, name="later")
        assert [date.start - told.time < 3_600 for date in booking.dates] == [True]
        assert [one.name for one in (await bookings.list()).bookings] == ["later"]
        lasted = time.monotonic() - began
    done = await awaited(lambda: lab.zscout("history", "--json"), lambda done: '"outcome":"released"' in done.stdout)
    (past,) = json.loads(done.stdout)["holds"]
    assert past["arc"] == "mine"
    assert past["held"] == pytest.approx(lasted, abs=1)
