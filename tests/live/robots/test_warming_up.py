"""Two robots that take turns at one framegrabber: the next camera warms up while the one before still watches."""

from __future__ import annotations

import asyncio
from itertools import pairwise
from pathlib import Path

import pytest

from tests.live.robots.lab import CLOSET, RobotLab, comes_true
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.place_robot import PlaceRobot, RobotTask, Slots
from zscout.drivers.packets import CameraPacket, HaltPacket, Packet
from zscout.messages import Grants, RcState

pytestmark = [pytest.mark.live, pytest.mark.slow]

ROBOTS = ["scout33", "scout35"]
SLOT = 8.0
"""Seconds of the building, as all here."""


async def test_a_camera_is_warm_as_its_turn_begins(tmp_path: Path) -> None:
    async with RobotLab(tmp_path, CLOSET, speed=2, frame_rate=3, channels=2) as lab:
        lab.devices("a", "radio", "video", "framegrabber", "robot")
        client, building = await lab.client(), lab.building
        rcs = [f"robot/{robot}" for robot in ROBOTS]
        await lab.ready(client, *rcs, "radio/rf0", "video/ch1", "video/ch2", "framegrabber/fgrab1")
        held: dict[str, list[tuple[str, int]]] = {robot: [] for robot in ROBOTS}
        """By robot: the names of the ARCs that had it in turn, empty where nobody did or its RC let go by itself;
            and how many packets had been heard by then."""

        def on_grants(_key: str, grants: Grants) -> None:
            for robot in ROBOTS:
                if (holders := grants.rcs.get(f"robot/{robot}")) is not None:
                    held[robot].append((holders[0].arc if holders else "", len(building.heard)))

        def on_state(_key: str, state: RcState) -> None:
            if state.ended:
                held[state.rc.removeprefix("robot/")].append(("", len(building.heard)))

        client.mesh.subscribe(client.mesh.keys.grants, Grants, on_grants)
        for rc in rcs:
            client.mesh.subscribe(client.mesh.keys.rc_state(rc), RcState, on_state)

        async def take_turns(robot: str) -> None:
            place = PlaceRobot(robot, RobotNeeds(f"robot/{robot}"), Slots(watch=SLOT))
            while True:
                await RobotTask("watch", place).perform(lab.context(client, lambda _said: None))

        playing = [asyncio.create_task(take_turns(robot)) for robot in ROBOTS]

        def warm_turns() -> list[list[Packet]]:
            """Of each turn that came while its camera warmed up: what the robot was told from the one command to
            transmit to the other, as far as that has come."""
            found = []
            for robot, arcs in held.items():
                number = building.world.bodies[robot].id
                for (one, since), (other, _) in pairwise(arcs):
                    if (one, other) != (f"{robot}-warm", f"{robot}-watch"):
                        continue
                    told = [heard.packet for heard in building.heard[since:] if heard.packet.robot == number]
                    on = [packet for packet in told if isinstance(packet, CameraPacket) and packet.channel]
                    if second := [packet for packet in on if packet.number != on[0].number]:
                        found.append(told[told.index(on[0]) : told.index(second[0])])
            return found

        await comes_true(lambda: len(warm_turns()) >= 3 or any(one.done() for one in playing), "three warm turns")
        assert not any(one.done() for one in playing)
        assert not [packet for told in warm_turns() for packet in told if isinstance(packet, HaltPacket)]
        for one in playing:
            one.cancel()
        await asyncio.gather(*playing, return_exceptions=True)
