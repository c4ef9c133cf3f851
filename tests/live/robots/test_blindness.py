"""Spoiled pictures, a receiver that falls silent, a robot that dies: what its behavior makes of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.live.bench import comes_to
from tests.live.robots.lab import RobotLab, comes_true
from zscout.behaviors.client.client import Client
from zscout.behaviors.perception.lens import COLUMNS, ROWS
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.place_robot import PlaceRobot
from zscout.behaviors.sensor_net.scout import NO_PICTURE_TIMEOUT, NO_SIGNAL_TIMEOUT, Scout
from zscout.drivers.packets import DrivePacket
from zscout.mesh import clock
from zscout.messages import BehaviorSaid
from zscout.types import SECOND

pytestmark = [pytest.mark.live, pytest.mark.slow]

ALL = ("robot/scout33", "robot/scout35", "radio/rf0", "video/ch1", "video/ch2", "framegrabber/fgrab1")


class Placed:
    """`place_robot` for scout33 in the test's own loop, and all that it says."""

    def __init__(self, lab: RobotLab, client: Client, *, speed: float | None = None) -> None:
        self.said: list[BehaviorSaid] = []
        self.behavior = PlaceRobot("scout33", RobotNeeds("robot/scout33"))
        self.task = asyncio.create_task(self.behavior.perform(lab.context(client, self.said.append, speed=speed)))
        self._building = lab.building

    async def says(self, doing: str, detail: str = "", *, since: int = 0) -> None:
        """Waits until it has said so, after its first `since` sayings."""
        await self._comes(
            lambda: any(one.doing == doing and detail in one.detail for one in self.said[since:]), f"{doing} {detail}"
        )

    async def drives(self, *, left: int | None = None) -> int:
        """Waits until it moves by what it sees on a channel, not the one that it `left`; returns that."""
        building = self._building
        body = building.world.bodies["scout33"]
        await self._comes(lambda: body.camera not in (None, left) and body.warmth(building.time) == 1, "a picture")
        since = len(building.heard)
        await self._comes(lambda: bool(building.packets(DrivePacket, "scout33", since=since)), "it to drive")
        assert body.camera is not None
        return body.camera

    async def _comes(self, condition: Callable[[], bool], what: str) -> None:
        try:
            await comes_true(lambda: self.task.done() or condition(), what)
        except AssertionError as error:
            said = [(one.doing, one.detail) for one in self.said]
            raise AssertionError(f"{error}; it said {said}") from None
        if self.task.done():
            self.task.result()

    async def end(self) -> None:
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)


async def test_jammed_and_silent_channels_are_left_and_a_dead_robot_is_lost(tmp_path: Path) -> None:
    async with RobotLab(tmp_path, speed=4, frame_rate=3, channels=2) as lab:
        lab.devices("mast", "radio", "video", "framegrabber", "robot")
        client = await lab.client()
        await lab.ready(client, *ALL)
        placed, building = Placed(lab, client), lab.building
        channel = await placed.drives()

        # Asked for in the regular way, the channel is refused to a second robot.
        video = f"video/ch{channel}"
        second = {"robot/scout35": {}, "radio/rf0": {"command_rate": 2}, video: {"transmitters": 1}}
        arc = await client.request("second", second, min_runtime=600)
        await comes_to(arc, "queued", "spoil each other")
        assert "scout33-hide transmits on it already" in arc.reason
        await client.end(arc)

        # Its transmitter goes off unasked: it is told again, within the same hold.
        body, since = building.world.bodies["scout33"], len(placed.said)
        await building.in_world(lambda: body.transmit(None, building.world.time))
        await placed.drives()
        assert not any(one.doing == "wait" for one in placed.said[since:])

        # By force: somebody switches the other robot's camera on, around all votes.
        since = len(placed.said)
        other = building.world.bodies["scout35"]
        await building.in_world(lambda: other.transmit(channel, building.world.time))
        jammed = building.time
        await placed.says("search", "pictures are jammed: waits", since=since)
        told, stood = building.time, await building.stands("scout33")
        await placed.says("wait", f"no picture on {video} for {NO_PICTURE_TIMEOUT:g} s", since=since)
        left = building.time
        assert stood == await building.stands("scout33"), "it moved on in the dark"
        await placed.drives(left=channel)
        await building.in_world(lambda: other.transmit(None, building.world.time))
        print(
            f"jammed: stands after {max(0, stood - jammed):.1f} s of the building, says so after "
            f"{told - jammed:.1f} s, leaves the channel after {left - jammed:.1f} s"
        )
        await placed.end()

        # A receiver that falls silent: the framegrabber is lost before the behavior's patience is, which
        # takes its time as in a real building; then it goes on through the other channel.
        placed = Placed(lab, client, speed=1)
        channel, stalled = await placed.drives(), clock.now()
        building.stall(channel)
        await placed.says("wait", f"video/ch{channel} receives no picture")
        await placed.drives(left=channel)
        print(f"stalled: drives on through the other channel after {(clock.now() - stalled) / SECOND:.1f} s")
        building.stall(channel, stalled=False)
        await placed.end()

        # Its battery is gone: it is seen on no channel.
        placed = Placed(lab, client)
        await placed.drives()
        since = len(placed.said)
        building.kill("scout33")
        killed = building.time
        await placed.says("lost", since=since)
        print(f"dead: lost after {building.time - killed:.1f} s")
        assert sum(one.detail.startswith("no picture on") for one in placed.said[since:]) == 2
        await placed.end()


def test_a_channel_without_any_picture_is_left_and_the_robot_not_blamed() -> None:
    snow = np.random.default_rng(1).integers(0, 256, (ROWS, COLUMNS), np.uint8)
    for picture, silent in ((None, True), (snow, False)):
        scout = Scout()
        scout.held(100.0)
        for tick in range(int(NO_SIGNAL_TIMEOUT) + 2):
            assert not scout.see(100.0 + tick, picture, "video/ch1").blind
        # The framegrabber has given up: the hold ends before the robot's own patience does.
        scout.released(100.0 + NO_SIGNAL_TIMEOUT + 1)
        assert scout.no_signal == silent
        assert not scout.blindness.dead
        asked = scout.blindness.choose(107.0, ["video/ch1", "video/ch2"])
        assert asked == ("video/ch2" if silent else None)
