"""For tests of the placer on a real mesh: asking it, an RC that writes down what it was told, and kinds of components:
one that can be held up at every step of its life, and one that counts, however long its RC does not run."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self, TypeVar

import msgspec

from tests.hang import HANG
from tests.live.lab import CONFIRM_TIMEOUT, Lab, answered, awaited
from zscout.behaviors.client import confirmation
from zscout.behaviors.client.arc import Held, Revoked, holds
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.behaviors.components.component import Component, ComponentContext
from zscout.behaviors.components.shipped import Counter
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Sender
from zscout.mesh import ZenohMesh
from zscout.mesh.supervision import StallWatch, clock
from zscout.messages import (
    ComponentList,
    ComponentSpec,
    ComponentView,
    Holder,
    HostRanking,
    ListComponents,
    ListPlacements,
    PlaceComponent,
    Placement,
    Placements,
    Problem,
    RankAsk,
)
from zscout.types import SECOND

R = TypeVar("R")
LONGEST = 60.0
"""Seconds for which the placer lets anybody wait, and an RC keeps a command."""


class Placing:
    """Asks the placer, and hosts, until they answer."""

    def __init__(self, client: Client) -> None:
        self.client = client

    async def ask(self, operation: msgspec.Struct, kind: type[R], host: str | None = None) -> R | Problem:
        keys, me = self.client.mesh.keys, self.client.mesh.me
        key = keys.placer(me) if host is None else keys.component(host, me)
        async with asyncio.timeout(2 * HANG):
            while True:
                reply = await self.client.mesh.ask_one(key, operation, kind, timeout=HANG)
                answer = None if reply is None else reply.message or reply.problem
                if isinstance(answer, Problem) and answer.code in ("not_leading", "busy"):
                    answer = None
                if answer is not None:
                    return answer
                await asyncio.sleep(0.05)

    async def get(self, operation: msgspec.Struct, kind: type[R], host: str | None = None) -> R:
        answer = await self.ask(operation, kind, host)
        assert not isinstance(answer, Problem), answer
        return answer

    async def place(self, component: str, kind: str, params: Mapping[str, Any] | None = None, **spec: Any) -> Placement:
        """Has it run; returns how it stands when it does, or can't."""
        operation = PlaceComponent(component, ComponentSpec(kind, dict(params or {}), **spec), wait=LONGEST)
        async with asyncio.timeout(2 * HANG):
            while (placed := await self.get(operation, Placement)).state == "starting":
                pass
        return placed

    async def placement(self, component: str) -> Placement:
        listed = await self.get(ListPlacements(component), Placements)
        assert listed.components, f"nobody knows of {component}"
        return listed.components[0]

    async def until(self, component: str, holds: Callable[[Placement], bool]) -> Placement:
        """The placement, as soon as `holds` is true of it."""
        listed = await awaited(
            lambda: self.get(ListPlacements(component), Placements),
            lambda listed: bool(listed.components) and holds(listed.components[0]),
        )
        return listed.components[0]

    async def hosts(self, count: int) -> None:
        """Waits until the balancer ranks so many hosts."""
        mesh = self.client.mesh
        await awaited(
            lambda: answered(lambda: mesh.ask_one(mesh.keys.ask_rank(mesh.me), RankAsk(), HostRanking, timeout=1)),
            lambda ranking: len(ranking.hosts) == count,
        )

    async def views(self, component: str, *hosts: str) -> list[ComponentView]:
        """What these hosts tell of a component."""
        found = []
        for host in hosts:
            told = await self.get(ListComponents(component), ComponentList, host)
            found += told.components
        return found


