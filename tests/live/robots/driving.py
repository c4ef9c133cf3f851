"""A program that drives a robot: in a test's own loop, or as a process that can be killed.

python -m tests.live.robots.driving robot/scout33 NAME
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from typing import Any

from zscout.behaviors.client.arc import Revoked, holds
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.behaviors.sensor_net.held_robot import HeldRobot, RobotNeeds

LEFT, RIGHT = 0.3, -0.3
"""It turns on its place."""
LASTS = 1.0
"""Seconds of each command: longer than any halt takes."""
PERIOD = 0.1


class Turning:
    """Has a robot turn whenever it is held, until that is over for good."""

    def __init__(self, client: Client, needs: RobotNeeds, name: str = "turn", **how: Any) -> None:
        self.arc: OpenArc | None = None
        """Once it was granted."""
        self._client, self._needs, self._name = client, needs, name
        self._how: dict[str, Any] = {"min_runtime": 600} | how
        self.task = asyncio.create_task(self._run())

    async def _run(self) -> None:
        with suppress(Revoked):
            async for attempt in holds(self._client, self._name, self._needs.needs(), **self._how):
                async with attempt as held:
                    self.arc = held.arc
                    robot = HeldRobot(held, self._needs)
                    while True:
                        await robot.drive(LEFT, RIGHT, LASTS)
                        await asyncio.sleep(PERIOD)

    async def end(self) -> None:
        """Gives back whatever it holds. Raises what went wrong before."""
        self.task.cancel()
        with suppress(asyncio.CancelledError):
            await self.task


async def main() -> None:
    robot, name = sys.argv[1:]
    async with await Client.connect(name, host="killed") as client:
        await Turning(client, RobotNeeds(robot)).task


if __name__ == "__main__":
    asyncio.run(main())
