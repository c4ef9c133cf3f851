"""Robots driven over a real mesh: robot RC and radio RC on two nodes, packets on a pty."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.drivers.post import GANG, TURN, held, is_in, obeyed
from tests.drivers.ptys import PtyLine
from tests.live.bench import answer
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client
from zscout.drivers.packets import CameraPacket, DrivePacket, HaltPacket, Packet, StopPacket
from zscout.mesh import clock
from zscout.types import SECOND, Grant, Ns

pytestmark = [pytest.mark.live, pytest.mark.slow, pytest.mark.real_time]


def mast(lab: Lab, line: PtyLine) -> None:
    lab.node(
        "mast",
        extra=f"""
        [[rc]]
        name = "radio/rf0"
        driver = "radio"
        port = "{line.link}"
        [[rc]]
        name = "video/ch1"
        driver = "video"
        [[rc]]
        name = "video/ch2"
        driver = "video"
        """,
    )


def cart(lab: Lab, host: str) -> None:
    lab.node(
        host,
        extra="""candidate = false
        [[rc]]
        name = "robot/r1"
        driver = "robot"
        id = 1
        radio = "radio/rf0"
        channels = { "video/ch1" = 1, "video/ch2" = 7 }
        """,
    )


@asynccontextmanager
async def driven(folder: Path) -> AsyncIterator[tuple[Lab, PtyLine, Client]]:
    line = PtyLine(folder / "tty")
    async with Lab(folder) as lab:
        mast(lab, line)
        cart(lab, "cart")
        client = await lab.client()
        await lab.ready(client, *GANG)
        yield lab, line, client
    line.unplug()


async def test_a_second_node_that_offers_a_held_robot_leaves_it_alone(tmp_path: Path) -> None:
    async with driven(tmp_path) as (lab, line, client):
        _, grant = await held(client, "drives", GANG)
        assert await answer(obeyed(client, "robot/r1", grant, TURN)) == "done"
        # Until it drives, the halt from before it was held is repeated.
        await line.until(is_in(DrivePacket))
        halts = [packet for packet in line.packets if isinstance(packet, HaltPacket)]
        cart(lab, "other")
        await lab.logged("other", "robot/r1 is on standby: duplicate of robot/r1 at cart")
        await lab.logged("other", "other is on the mesh")
        for _ in range(20):
            assert await answer(obeyed(client, "robot/r1", grant, TURN)) == "done"
            await asyncio.sleep(0.1)
        assert [packet for packet in line.packets if isinstance(packet, HaltPacket)] == halts


async def test_a_robot_is_driven_only_by_its_holder_and_stops_whenever_nobody_drives_it(tmp_path: Path) -> None:
    async with driven(tmp_path) as (lab, line, client):
        brief = asyncio.create_task(lab.holder("brief"))
        # Nobody knows what it did before: it was halted first.
        assert isinstance(await line.until(lambda packets: packets and packets[0]), HaltPacket)

        def drive(grant: Grant, **how: Any) -> Any:
            return obeyed(client, "robot/r1", grant, TURN | how)

        async def driving(order: Awaitable[Any]) -> int:
            """Waits until the robot drives by this order; what it hears from then on has this number."""
            since = len(line.heard)
            await order
            packet = await line.until(turning, since=since)
            return line.packets.index(packet, since) + 1

        assert await answer(drive(Grant((await lab.state(client, lambda _: True)).term, 0))) == "free"
        arc, grant = await held(client, "hide", GANG)
        since = len(line.heard)
        done = await drive(grant, lasts=0.3)
        assert 0 < done.result["after"] < 1
        packet = await line.until(is_in(DrivePacket), since=since)
        assert (packet.left, packet.right, packet.lasts) == (
            pytest.approx(0.5, abs=0.01),
            pytest.approx(-0.5, abs=0.01),
            0.3,
        )
        await obeyed(client, "robot/r1", grant, {"name": "camera", "on": True})
        await line.until(transmitting(1), since=since)
        since = len(line.heard)
        await obeyed(client, "robot/r1", grant, {"name": "camera", "on": False})
        await line.until(transmitting(0), since=since)

        for do, word in (
            ({"name": "drive", "left": 2, "right": 0, "lasts": 1}, "bad_command"),
            ({"name": "drive", "left": 0, "right": 0, "lasts": 6}, "bad_command"),
            ({"name": "drive", "left": 0, "right": 0, "lasts": 1, "up": 1}, "bad_command"),
            ({"name": "camera"}, "bad_command"),
            ({"name": "halt"}, "unknown_command"),
        ):
            assert await answer(obeyed(client, "robot/r1", grant, do)) == word

        # A command that lasts, and no other: the dead man's stop.
        began = clock.now()
        since = await driving(drive(grant))
        await line.until(is_in(StopPacket), since=since)
        assert line_time(line, StopPacket, since) - began > 0.4 * SECOND
        await obeyed(client, "robot/r1", grant, TURN | {"left": 0, "right": 0})

        # The hold ends while it drives.
        since = await driving(obeyed(client, "robot/r1", grant, TURN))
        await client.end(arc)
        await line.until(is_in(HaltPacket), since=since)
        # The radio may know that the hold has ended before the robot does.
        await lab.held_by(client, "robot/r1")
        assert await answer(drive(grant)) == "ended"

        # Taken over while it drives.
        again, grant = await held(client, "patrol", GANG)
        operator = await lab.client()
        since = await driving(obeyed(client, "robot/r1", grant, TURN))
        over, his = await held(operator, "operator", GANG, priority=10)
        await line.until(is_in(HaltPacket), since=since)
        await lab.held_by(client, "robot/r1", "operator")
        assert await answer(drive(grant)) == "ended"
        # No halt of the earlier hold, repeated or late, stops the robot under the next one.
        since = await driving(obeyed(operator, "robot/r1", his, TURN))
        await line.until(is_in(StopPacket), since=since)
        assert HaltPacket not in {type(packet) for packet in line.packets[since:]}
        await operator.end(over)

        # Its client is killed while it drives: the RCM sees that, and the RC is told.
        holder = await brief
        await holder.order("ask", arc="brief", needs=GANG, priority=5, min_runtime=600)
        await holder.event("entered")
        since = await driving(holder.order("command", rc="robot/r1", do=TURN, ttl=10))
        holder.kill()
        await line.until(is_in(HaltPacket), since=since)

        # The robot's node is killed while it drives: its radio halts what was driven under the hold.
        patrol = await client.granted(again)
        assert patrol is not None
        since = await driving(obeyed(client, "robot/r1", patrol, TURN))
        figures = (await lab.rc(client, "robot/r1")).figures
        assert figures["commands"] >= 5
        assert figures["halts"] >= 3
        lab.signal("cart", signal.SIGKILL)
        await line.until(is_in(HaltPacket), since=since)


@pytest.mark.parametrize("said", [True, False])
async def test_a_camera_that_warmed_up_under_one_hold_stays_on_in_the_one_that_continues_it(
    tmp_path: Path, said: bool
) -> None:
    async with driven(tmp_path) as (lab, line, client):
        lab.node("desk", "framegrabber/f")
        await lab.ready(client, "framegrabber/f")
        warm, grant = await held(client, "warm", GANG, priority=-1, min_runtime=0.01)
        await obeyed(client, "robot/r1", grant, {"name": "camera", "on": True})
        await line.until(transmitting(1))
        since, more = len(line.heard), GANG | {"framegrabber/f": {}}
        arc, watching = await held(client, "watch", more, priority=0, continues=warm.name if said else "")
        await obeyed(client, "robot/r1", watching, TURN)
        await line.until(is_in(DrivePacket), since=since)
        kinds = {type(packet) for packet in line.packets[since:]}
        assert (HaltPacket in kinds) is not said
        assert await answer(obeyed(client, "robot/r1", grant, TURN)) == "ended"
        # And as ever when nobody holds it any more.
        since = len(line.heard)
        await client.end(warm)
        await client.end(arc)
        await line.until(is_in(HaltPacket), since=since)


def turning(packets: list[Packet]) -> Packet | None:
    """The first packet that turns a robot's wheels, if there is one."""
    return next((packet for packet in packets if isinstance(packet, DrivePacket) and packet.left), None)


def transmitting(channel: int) -> Callable[[list[Packet]], bool]:
    """Whether a robot was set to this channel."""
    return lambda packets: any(packet == CameraPacket(1, packet.number, channel) for packet in packets)


def line_time(line: PtyLine, kind: type[Packet], since: int) -> Ns:
    return next(at for at, packet in line.heard[since:] if isinstance(packet, kind))
