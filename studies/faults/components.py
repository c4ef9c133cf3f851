"""Components of a simulated fleet: their real code, each in a simulated process instead of a system process."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import msgspec

from studies.faults.programs import Work
from zscout import messages
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.client.request import Needs, OpenArc
from zscout.behaviors.components import channel
from zscout.behaviors.components.component import Component, ComponentContext
from zscout.behaviors.components.lifecycle import ComponentLifecycle
from zscout.config.fleet import Fleet
from zscout.keyexpr import RANDOM, Role, Token, new_instance
from zscout.messages import ComponentSpec, LoadReport, MigrateComponent, PlaceComponent
from zscout.services.node.component_process import ComponentProcess
from zscout.testing.memory import MemoryMesh
from zscout.testing.virtual_time import PROCESS, Process

KIND: Final = "worker"
KINDS: Final = {KIND: "studies.faults.components:Worker"}
SUPERSEDED_WITHIN: Final = 2.0
"""Seconds without a fault after which no older incarnation acts beside a newer one."""
NEEDS: Final[tuple[Needs, ...]] = ({"robot/c": {}, "radio/r": {"rate": 2}}, {"radio/r": {"rate": 2}})
"""The needs of components: each has one of these."""
LONGER: Final = 3600.0
"""Seconds: longer than any run, so that the holds of components never end by time."""
STEP: Final = 0.1
"""Seconds between pieces of work."""


class Processes(Protocol):
    """The processes of a simulation."""

    def open_process(self, name: str) -> tuple[Process, MemoryMesh]:
        """Open a process, with its place on the mesh."""

    def end_process(self, name: str) -> None:
        """Kill the process."""

    def watch(self, name: str, client: Client) -> None:
        """Check all news of a process's client against the promises."""


@dataclass(slots=True)
class Deeds:
    """Record of the components' work, which no fault touches. It calls `broken(text)` for each broken promise."""

    broken: Callable[[str], None]
    calm: Callable[[], float]
    """Seconds without a fault: a host that is cut off does not know of newer incarnations."""
    over: Callable[[], bool]
    """Return True when no more requests may be made."""
    busy: dict[str, set[str]]
    """By process: its ARCs that are not over."""
    done: dict[str, dict[Process, int]] = field(default_factory=dict)
    """By component: the work done by each of its processes; the process that acted last is at the end. Of two
    processes with the same number one may have died before the other began: their placers did not see each other."""

    def act(self, component: str, process: Process, done: int, restored: int | None) -> None:
        """`restored`: the work taken over from another process, if it was moved."""
        others = self.done.setdefault(component, {})
        if process not in others:
            if restored is not None and restored not in others.values():
                known = [(other.name, count) for other, count in others.items()]
                self.broken(f"{process.name} continues from {restored}, which no other process had done: {known}")
        elif process is not (last := next(reversed(others))) and self.calm() > SUPERSEDED_WITHIN:
            self.broken(f"{process.name} acts again after {last.name}")
        others.pop(process, None)
        others[process] = done


DEEDS: Final[ContextVar[Deeds]] = ContextVar("DEEDS")


class Worker(Component):
    """Does pieces of work, and counts them; meanwhile it holds RCs at low priority."""

    def __init__(self, params: dict[str, Any]) -> None:
        self.done = 0
        self.restored: int | None = None
        self.arc: OpenArc | None = None
        self.handed = ""
        """The id of its predecessor's ARC, if any."""

    async def run(self, context: ComponentContext) -> None:
        holding = asyncio.create_task(self._hold(context))
        try:
            while True:
                self.done += 1
                DEEDS.get().act(context.component, _here(), self.done, self.restored)
                await asyncio.sleep(STEP)
                await context.safe_point()
        finally:
            holding.cancel()

    async def _hold(self, context: ComponentContext) -> None:
        client, deeds = context.client, DEEDS.get()
        needs = NEEDS[sum(context.component.encode()) % len(NEEDS)]
        try:
            while self.handed or not deeds.over():
                deeds.busy[_here().name] = {"work"}
                arc = self.arc = await client.request("work", needs, priority=-1, min_runtime=LONGER, keep=False)
                if self.handed not in ("", arc.id):
                    deeds.broken(f"{_here().name} has a new request instead of {self.handed}, which was handed to it")
                self.handed = ""
                while not deeds.over() and (grant := await client.granted(arc)) is not None:
                    while arc.grant == grant and not deeds.over():
                        for rc in arc.rcs:
                            with suppress(CommandRefused):
                                await client.command(rc, grant, {"name": "echo", "value": self.done})
                        await asyncio.sleep(RANDOM.get().uniform(STEP, 1.0))
                # An ARC that is being handed over may come back.
                if arc.open or client.internals.paused:
                    await client.end(arc)
                del deeds.busy[_here().name]
        except (RequestRefused, CommandRefused) as refused:
            deeds.broken(f"the request of {_here().name} was thrown away: {refused.code}: {refused}")

    def checkpoint(self) -> bytes:
        arc = self.arc.id if self.arc is not None and self.arc.open and self.arc._place is not None else ""
        return f"{self.done} {arc}".encode()

    def restore(self, state: bytes) -> None:
        done, self.handed = state.decode().split(" ")
        self.done = self.restored = int(done)


