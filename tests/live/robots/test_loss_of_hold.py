"""None drives on after losing its hold, in whichever way it was lost."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from tests.live.robots.driving import LASTS, LEFT, RIGHT, turn
from tests.live.robots.lab import Building, RobotLab, comes_true
from zscout.behaviors.client import Client
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.messages import RcState
from zscout.packets import Drive, Halt

pytestmark = pytest.mark.live

ROBOT = "robot/scout33"
NEEDS = RobotNeeds(ROBOT)
ALL = (ROBOT, "radio/rf0", "video/ch1", "framegrabber/fgrab1")
RUN_DOWN = 0.5
"""Seconds of the building that motors take to come to rest, and a step or two."""
UNTOLD = 3.0
"""Seconds within which a loss is known where the drive command must be stopped: generous."""


class Losses:
    """Loses holds and keeps how long the robot turned afterwards."""

    def __init__(self, lab: RobotLab, client: Client) -> None:
        self.lab, self.client, self.building = lab, client, lab.building
        self.took: dict[str, float] = {}
        """Seconds of the building from the loss until the wheels stood, by the way it was lost."""
        self.halted: dict[str, bool] = {}

    async def driving(self, **how: object) -> asyncio.Task[None]:
        """The robot is held and turns."""
        await self.lab.ready(self.client, *ALL)
        since = len(self.building.heard)
        task = asyncio.create_task(turn(self.client, NEEDS, "turn", **how))
        await self.turns(since)
        return task

    async def turns(self, since: int) -> None:
        """It heard a command, and so did its wheels."""
        await self.building.drives("scout33", since=since, left=LEFT, right=RIGHT)
        await comes_true(lambda: self.building.turns("scout33"), "the wheels to turn")

    async def lose(
        self, way: str, how: Callable[[], Awaitable[object]], *, task: asyncio.Task[None] | None = None
    ) -> None:
        """Loses the hold by calling `how`, and waits until the robot stands and nothing more is to come."""
        building = self.building
        lost, first = building.time, len(building.heard)
        await how()
        stood = await building.stands("scout33")
        self.took[way] = max(0.0, stood - lost)
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        self.halted[way] = bool(building.packets(Halt, "scout33", since=first))
        self._checked(building, way, first, lost, stood)

    def _checked(self, building: Building, way: str, first: int, lost: float, stood: float) -> None:
        # A drive that was under way when the hold was lost may still arrive; what it says ends by itself.
        drives = building.packets(Drive, "scout33", since=first)
        last = max([lost, *(one.time for one in drives)])
        assert stood <= last + LASTS + RUN_DOWN, way
        assert last <= lost + UNTOLD, f"{way}: driven {last - lost:.2f} s after the loss"
        assert not building.turns("scout33")


async def test_dummy() -> None: ...
