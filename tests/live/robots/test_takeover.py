"""An operator at a terminal takes a robot over from a behavior, and gives it back, come what may."""

from __future__ import annotations

import asyncio
import statistics
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.live.robots.driving import LEFT, RIGHT, Turning
from tests.live.robots.lab import RobotLab, like
from tests.live.robots.terminal import Terminal, all_read_keys
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.drivers.packets import HaltPacket
from zscout.mesh import clock
from zscout.types import SECOND

pytestmark = pytest.mark.live

ROBOT = "robot/scout33"
ALL = (ROBOT, "radio/rf0", "video/ch1", "framegrabber/fgrab1")
ROUNDS = 20
SPEED = 0.6
"""Of `zscout drive`, unless told otherwise."""
BEHAVIOR = {"left": LEFT, "right": RIGHT}
REPEAT = 0.1
"""Seconds from one repetition of a key that is held down to the next."""
OPERATOR = {"left": SPEED, "right": SPEED}


class Shift:
    """A behavior has the robot turn all the time, and operators take it."""

    def __init__(self, lab: RobotLab) -> None:
        self.lab, self.building = lab, lab.building

    async def goes_on(self) -> None:
        """Waits until the behavior drives again."""
        await self.building.drives("scout33", since=len(self.building.heard), **BEHAVIOR)

    async def taken(self, terminal: Terminal) -> float:
        """The operator holds a key down; returns the seconds until the robot hears the first own command."""
        since = len(self.building.heard)
        pressed = clock.now()
        holding = asyncio.create_task(self._hold_down(terminal))
        try:
            heard = await self.building.drives("scout33", since=since, **OPERATOR)
        finally:
            holding.cancel()
        return (heard.at - pressed) / SECOND

    async def _hold_down(self, terminal: Terminal) -> None:
        """What a terminal sends then: one press drives for 0.6 s, and a takeover may take longer."""
        while True:
            terminal.type(b"w")
            await asyncio.sleep(REPEAT)

    async def lost(self, terminal: Terminal, how: Callable[[], None]) -> float:
        """The operator has the robot and is lost; returns the building's seconds until it stood, once the
        behavior drives again."""
        await self.taken(terminal)
        first, lost = len(self.building.heard), self.building.time
        how()
        await self.building.drives("scout33", since=first, **BEHAVIOR)
        heard = self.building.heard[first:]
        halted = next((one for one in heard if isinstance(one.packet, HaltPacket)), None)
        resumed = next(one for one in like(heard, **BEHAVIOR))
        assert halted is not None, "it was not stopped"
        assert halted.at <= resumed.at
        operators = like(heard, **OPERATOR)
        assert all(one.at <= halted.at for one in operators), "it drove on"
        return max(0.0, halted.time - lost)


@pytest.mark.slow
async def test_takeover(tmp_path: Path) -> None:
    async with RobotLab(tmp_path, frame_rate=2, channels=1) as lab:
        lab.devices("mast", "radio", "video", "framegrabber", "robot")
        drive = ("drive", "scout33", "--stand-by", "--json")
        with ExitStack() as stack:
            client = await lab.client()
            await lab.ready(client, *ALL)

            def terminal(*command: str) -> Terminal:
                return stack.enter_context(Terminal(*command, env=lab.env))

            looking = terminal(*drive, "--no-view")
            broken, killed, both = (terminal(*drive, "--no-picture") for _ in range(3))
            hung_up = stack.enter_context(Terminal(*drive[:3], "--no-picture", env=lab.env, shown=True))
            unknown = terminal("drive", "scout99")
            await all_read_keys(looking, broken, killed, hung_up, both)
            shift, turning = Shift(lab), Turning(client, RobotNeeds(ROBOT))
            await shift.goes_on()
            await looking.says("picture")

            took = []
            for _ in range(ROUNDS):
                said = len(looking.events)
                took.append(await shift.taken(looking))
                # The robot obeys before its operator knows.
                await looking.says("driving", since=said)
                looking.type(b"g")
                await shift.goes_on()
            p50, worst = 1000 * statistics.median(took), 1000 * max(took)
            print(f"from key to own command: p50 {p50:.0f} ms, worst {worst:.0f} ms of {ROUNDS}")

            stops = {
                "zscout drive killed -9": await shift.lost(killed, killed.process.kill),
                "its terminal killed -9": await shift.lost(hung_up, hung_up.kill),
                "both": await shift.lost(both, both.kill_all),
                "Ctrl-C": await shift.lost(broken, lambda: broken.type(b"\x03")),
                "q": await shift.lost(looking, lambda: looking.type(b"q")),
            }
            print("halted after, in s:", ", ".join(f"{way} {s:.2f}" for way, s in stops.items()))
            assert await looking.ended() == 0
            assert await broken.ended() == 130
            assert looking.as_before()
            assert broken.as_before()
            # 1: where SIGHUP is ignored, as by nohup: nobody reads its last word.
            assert await hung_up.ended() in (1, 129), hung_up.text
            assert "Traceback" not in hung_up.text
            events = [one["event"] for one in looking.events]
            assert events[0] == "picture"
            for event, count in (("taken", ROUNDS + 1), ("free", ROUNDS)):
                assert events.count(event) == count, event
            # The last one ended it perhaps before that was known.
            assert events.count("driving") in (ROUNDS, ROUNDS + 1)
            assert events[-1] == "ended"
            assert all(one["takeover"] > 0 for one in looking.events if one["event"] == "driving")
            assert await unknown.ended() == 2
            assert 'unknown robot "robot/scout99"; did you mean robot/scout3' in unknown.text
            await turning.end()
