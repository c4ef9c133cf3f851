"""What live tests of robots and radios share: drivers in the test's own process, and what they are told."""

from __future__ import annotations

import asyncio
from typing import Any, Self

from tests.hang import HANG
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.behaviors.client.request import OpenArc
from zscout.drivers.driver import Driver
from zscout.drivers.packets import Packet
from zscout.drivers.resource_controller import ResourceController
from zscout.drivers.robot import RobotDriver
from zscout.keyexpr import Sender
from zscout.mesh import Mesh, ZenohMesh
from zscout.mesh.supervision import StallWatch, clock
from zscout.messages import Command, Done
from zscout.types import SECOND, Grant

RADIO = {"radio/rf0": {"command_rate": 10}}
GANG: dict[str, Any] = {"robot/r1": {}, "video/ch1": {}, **RADIO}
LATE = frozenset({"unknown", "stale"})
"""Refusals, and silence, of what waited longer than it may."""
TURN = {"name": "drive", "left": 0.5, "right": -0.5, "lasts": 5}


async def held(client: Client, name: str, needs: dict[str, Any], **how: Any) -> tuple[OpenArc, Grant]:
    arc = await client.request(name, needs, **({"min_runtime": 600} | how))
    # What is not confirmed within a second is granted anew.
    grant = await client.granted(arc, confirmed=True)
    assert grant is not None
    return arc, grant


async def obeyed(client: Client, rc: str, grant: Grant, do: dict[str, Any]) -> Done:
    """Has an RC do something, again where that waited longer than it may: on a busy machine a process stands still."""
    async with asyncio.timeout(HANG):
        while True:
            try:
                return await client.command(rc, grant, do)
            except CommandRefused as refused:
                if refused.code not in LATE:
                    raise


def is_in(kind: type[Packet], robot: int = 1) -> Any:
    """The first such packet to a robot, if there is one."""
    return lambda packets: next(
        (packet for packet in packets if isinstance(packet, kind) and packet.robot == robot), None
    )


class Post:
    """Drivers in the test's own process, each host with a session of its own, and an RCM on another."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.meshes: dict[str, Mesh] = {}
        self.rcs: list[ResourceController] = []
        self.stall = StallWatch(clock.now)

    async def mesh(self, host: str, client: str = "node") -> Mesh:
        name = f"{host}/{client}"
        if name not in self.meshes:
            fleet = self.lab.fleet
            self.meshes[name] = await ZenohMesh.open(fleet, Sender(host, client))
        return self.meshes[name]

    async def rc(self, host: str, name: str, driver: Driver) -> ResourceController:
        lease = self.lab.fleet.timing.hold_lease / SECOND
        rc = ResourceController(await self.mesh(host), name, driver, hold_lease=lease, stall=self.stall)
        self.rcs.append(rc)
        await rc.start()
        return rc

    async def says(self, host: str, client: str, rc: str, do: dict[str, Any], grant: Grant | None) -> str:
        """The code of what an RC answers to this sender, or `done`."""
        mesh = await self.mesh(host, client)
        key, code = mesh.keys.command(rc, mesh.me), "unknown"
        async with asyncio.timeout(HANG):
            while code in LATE:  # a new session takes a moment to find the others
                reply = await mesh.ask_one(key, Command(do=do, grant=grant), Done, timeout=1)
                if reply is not None:
                    code = "done" if reply.problem is None else reply.problem.code
        return code

    async def __aenter__(self) -> Self:
        self.stall.start()
        return self

    async def __aexit__(self, *exc: object) -> None:
        for rc in reversed(self.rcs):
            await rc.stop()
        self.stall.stop()
        for mesh in self.meshes.values():
            await mesh.close()


def robot(number: int) -> RobotDriver:
    channels = {"video/ch1": 1, "video/ch2": 7}
    return RobotDriver(number, radio="radio/rf0", channels=channels, warm_up=0.0, dead_man=0.5)
