"""Robots in a served building on a real mesh, and a journal of what they truly did."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from tests.behaviors.components.kit import ROOT
from tests.hang import HANG
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client
from zscout.behaviors.tree import BehaviorContext
from zscout.drivers.packets import CameraPacket, DrivePacket, HaltPacket, Packet
from zscout.mesh import clock
from zscout.messages import BehaviorSaid
from zscout.simulation.building.node_file import node_file
from zscout.simulation.building.plan import Furniture, Light, Noise, Plan, Robot
from zscout.simulation.building.serve import Served
from zscout.types import Ns

P = TypeVar("P", bound=Packet)

ROLLS = 0.01
"""Metres a second from which on a wheel turns."""
CLOSET = Plan(
    name="closet",
    width=2.4,
    depth=2.0,
    noise=Noise(sensor=0.3, analog=0.3),
    furniture=(Furniture("chest", "solid", 2.0, 1.7, 0.5, 0.4, 0.6, shade=0.1),),
    lights=(Light("ceiling", 1.2, 1.0),),
    robots=(Robot("scout33", 33, 0.4, 1.4, slip=0.0), Robot("scout35", 35, 0.4, 0.4, 0.8, slip=0.0)),
)
"""Small, bare and quick to draw."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A packet that came through the radio."""

    at: Ns
    """On this host's clock."""
    time: float
    """Of the building, in seconds."""
    packet: Packet


@dataclass(frozen=True, slots=True)
class Turned:
    """A robot's wheels began to turn, or stand."""

    time: float
    """Of the building, in seconds."""
    robot: str
    turns: bool


class Building(Served):
    """A served building that keeps what came through its radio, and when wheels turned."""

    def __init__(self, plan: Plan, **how: Any) -> None:
        super().__init__(plan, **how)
        self.heard: list[Heard] = []
        self.turned: list[Turned] = []

    def _on_packet(self, packet: Packet, at: float) -> None:
        self.heard.append(Heard(clock.now(), self.time, packet))
        super()._on_packet(packet, at)

    def _step(self, steps: int, packets: list[Packet]) -> None:
        for number in range(steps):
            super()._step(1, [] if number else packets)
            for name, body in self.world.bodies.items():
                rolls = max(abs(body.speed_left), abs(body.speed_right)) > ROLLS
                turns = rolls or bool(body.left or body.right)
                if turns != self.turns(name):
                    self.turned.append(Turned(self.world.time, name, turns))

    def turns(self, robot: str) -> bool:
        """Whether its wheels turn, as of the last step."""
        return next((one.turns for one in reversed(self.turned) if one.robot == robot), False)

    def packets(self, kind: type[P], robot: str, *, since: int = 0) -> list[Heard]:
        """What was heard of one kind, from number `since` of all on."""
        number = self.world.bodies[robot].id
        return [one for one in self.heard[since:] if isinstance(one.packet, kind) and one.packet.robot == number]

    async def drives(self, robot: str, *, since: int = 0, **fields: float) -> Heard:
        """Waits for a drive packet, heard from number `since` on, with these fields; returns it."""

        def found() -> list[Heard]:
            return like(self.packets(DrivePacket, robot, since=since), **fields)

        await comes_true(lambda: bool(found()), f"{robot} to drive with {fields}")
        return found()[0]

    async def halts(self, robot: str, *, since: int) -> None:
        await comes_true(lambda: bool(self.packets(HaltPacket, robot, since=since)), f"{robot} to be halted")

    async def turned_over(self, robot: str, *, since: int) -> None:
        """Waits until one holder's end has halted a robot, and the next holder has switched its camera on: no halt of
        an end before that is still under way."""

        number = self.world.bodies[robot].id

        def switched_on() -> bool:
            packets = [one.packet for one in self.heard[since:] if one.packet.robot == number]
            told = [packet for packet in packets if isinstance(packet, HaltPacket | CameraPacket)]
            halted = any(isinstance(packet, HaltPacket) for packet in told)
            return halted and isinstance(told[-1], CameraPacket) and told[-1].channel > 0

        await comes_true(switched_on, f"{robot} to be turned over")

    async def stands(self, robot: str) -> float:
        """Waits until its wheels stand; returns since when, in the building's seconds."""
        await comes_true(lambda: not self.turns(robot), f"{robot} to stand")
        return next(one.time for one in reversed(self.turned) if one.robot == robot)


def like(heard: Iterable[Heard], **fields: float) -> list[Heard]:
    """The drive packets with these fields, as far as a packet carries them."""
    return [
        one
        for one in heard
        if isinstance(one.packet, DrivePacket)
        and all(abs(getattr(one.packet, name) - value) < 0.01 for name, value in fields.items())
    ]


class RobotLab(Lab):
    """A lab with a building of its own in the test's process. Give it a plan, and `Served`'s arguments."""

    def __init__(
        self,
        folder: Path,
        plan: Plan = CLOSET,
        *,
        lease: float | None = None,
        candidates: Sequence[str] = (),
        extra: str = "",
        **how: Any,
    ) -> None:
        super().__init__(folder, lease=lease, candidates=candidates, extra=extra)
        self.env["PYTHONPATH"] = str(ROOT)
        self.building = Building(plan, radio_link=folder / "radio0", **how)
        self._stack = AsyncExitStack()

    def devices(self, host: str, *kinds: str, framegrabbers: int = 1, extra: str = "") -> None:
        """Starts a node that has the building's devices of these kinds."""
        text = node_file(self.building, fleet=None, framegrabbers=framegrabbers)
        _, *tables = text.split("[[rc]]")
        chosen = [table for table in tables if table.partition('name = "')[2].partition("/")[0] in kinds]
        self.node(host, extra=extra + "\n" + "".join(f"[[rc]]{table}" for table in chosen))

    def context(
        self, client: Client, heard: Callable[[BehaviorSaid], None], *, speed: float | None = None
    ) -> BehaviorContext:
        """What a behavior in the test's own loop runs on. `speed` is the building's unless told otherwise."""

        async def safe_point() -> None:
            pass

        return BehaviorContext(client, safe_point, heard, speed=speed or self.building.speed)

    async def __aenter__(self) -> Self:
        await self._stack.enter_async_context(self.building)
        return await super().__aenter__()

    async def __aexit__(self, *exc: object) -> None:
        # The robots are halted while the building still listens.
        await super().__aexit__(*exc)
        await self._stack.aclose()


async def comes_true(condition: Callable[[], bool], what: str, *, within: float = 2 * HANG) -> None:
    """Waits for it, however busy the machine is."""
    try:
        async with asyncio.timeout(within):
            while not condition():  # noqa: ASYNC110 - what changes lies in other threads and processes
                await asyncio.sleep(0.005)
    except TimeoutError:
        raise AssertionError(f"waited in vain for {what}") from None
