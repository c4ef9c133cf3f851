"""Candidates, RCs and clients on a mesh in memory, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from msgspec.structs import replace

from tests.mesh.kit import until
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.config.fleet import Fleet, default_fleet
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Sender
from zscout.mesh import Mesh
from zscout.mesh.supervision import StallWatch
from zscout.messages import RcmState
from zscout.services.rcm.candidate import Candidate
from zscout.testing.memory import MemoryMesh, MemoryNetwork, MemoryTransport
from zscout.types import SECOND, Grant

RC, OTHER = "robot/x", "robot/y"
ECHO = {"name": "echo", "value": 7}
FLEET = default_fleet()


class SmallFleet:
    """Candidates, RC and OTHER on a host of their own, and clients, each with its place on one network."""

    def __init__(self, fleet: Fleet = FLEET) -> None:
        self.fleet = fleet
        self.network = MemoryNetwork(lease=FLEET.mesh.lease)
        self.candidates: dict[str, Candidate] = {}
        self.clients: list[Client] = []
        self.devices = self.mesh("devices", "node")
        self.stall = StallWatch(self.devices.now).start()
        self.rcs = [
            ResourceController(
                self.devices, name, ExclusiveDriver(), hold_lease=fleet.timing.hold_lease / SECOND, stall=self.stall
            )
            for name in (RC, OTHER)
        ]

    def mesh(self, host: str, name: str) -> MemoryMesh:
        return self.network.open(FLEET.name, Sender(host, name))

    def candidate(self, host: str) -> Candidate:
        candidate = self.candidates[host] = Candidate(self.mesh(host, "node"), self.fleet)
        candidate.start()
        return candidate

    def client(self, name: str) -> Client:
        client = Client.on(self.mesh("h", name), self.fleet)
        self.clients.append(client)
        return client

    def leader(self) -> MemoryMesh:
        (leader,) = [one.mesh for one in self.candidates.values() if one.rcm is not None]
        assert isinstance(leader, MemoryMesh)
        return leader

    async def standby(self) -> MemoryMesh:
        """Another candidate, which knows the leader."""
        mesh = self.candidate("h1").mesh
        assert isinstance(mesh, MemoryMesh)
        await asyncio.sleep(2)
        return mesh

    async def lose_leader(self) -> None:
        self.network.kill(self.leader())
        await self.candidates.pop("h0").stop()

    async def state(self, client: int = 0) -> RcmState:
        state = await self.clients[client].state()
        assert state is not None
        return state

    async def holders(self, rc: str = RC) -> list[str]:
        return [view.arc for view in (await self.state()).holds if rc in view.needs]


async def held(client: Client, name: str, **how: Any) -> tuple[OpenArc, Grant]:
    """A request for RC that is granted."""
    arc = await client.request(name, {RC: {}}, **({"min_runtime": 600} | how))
    grant = await client.granted(arc)
    assert grant is not None
    return arc, grant


def transport_of(mesh: Mesh) -> MemoryTransport:
    assert isinstance(mesh, MemoryMesh)
    transport = mesh._transport.current
    assert isinstance(transport, MemoryTransport)
    return transport


def make_older(rc: ResourceController) -> None:
    """From now on it says nothing of when it begins for a holder, as RCs did before 0.3."""
    own = rc._rc_state
    rc._rc_state = lambda *told, **how: replace(own(*told, **how), begin_within=None)  # type: ignore[method-assign]
    rc.publish()


def begin_move(old: Client, new: Client) -> None:
    old.internals.pause()
    new.internals.expect(old.internals.open_requests())


@asynccontextmanager
async def small_fleet(
    *clients: str, config: Fleet = FLEET, kind: type[SmallFleet] = SmallFleet
) -> AsyncIterator[tuple[SmallFleet, list[Client]]]:
    fleet = kind(config)
    for rc in fleet.rcs:
        await rc.start()
    fleet.candidate("h0")
    made = [fleet.client(name) for name in clients]
    await until(lambda: made[0].leader == "h0")
    try:
        yield fleet, made
    finally:
        for client in fleet.clients:
            await client.close()
        for candidate in fleet.candidates.values():
            await candidate.stop()
        for rc in fleet.rcs:
            await rc.stop()
        fleet.stall.stop()
