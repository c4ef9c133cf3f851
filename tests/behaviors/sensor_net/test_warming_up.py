"""A robot's camera warms up before its turn: what becomes of that ARC, whatever comes in between."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any

import pytest

from tests.behaviors.client.small_fleet import FLEET, SmallFleet, begin_move, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import Revoked
from zscout.behaviors.client.client import Client
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.place_robot import PlaceRobot, RobotTask, Slots
from zscout.behaviors.tree import BehaviorContext
from zscout.config.fleet import Fleet
from zscout.drivers.driver import Driver
from zscout.drivers.resource_controller import ResourceController
from zscout.messages import Holder
from zscout.types import SECOND

NEEDS = RobotNeeds("robot/z", "radio/r", "video/*", "framegrabber/f")


class Willing(Driver):
    """Takes any command."""

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        return True


class RobotFleet(SmallFleet):
    """With all that a robot needs to watch."""

    def __init__(self, fleet: Fleet = FLEET) -> None:
        super().__init__(fleet)
        self.rcs += [
            ResourceController(
                self.devices, name, Willing(), hold_lease=FLEET.timing.hold_lease / SECOND, stall=self.stall
            )
            for name in ("robot/z", "radio/r", "video/1", "video/2", "framegrabber/f")
        ]

    async def arcs(self, name: str) -> list[str]:
        """States of the ARCs of this name."""
        state = await self.clients[-1].state()
        assert state is not None
        held = ["running" for view in state.holds if view.arc == name]
        return held + ["queued" for view in state.queue if view.arc == name]


@asynccontextmanager
async def robot_fleet(*clients: str) -> AsyncIterator[tuple[RobotFleet, list[Client]]]:
    async with small_fleet(*clients, kind=RobotFleet) as (fleet, made):
        assert isinstance(fleet, RobotFleet)
        yield fleet, made


def watches(client: Client, slots: Slots | None = None) -> asyncio.Task[Any]:
    """A robot that waits for its turn to watch, and has it."""

    async def safe_point() -> None:
        pass

    task = RobotTask("watch", PlaceRobot("z", NEEDS, slots))
    return asyncio.create_task(task.perform(BehaviorContext(client, safe_point, lambda _said: None)))


async def over(watching: asyncio.Task[Any]) -> None:
    watching.cancel()
    with suppress(asyncio.CancelledError, Revoked):
        await watching


async def test_a_camera_that_did_not_come_to_warm_up_is_not_waited_for_any_more() -> None:
    """All channels were taken until its turn came: it would begin to warm up as that is over."""
    async with robot_fleet("robot", "other", "asks") as (fleet, (client, other, _asks)):
        needs: dict[str, Any] = {"framegrabber/f": {}, "video/1": {}, "video/2": {}}
        await other.request("other", needs, priority=5, min_runtime=3, keep=False)
        watching = watches(client)
        await asyncio.sleep(1)
        assert [await fleet.arcs(name) for name in ("z-watch", "z-warm")] == [["queued"], ["queued"]]
        await asyncio.sleep(3)
        assert [await fleet.arcs(name) for name in ("z-watch", "z-warm")] == [["running"], []]
        await over(watching)
        assert [await fleet.arcs(name) for name in ("z-watch", "z-warm")] == [[], []]


@pytest.mark.parametrize("why", ["another hides first", "the framegrabber is gone"])
async def test_a_camera_is_switched_off_again_where_its_turn_does_not_come(why: str) -> None:
    async with robot_fleet("robot", "other", "asks") as (fleet, (client, other, _asks)):
        await other.request("other", {"framegrabber/f": {}}, priority=1, min_runtime=8)
        watching = watches(client)
        await asyncio.sleep(5.5)
        assert [await fleet.arcs(name) for name in ("z-watch", "z-warm")] == [["queued"], ["running"]]
        if why == "another hides first":
            await other.request("hides", {"framegrabber/f": {}}, priority=2, min_runtime=60, keep=False)
        else:
            next(rc for rc in fleet.rcs if rc.name == "framegrabber/f").fail("unplugged")
        await asyncio.sleep(8)
        assert [await fleet.arcs(name) for name in ("z-watch", "z-warm")] == [["queued"], []]
        if why == "another hides first":
            # And on again, ahead of when it does: who hides began as the other had its time, which is protected.
            await asyncio.sleep(53)
            assert await fleet.arcs("z-warm") == ["running"]
        await over(watching)


async def test_what_warms_up_is_its_own_again_where_a_move_has_failed() -> None:
    """It was left to nobody: held for as long as the client lived."""
    async with robot_fleet("robot", "other", "new", "asks") as (fleet, (client, other, new, _asks)):
        await other.request("other", {"framegrabber/f": {}}, priority=5, min_runtime=3.9, keep=False)
        watching = watches(client)
        await asyncio.sleep(1)
        assert await fleet.arcs("z-warm") == ["running"]
        begin_move(client, new)
        await client.internals.hand_over_all(new.mesh.me)
        # By now all of it is somebody else's, who does not come to anything.
        await asyncio.sleep(2)
        await new.close()
        client.internals.take_back()
        await asyncio.sleep(0.5)
        await over(watching)
        assert await fleet.arcs("z-warm") == []


async def test_a_camera_warms_up_after_a_move_too() -> None:
    async with robot_fleet("old", "other", "new", "asks") as (fleet, (old, other, new, _asks)):
        await other.request("other", {"framegrabber/f": {}}, priority=5, min_runtime=20, keep=False)
        watching = watches(old)
        await until(lambda: [arc for arc in old._store.open if arc.start is not None])
        begin_move(old, new)
        await old.internals.hand_over_all(new.mesh.me)
        await old.close()
        await over(watching)
        watching = watches(new)
        await asyncio.sleep(17.5)
        assert await fleet.arcs("z-warm") == ["running"]
        await over(watching)
        assert await fleet.arcs("z-warm") == []
