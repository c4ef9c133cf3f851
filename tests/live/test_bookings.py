"""Bookings of real nodes outlive them: the leader killed between booking and date, all nodes restarted one after the
other, a whole fleet killed and started again."""

from __future__ import annotations

import asyncio
import signal
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