def _here() -> Process:
    process = PROCESS.get()
    assert process is not None
    return process


class SimulatedComponent(ComponentProcess):
    """A component with a simulated process. Messages between it and its node take no time."""

    processes: Processes

    @property
    def _name(self) -> str:
        return f"{self._host}/{self.start.component}.{self.start.incarnation}"

    async def _run_child(self) -> None:
        node, loop = PROCESS.get(), asyncio.get_running_loop()
        assert node is not None
        process, mesh = self.processes.open_process(self._name)
        self._child_over = asyncio.Event()
        self._orders = asyncio.Queue()

        def report(message: channel.ComponentReport) -> asyncio.Future[None]:
            node.run(loop.call_soon, self._on_message, message)
            done = loop.create_future()
            done.set_result(None)
            return done

        async def connect(name: str, *, fleet: Fleet, host: str) -> Client:
            client = Client.on(mesh, fleet)
            self.processes.watch(self._name, client)
            return client

        async def live(life: ComponentLifecycle) -> None:
            ends = await life.run()
            report(ends)
            node.run(loop.call_soon, self._kill_child)

        job = channel.ComponentJob(self.start, self._where, self._host, self._fleet, self._tag)
        life = process.run(ComponentLifecycle, job, report, connect)
        process.main = process.run(loop.create_task, live(life))
        if self.phase == "stopping":
            self._send(channel.Order(0, messages.StopComponent(self.start.component)))
        ordering = loop.create_task(self._pass_on(process, life, self._orders))
        try:
            await self._child_over.wait()
        finally:
            ordering.cancel()
            self._orders = None
            self._kill_child()

    async def _pass_on(self, process: Process, life: ComponentLifecycle, orders: asyncio.Queue[bytes]) -> None:
        loop = asyncio.get_running_loop()
        while True:
            order = msgspec.json.decode(await orders.get(), type=channel.Order)
            process.run(loop.call_soon, life.order, order)

    def _kill_child(self) -> None:
        self.processes.end_process(self._name)
        self._child_over.set()


async def report_load(mesh: MemoryMesh) -> None:
    """Publish the load of an idle host every second, without which the balancer does not choose it."""
    host, rng = mesh.me.host, RANDOM.get()
    token = mesh.alive(Token(host, Role.LOAD, mesh.me.client, new_instance()))
    publisher = mesh.publisher(mesh.keys.load(host), LoadReport)
    for number in itertools.count(1):
        load = rng.uniform(0, 2)
        publisher.put(LoadReport(host, number, 2, (load, load, load), 50 * load, 8 << 30, 16 << 30))
        await asyncio.sleep(1.0)
    token.close()


async def operate(mesh: MemoryMesh, work: Work, components: int) -> None:
    """An operator that starts `components` components, and moves them now and then."""
    rng, placer = RANDOM.get(), PlacerClient(mesh)
    names = [f"w{number}" for number in range(components)]
    spec = ComponentSpec(KIND, restart="always")
    while not work.over:
        name = rng.choice(names)
        operation = PlaceComponent(name, spec, wait=3.0) if rng.random() < 0.5 else MigrateComponent(name, wait=5.0)
        try:
            await placer.request_once(operation, lambda _: True)
            work.counts[f"component {operation.__struct_config__.tag}"] += 1
        except RequestRefused as refused:
            work.counts[f"component refused {refused.code}"] += 1
        await asyncio.sleep(rng.uniform(0.5, work.pause))