class Witness(ExclusiveDriver):
    """Writes down what it was told, and when it was let go."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: list[int] = []
        self.released = 0
        self._told = asyncio.Event()

    async def safe(self) -> None:
        self.released += 1

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        if do.get("name") == "echo":
            self.counts.append(do["value"])
            self._told.set()
        return await super().command(holder, do)

    async def more(self, count: int = 1) -> None:
        """Waits until it was told so many more."""
        wanted = len(self.counts) + count
        try:
            async with asyncio.timeout(HANG):
                while len(self.counts) < wanted:
                    self._told.clear()
                    await self._told.wait()
        except TimeoutError:
            raise AssertionError(f"told {self.counts[-5:]}, and no more") from None

    def check(self) -> None:
        """Nothing was lost, and nothing doubled."""
        wrong = next((at for at, count in enumerate(self.counts) if count != at + 1), None)
        assert wrong is None, f"told {self.counts[max(0, wrong - 5) : wrong + 5]} at {wrong}"


class WitnessRc:
    """An RC with a witness, in this process, on a host of its own."""

    def __init__(self, lab: Lab, name: str) -> None:
        self.lab, self.name, self.witness = lab, name, Witness()

    async def __aenter__(self) -> Self:
        fleet = self.lab.fleet_of("devices")
        self._stall = StallWatch(clock.now).start()
        self._mesh = await ZenohMesh.open(fleet, Sender("devices", "node"))
        self.lab.sessions += 1
        self._rc = ResourceController(
            self._mesh, self.name, self.witness, hold_lease=fleet.timing.hold_lease / SECOND, stall=self._stall
        )
        await self._rc.start()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._rc.stop()
        self.lab.sessions -= 1
        await self._mesh.close()
        self._stall.stop()


class Tally(Counter):
    """A counter that counts at its RC's pace: it gives up no hold because a busy machine did not let the RC run."""

    def __init__(self, params: dict[str, Any]) -> None:
        super().__init__(params)
        confirmation.CONFIRM_TIMEOUT = CONFIRM_TIMEOUT

    async def _step(self, context: ComponentContext, held: Held | None = None) -> None:
        if held is not None and self.rc is not None:
            count = {"name": "echo", "value": self.count + 1}
            await context.client.command(self.rc, held.grant, count, ttl=LONGEST, timeout=LONGEST)
        await super()._step(context)


class Stepper(Component):
    """Counts by commands to `rc`. In `folder`, a file `at-STEP` tells that it has come to a step, and it
    stays there for as long as there is a file `hold-STEP`. Steps: init, checkpoint, restore."""

    def __init__(self, params: dict[str, Any]) -> None:
        confirmation.CONFIRM_TIMEOUT = CONFIRM_TIMEOUT
        self.folder, self.rc, self.count = Path(params["folder"]), params["rc"], 0
        self._step("init")

    def _step(self, name: str) -> None:
        (self.folder / f"at-{name}").touch()
        while (self.folder / f"hold-{name}").exists():
            time.sleep(0.005)

    async def run(self, context: ComponentContext) -> None:
        while True:
            with suppress(Revoked, CommandRefused):
                async for attempt in holds(context.client, context.component, {self.rc: {}}, min_runtime=3600):
                    async with attempt as held:
                        while True:
                            count = {"name": "echo", "value": self.count + 1}
                            await context.client.command(self.rc, held.grant, count, ttl=LONGEST, timeout=LONGEST)
                            self.count += 1
                            await context.safe_point()
                            await asyncio.sleep(0.005)
            await asyncio.sleep(0.02)

    def checkpoint(self) -> bytes:
        self._step("checkpoint")
        return json.dumps(self.count).encode()

    def restore(self, state: bytes) -> None:
        self._step("restore")
        self.count = json.loads(state)
        (self.folder / "restored").touch()


async def three(lab: Lab, *rcs: str) -> Placing:
    """Starts h0, h1 and h2, and waits until all report, and these RCs of others are there."""
    for host in ("h0", "h1", "h2"):
        lab.node(host)
    placing = Placing(await lab.client())
    await lab.ready(placing.client, *rcs)
    await placing.hosts(3)
    return placing


def register(lab: Lab) -> None:
    """Makes `stepper` and `tally` kinds that the lab's nodes can start, as if they were installed."""
    info = lab.folder / "site" / "stepper-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stepper\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        "[zscout.components]\nstepper = tests.live.placing:Stepper\ntally = tests.live.placing:Tally\n"
    )
    lab.env["PYTHONPATH"] = f"{lab.folder / 'site'}:{Path(__file__).parents[2]}"
