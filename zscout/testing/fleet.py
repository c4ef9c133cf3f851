"""A fleet in one process: a leader, devices, clients and components on a mesh in memory, under virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Final, Self

from zscout.behaviors.client.arc import Held, hold
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import Needs
from zscout.behaviors.components.component import Component, ComponentContext, SafePointGate
from zscout.config.fleet import Fleet, default_fleet
from zscout.drivers.driver import Driver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Sender
from zscout.mesh.supervision import StallWatch
from zscout.messages import RcmState
from zscout.services.rcm.candidate import Candidate
from zscout.testing.memory import MemoryMesh, MemoryNetwork
from zscout.types import SECOND

DEVICES: Final = "devices"
DESK: Final = "desk"
"""Host of the clients."""
WITHIN: Final = 60.0
"""Time limit of `until`, in virtual seconds."""
POLL_S: Final = 0.001
"""Virtual seconds between two checks of a condition."""
SAFE_POINT_WITHIN: Final = 5.0
"""Virtual seconds in which a component must reach a safe point, as on a node."""


async def until(condition: Callable[[], object], *, within: float = WITHIN) -> None:
    """Wait until `condition()` is true. Raises TimeoutError after `within` virtual seconds."""
    async with asyncio.timeout(within):
        while not condition():  # noqa: ASYNC110 - any condition, of any code
            await asyncio.sleep(POLL_S)


@dataclass(slots=True)
class ComponentRun:
    """A component running in a MemoryFleet."""

    component: Component
    task: asyncio.Task[None]
    gate: SafePointGate

    async def checkpoint(self) -> bytes:
        """Hold the component at its next safe point, and return its state. Raises TimeoutError if it reaches none."""
        if not await self.gate.hold(SAFE_POINT_WITHIN):
            raise TimeoutError(f"no safe point within {SAFE_POINT_WITHIN:g} s; await context.safe_point() more often")
        try:
            return self.component.checkpoint()
        finally:
            self.gate.release()


@dataclass
class MemoryFleet:
    """The real services of a fleet, one of each, until the end of `async with`.

    `drivers`: by RC name, the driver of each device. `candidates`: hosts that may lead; the first leads at the start.
    The end of the block raises the first error of a service."""

    drivers: Mapping[str, Driver] = field(default_factory=dict)
    config: Fleet = field(default_factory=default_fleet)
    candidates: tuple[str, ...] = ("lead",)

    def __post_init__(self) -> None:
        self.network = MemoryNetwork(lease=self.config.mesh.lease)
        self.rcs: dict[str, ResourceController] = {}
        self._leading: dict[str, Candidate] = {}
        self._clients: dict[str, Client] = {}
        self._failures: list[Exception] = []
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        try:
            await self._start()
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()
        if self._failures and error is None:
            raise self._failures[0]

    async def _start(self) -> None:
        devices = self.mesh(DEVICES, "node")
        stall = StallWatch(devices.now).start()
        self._stack.callback(stall.stop)
        for name, driver in self.drivers.items():
            rc = self.rcs[name] = ResourceController(
                devices,
                name,
                driver,
                hold_lease=self.config.timing.hold_lease / SECOND,
                stall=stall,
                on_failure=self._failures.append,
            )
            await rc.start()
            self._stack.push_async_callback(rc.stop)
        for host in self.candidates:
            candidate = self._leading[host] = Candidate(self.mesh(host, "node"), self.config)
            candidate.start()
            self._stack.push_async_callback(self._stop, host)
            await until(lambda: self.leader is not None)
        client = self.client()
        while not self._all_present(await client.state()):  # noqa: ASYNC110 - the leader is polled by queries
            await asyncio.sleep(POLL_S)

    def _all_present(self, state: RcmState | None) -> bool:
        return state is not None and self.rcs.keys() <= {view.rc for view in state.rcs if view.present}

    def mesh(self, host: str, client: str) -> MemoryMesh:
        """Open a mesh for another process on the network."""
        return self.network.open(self.config.name, Sender(host, client))

    @property
    def leader(self) -> str | None:
        """The host that leads."""
        return next((host for host, candidate in self._leading.items() if candidate.rcm is not None), None)

    def client(self, name: str = "test") -> Client:
        """Return the client of this name on host `desk`; the first call starts it."""
        if name not in self._clients:
            client = self._clients[name] = Client.on(self.mesh(DESK, name), self.config)
            self._stack.push_async_callback(client.close)
        return self._clients[name]

    @asynccontextmanager
    async def hold(self, name: str, needs: Needs, *, client: str = "test", **how: Any) -> AsyncIterator[Held]:
        """`zscout.hold` by the client of that name; `how` has further arguments."""
        async with hold(self.client(client), name, needs, **how) as held:
            yield held

    async def holder(self, rc: str) -> str:
        """Return the request that holds a device (the first if several share it), or "" if it is free."""
        state = await self.client().state()
        return next((view.arc for view in state.holds if rc in view.needs), "") if state is not None else ""

    @asynccontextmanager
    async def running(self, component: Component, name: str = "component") -> AsyncIterator[ComponentRun]:
        """Run a component with its own client until the end of the block, which raises the component's error."""
        gate, client = SafePointGate(), self.client(f"{name}.1")
        task = asyncio.ensure_future(component.run(ComponentContext(client, name, 1, gate)))
        try:
            yield ComponentRun(component, task, gate)
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def kill_leader(self) -> None:
        """Kill the leading host and wait until another candidate leads. Raises ValueError if there is none."""
        host = self.leader
        if host is None or len(self._leading) < 2:
            raise ValueError("give the fleet two candidates, to kill one of them")
        candidate = self._leading.pop(host)
        self.network.kill(candidate.mesh)
        await candidate.stop()
        await until(lambda: self.leader is not None)

    async def _stop(self, host: str) -> None:
        candidate = self._leading.pop(host, None)
        if candidate is not None:
            await candidate.stop()
