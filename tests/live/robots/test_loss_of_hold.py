"""None drives on after losing its hold, in whichever way it was lost."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from tests.hang import HANG
from tests.live.robots.driving import LASTS, LEFT, RIGHT, Turning
from tests.live.robots.lab import RobotLab, comes_true
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.drivers.packets import DrivePacket, HaltPacket
from zscout.mesh import clock
from zscout.messages import RcState
from zscout.types import SECOND

pytestmark = [pytest.mark.live, pytest.mark.slow]

ROBOT = "robot/scout33"
NEEDS = RobotNeeds(ROBOT)
ALL = (ROBOT, "radio/rf0", "video/ch1", "framegrabber/fgrab1")
RUN_DOWN = 0.8
"""Seconds of the building that motors take to come to rest, and what its clock may be behind."""
UNDER_WAY = 3.0
"""Seconds after the loss in which a drive may still arrive that was sent before: generous."""


class Losses:
    """Loses holds and keeps how long the robot turned afterwards."""

    def __init__(self, lab: RobotLab, client: Client) -> None:
        self.lab, self.client, self.building = lab, client, lab.building
        self.took: dict[str, float] = {}
        """Seconds of the building from the loss until the wheels stood, by the way it was lost."""

    async def driving(self, **how: Any) -> Turning:
        """The robot is held and turns."""
        await self.lab.ready(self.client, *ALL)
        since = len(self.building.heard)
        turning = Turning(self.client, NEEDS, **how)
        await self.turns(since)
        return turning

    async def turns(self, since: int) -> None:
        """It heard a command, and so did its wheels."""
        await self.building.drives("scout33", since=since, left=LEFT, right=RIGHT)
        await comes_true(lambda: self.building.turns("scout33"), "the wheels to turn")

    async def lose(self, way: str, how: Callable[[], Awaitable[object]], *, halted: bool = True) -> None:
        """Loses the hold by `how`, which returns at the moment of the loss, and waits until the robot
        stands and was told so."""
        building = self.building
        first = len(building.heard)
        await how()
        lost = building.time
        stood = await building.stands("scout33")
        self.took[way] = max(0.0, stood - lost)
        if halted:
            await building.halts("scout33", since=first)
        # A drive that was under way when the hold was lost may arrive; what it says ends by itself.
        drives = building.packets(DrivePacket, "scout33", since=first)
        last = max([lost, *(one.time for one in drives)])
        assert stood <= last + LASTS + RUN_DOWN, way
        assert last <= lost + UNDER_WAY, f"{way}: driven {last - lost:.2f} s after the loss"
        assert not building.turns("scout33"), way

    async def released(self) -> None:
        turning = await self.driving()
        ended: list[asyncio.Task[None]] = []

        async def release() -> None:
            ended.append(asyncio.create_task(turning.end()))

        await self.lose("released", release)
        await ended[0]

    async def preempted(self) -> None:
        turning = await self.driving()
        rivals: list[OpenArc] = []

        async def preempt() -> None:
            rivals.append(await self.client.request("rival", {ROBOT: {}}, priority=5, min_runtime=600))
            assert rivals[0].state == "running"

        await self.lose("preempted", preempt)
        await asyncio.gather(turning.end(), self.client.end(rivals[0]))

    async def time_over(self) -> None:
        # Within that it is confirmed, tunes, warms up and drives.
        turning = await self.driving(min_runtime=10.0, keep=False)

        async def over() -> None:
            assert turning.arc is not None
            await asyncio.sleep((turning.arc.end - clock.now()) / SECOND)

        await self.lose("time over", over)
        await turning.task

    async def client_killed(self) -> None:
        since = len(self.building.heard)
        program = self.lab.spawn([sys.executable, "-m", "tests.live.robots.driving", ROBOT, "victim"])
        await self.turns(since)
        await self.lose("client killed -9", at_once(program.kill))

    async def radio_unplugged(self) -> None:
        turning, building = await self.driving(), self.building
        await self.lose("radio unplugged", at_once(building.unplug_radio), halted=False)
        since = len(building.heard)
        building.plug_radio()
        # What it was told last is not known: it is halted before anybody may drive it.
        await building.halts("scout33", since=since)
        first = next(one.packet for one in building.heard[since:] if one.packet.robot == 33)
        assert isinstance(first, HaltPacket)
        await turning.end()

    async def node_killed(self) -> None:
        turning = await self.driving()
        await self.lose("the robot's node killed -9", at_once(self.lab.nodes["cart"].kill))
        await turning.end()
        self.lab.devices("cart", "robot")

    async def no_rcm(self) -> None:
        turning, free = await self.driving(), asyncio.Event()

        def on_state(_key: str, state: RcState) -> None:
            if not state.holders:
                free.set()

        mesh = self.client.mesh
        watch = mesh.subscribe(mesh.keys.rc_state(ROBOT), RcState, on_state)
        self.lab.signal("lead", signal.SIGKILL)
        async with asyncio.timeout(HANG):
            await self.lose("no RCM for the hold lease", free.wait)
        watch.close()
        await turning.end()


def at_once(act: Callable[[], object]) -> Callable[[], Awaitable[None]]:
    async def do() -> None:
        act()

    return do


async def test_none_drives_on_after_losing_its_hold(tmp_path: Path) -> None:
    # The lease ends in this test, and for nobody whose process only stands still for a while.
    lease = "[timing]\nhold_lease = 8\n"
    async with RobotLab(tmp_path, lease=4, candidates=["lead"], extra=lease, frame_rate=1) as lab:
        lab.node("lead")
        lab.devices("mast", "radio", "video", "framegrabber")
        lab.devices("cart", "robot")
        losses = Losses(lab, await lab.client())
        await losses.released()
        await losses.preempted()
        await losses.time_over()
        await losses.client_killed()
        await losses.radio_unplugged()
        await losses.node_killed()
        await losses.no_rcm()
        ways = ", ".join(f"{way} {took:.2f} s" for way, took in losses.took.items())
        print(f"building's seconds from the loss of the hold until the wheels stand: {ways}")
        print(f"worst {max(losses.took.values()):.2f} s; a drive command lasts {LASTS} s")
