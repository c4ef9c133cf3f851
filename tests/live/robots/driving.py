"""A program that drives a robot: in a test's own loop, or as a process that can be killed.

    python -m tests.live.robots.driving robot/scout33 NAME
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from typing import Any

from zscout.behaviors.arc import Revoked, holds
from zscout.behaviors.client import Client
from zscout.behaviors.sensor_net.held_robot import HeldRobot, RobotNeeds

LEFT, RIGHT = 0.3, -0.3
"""It turns on its place."""
LASTS = 2.0
"""Seconds of each command: longer than any halt takes."""
PERIOD = 0.1


async def turn(client: Client, needs: RobotNeeds, name: str, **how: Any) -> None:
    """Has the robot turn whenever it is held, until that is over."""
    with suppress(Revoked):
        async for attempt in holds(client, name, needs.needs(), **({"min_runtime": 600} | how)):
            async with attempt as held:
                robot = HeldRobot(held, needs)
                while True:
                    await robot.drive(LEFT, RIGHT, LASTS)
                    await asyncio.sleep(PERIOD)


async def main() -> None:
    robot, name = sys.argv[1:]
    async with await Client.connect(name, host="killed") as client:
        await turn(client, RobotNeeds(robot), name)


if __name__ == "__main__":
    asyncio.run(main())
