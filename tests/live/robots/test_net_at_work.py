"""Place Sensor Net, its robots' behaviors as components: one is moved while it holds, and its robot dies."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest

from tests.live.lab import awaited
from tests.live.placing import Placing
from tests.live.robots.lab import RobotLab, comes_true
from zscout.behaviors.components.sensor_net import PlaceSensorNetComponent
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.place_sensor_net import PlaceSensorNet
from zscout.behaviors.teleop import Pilot, Teleop
from zscout.drivers.packets import CameraPacket, DrivePacket, HaltPacket
from zscout.messages import BehaviorSaid, ComponentList, ListComponents, MigrateComponent, Placement
from zscout.simulation.building.plan import Furniture, Light, Noise, Plan, Robot

pytestmark = [pytest.mark.live, pytest.mark.slow]

DEN = Plan(
    name="den",
    width=2.6,
    depth=2.2,
    noise=Noise(sensor=0.3, analog=0.3),
    furniture=(Furniture("sofa", "sofa", 1.3, 1.75, 1.6, 0.8, 0.7, clearance=0.12, shade=0.3),),
    lights=(Light("ceiling", 1.3, 0.7),),
    robots=(Robot("scout33", 33, 1.3, 1.6, -math.pi / 2, slip=0.0), Robot("scout35", 35, 0.3, 0.3, 0.8, slip=0.0)),
)
"""The first robot stands where it may stay, and has to find that out."""
ROBOTS = ["robot/scout33", "robot/scout35"]
SPEED = 4
FIRST = "place_sensor_net-scout33"


async def ended(placing: Placing, host: str) -> None:
    """Waits until no component is left there."""
    await awaited(
        lambda: placing.get(ListComponents(), ComponentList, host),
        lambda listed: all(view.phase == "ended" for view in listed.components),
    )


async def test_a_net_at_work(tmp_path: Path) -> None:
    async with RobotLab(tmp_path, DEN, speed=SPEED, frame_rate=3, channels=2) as lab:
        lab.devices("a", "radio", "video", "framegrabber", "robot")
        lab.node("b")
        client, building = await lab.client(), lab.building
        placing = Placing(client)
        await lab.ready(client, *ROBOTS, "radio/rf0", "video/ch1", "framegrabber/fgrab1")
        await lab.living(client, "node", lambda hosts: set(hosts) == {"a", "b"})
        await placing.hosts(2)
        said: list[tuple[str, BehaviorSaid]] = []
        keys = client.mesh.keys
        client.mesh.subscribe(
            keys.behavior_any, BehaviorSaid, lambda key, word: said.append((keys.sender_of(key).host, word))
        )
        own: list[BehaviorSaid] = []
        root = PlaceSensorNetComponent({"robots": ROBOTS, "wanted": 1, "speed": SPEED}).root
        assert isinstance(root, PlaceSensorNet)
        net = root.net
        playing = asyncio.create_task(root.perform(lab.context(client, own.append)))

        def words(robot: str, host: str, since: int) -> list[str]:
            return [w.doing for at, w in said[since:] if w.robot == robot and at == host]

        await comes_true(lambda: playing.done() or net.watching == 1, "scout33 to watch")
        assert building.world.is_dark("scout33")
        print(f"hidden and watching after {building.time:.1f} s of the building")

        # An operator has it for a while: it goes on by itself.
        teleop = Teleop(client, RobotNeeds(ROBOTS[0]), Pilot(), priority=10)
        driving = asyncio.create_task(teleop.run())
        heard = len(building.heard)
        teleop.take()
        await comes_true(lambda: teleop.state == "driving" and net.watching == 0, "the operator's turn")
        await building.turned_over("scout33", since=heard)
        heard = len(building.heard)
        teleop.give_back()
        # What was said may be of before: the robot shows whose turn it is.
        await building.turned_over("scout33", since=heard)
        await comes_true(lambda: net.watching == 1, "it to watch on")
        driving.cancel()

        # It is moved while it holds: the hold goes along, and so does all that it knows.
        placed = await placing.placement(FIRST)
        (before,) = (await lab.rc(client, ROBOTS[0])).holders
        there = {"a": "b", "b": "a"}[str(placed.host)]
        heard, told = len(building.heard), len(said)
        moved = await placing.get(MigrateComponent(FIRST, there), Placement)
        assert (moved.state, moved.host) == ("running", there), moved
        await comes_true(lambda: "watch" in words(ROBOTS[0], there, told), "it to watch on")
        assert not {"search", "approach", "enter"} & set(words(ROBOTS[0], there, told))
        (after,) = (await lab.rc(client, ROBOTS[0])).holders
        assert after.arc == before.arc
        assert after.grant != before.grant
        assert after.client != before.client
        # Not let go for a moment: neither halted nor its camera switched off.
        assert not building.packets(HaltPacket, "scout33", since=heard)
        assert building.world.bodies["scout33"].camera is not None
        switched = [one.packet for one in building.packets(CameraPacket, "scout33", since=heard)]
        assert all(isinstance(packet, CameraPacket) and packet.channel for packet in switched)

        # Its battery is gone: the spare takes its place.
        heard, killed = len(building.heard), building.time
        building.kill("scout33")
        await comes_true(
            lambda: playing.done() or bool(building.packets(DrivePacket, "scout35", since=heard)), "the spare"
        )
        assert not playing.done()
        assert net.members[ROBOTS[0]].standing == "lost"
        assert net.members[ROBOTS[0]].why == "its camera shows nothing"
        assert any("robot/scout33 is lost: its camera shows nothing" in one.detail for one in own)
        print(f"the spare drives {building.time - killed:.1f} s of the building after the robot's death")

        playing.cancel()
        await asyncio.gather(playing, return_exceptions=True)
        await asyncio.gather(*(ended(placing, host) for host in ("a", "b")))
