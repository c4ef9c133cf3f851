"""RCs in the test's own process, on a session of their own, over a device that can be told to misbehave."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from tests.hang import HANG
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.behaviors.client.request import OpenArc
from zscout.drivers.driver import Driver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Sender
from zscout.mesh import ZenohMesh
from zscout.mesh.supervision import StallWatch, clock
from zscout.messages import Done, Holder
from zscout.types import SECOND, Grant

ECHO = {"name": "echo", "value": 1}


class Bench(Driver):
    """A device that can be told to take its time, to fail, and that counts what is done to it."""

    def __init__(self, *, activation: float = 0.0) -> None:
        self.activation = activation
        self.calls: list[str] = []
        self.go_on = asyncio.Event()
        self.waiting = asyncio.Event()
        self.broken = False

    async def begin(self, holder: Holder) -> None:
        self.calls.append(f"begin {holder.arc}")
        if self.broken:
            raise RuntimeError("no power")

    async def safe(self) -> None:
        self.calls.append("safe")

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        match do.get("name"):
            case "echo":
                return do["value"]
            case "wait":
                self.waiting.set()
                await self.go_on.wait()
                return None
            case "crash":
                raise RuntimeError("a fault in the driver")
            case _:
                return await super().command(holder, do)


class SharedBench(Bench):
    sharable = True


class Stand:
    """RCs in the test's own process, on a session of their own."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.rcs: list[ResourceController] = []

    async def __aenter__(self) -> Stand:
        fleet = self.lab.fleet_of("bench")
        self.stall = StallWatch(clock.now).start()
        self.mesh = await ZenohMesh.open(fleet, Sender("bench", "node"))
        self.lab.sessions += 1
        return self

    async def __aexit__(self, *exc: object) -> None:
        for rc in self.rcs:
            await rc.stop()
        self.stall.stop()
        self.lab.sessions -= 1
        await self.mesh.close()

    async def rc(self, name: str, driver: Driver) -> ResourceController:
        lease = self.lab.fleet.timing.hold_lease / SECOND
        rc = ResourceController(self.mesh, name, driver, hold_lease=lease, stall=self.stall)
        self.rcs.append(rc)
        await rc.start()
        return rc


async def running(client: Client, name: str, *rcs: str, **how: Any) -> tuple[OpenArc, Grant]:
    arc = await client.request(name, {rc: {} for rc in rcs}, **({"min_runtime": 600} | how))
    return arc, await granted(client, arc, confirmed=True)


async def granted(client: Client, arc: OpenArc, **how: bool) -> Grant:
    grant = await client.granted(arc, **how)
    assert grant is not None
    return grant


async def answer(command: Awaitable[Done]) -> str:
    """The code of a refusal, or `done`."""
    try:
        await command
    except CommandRefused as refused:
        return refused.code
    return "done"


def ended(arc: OpenArc) -> str:
    """How its last hold did."""
    return arc._ending.outcome if arc._ending is not None else ""


async def comes_to(arc: OpenArc, state: str, reason: str = "") -> None:
    """Waits until a request stands so: on a slow machine votes may come late."""
    await until(lambda: arc.state == state and reason in arc.reason)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(HANG):
        while True:
            if condition():
                return
            await asyncio.sleep(0.01)
