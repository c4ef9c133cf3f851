"""One robot's ARCs, to hide and to watch: what becomes of them in a move, and in the step that is the last."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import pytest

from tests.behaviors.client.small_fleet import small_fleet
from tests.behaviors.sensor_net.test_warming_up import NEEDS, RobotFleet, Willing, robot_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.client import Client
from zscout.behaviors.perception.lens import Picture
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.place_robot import PlaceRobot
from zscout.behaviors.sensor_net.scout import Scout, Step
from zscout.behaviors.tree import BehaviorContext
from zscout.messages import Holder


class Robot:
    """Its behavior, as a program runs it. No picture ever comes, and it waits for one for ever."""

    def __init__(
        self, client: Client, state: dict[str, Any] | None = None, needs: RobotNeeds = NEEDS, name: str = "z"
    ) -> None:
        self.behavior = PlaceRobot(name, needs)
        if state is not None:
            self.behavior.restore(state)
        self.scout.blindness.timeout = 1e9
        self._client = client
        self._task: asyncio.Task[Any] | None = None

    @property
    def scout(self) -> Scout:
        return self.behavior.scout

    def is_hidden(self) -> None:
        self.scout.hider._robot.phase = "hidden"

    def start(self) -> Robot:
        async def safe_point() -> None:
            await asyncio.sleep(0)

        context = BehaviorContext(self._client, safe_point, lambda _said: None)
        self._task = asyncio.create_task(self.behavior.perform(context))
        return self

    async def stop(self) -> None:
        assert self._task is not None
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task


async def moved(robot: Robot, old: Client, new: Client, between: Callable[[], Any] | None = None) -> Robot:
    """The same robot in another program. `between`: what comes before that one begins."""
    old.pause()
    state = robot.behavior.checkpoint()
    new.expect(old.open_requests())
    await old.hand_over_all(new.mesh.me)
    if between is not None:
        await between()
    await old.close()
    await robot.stop()
    return Robot(new, state).start()


@pytest.mark.parametrize(("taken", "phase"), [(False, "hidden"), (True, "check")], ids=["held on", "taken meanwhile"])
async def test_who_is_driven_away_as_he_moves_looks_whether_he_is_still_hidden(taken: bool, phase: str) -> None:
    async with robot_fleet("old", "new", "operator", "asks") as (fleet, (old, new, operator, _asks)):
        robot = Robot(old)
        robot.is_hidden()
        robot.start()
        await asyncio.sleep(2)
        robot.is_hidden()

        async def drive() -> None:
            if taken:
                await operator.request("drive", {"robot/z": {}}, priority=9, min_runtime=20, keep=False)

        robot = await moved(robot, old, new, drive)
        await asyncio.sleep(25)
        assert (await fleet.arcs("z-watch"), robot.scout.hider._robot.phase) == (["running"], phase)
        await robot.stop()


async def test_a_channel_that_was_asked_for_by_name_is_so_after_a_move() -> None:
    async with robot_fleet("old", "new", "asks") as (fleet, (old, new, _asks)):
        robot = Robot(old)
        robot.behavior._clock.seconds = 100.0
        # The other one is to be avoided for one more second.
        robot.scout.blindness._bad = {"video/1": 41.0}
        robot.start()
        await asyncio.sleep(2)
        robot = await moved(robot, old, new)
        await asyncio.sleep(1)
        state = await fleet.state(-1)
        assert [(view.arc, view.client) for view in state.holds] == [("z-hide", "h/new")]
        assert not state.queue
        await robot.stop()


async def test_no_channel_is_taken_that_its_parameters_leave_out() -> None:
    async with robot_fleet("one", "asks") as (fleet, (client, _asks)):
        robot = Robot(client, needs=replace(NEEDS, video="video/1"))
        robot.scout.blindness._bad = {"video/1": 0.0}
        robot.start()
        await asyncio.sleep(2)
        state = await fleet.state(-1)
        assert "video/1" in state.holds[0].needs
        await robot.stop()


async def test_a_robot_may_have_as_long_a_name_as_an_arc() -> None:
    async with robot_fleet("one", "asks") as (fleet, (client, _asks)):
        robot = Robot(client, name="z" * 64)
        robot.is_hidden()
        robot.start()
        await asyncio.sleep(2)
        assert await fleet.arcs(f"{'z' * 58}-watch") == ["running"]
        await robot.stop()


class Slow(Willing):
    """Takes a while to stop."""

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        await asyncio.sleep(0.3 * (do["name"] == "stop"))
        return True


async def test_who_is_preempted_in_the_step_that_was_the_last_of_his_task_goes_on_with_the_other() -> None:
    async with small_fleet("one", "operator", "asks", kind=RobotFleet) as (fleet, (client, operator, _asks)):
        assert isinstance(fleet, RobotFleet)
        next(rc for rc in fleet.rcs if rc.name == "robot/z").driver = Slow()
        robot = Robot(client)
        see, looks = robot.scout.see, 0

        def hides_at_last(now: float, picture: Picture | None, channel: str) -> Step:
            nonlocal looks
            looks += 1
            if looks == 3:
                robot.is_hidden()
            step = see(now, picture, channel)
            return replace(step, left=0.3, right=0.3, lasts=0.5) if looks == 2 else step

        robot.scout.see = hides_at_last  # type: ignore[method-assign]
        robot.start()
        await until(lambda: robot.scout.task == "watch")
        await operator.request("drive", {"robot/z": {}}, priority=9, min_runtime=3, keep=False)
        await asyncio.sleep(5)
        assert [await fleet.arcs(name) for name in ("z-hide", "z-watch")] == [[], ["running"]]
        await robot.stop()
