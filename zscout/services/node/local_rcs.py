"""The RCs of one node: started as its file lists them, added and removed at a reload."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from zscout.config.devices import RcConfig, RobotRc
from zscout.config.node import Node
from zscout.config.strict import BadInput
from zscout.drivers.confirm_server import ConfirmServer
from zscout.drivers.driver import Driver
from zscout.drivers.last_holder import LastHolderFile, UnknownLastHolder
from zscout.drivers.lock import only_here
from zscout.drivers.registry import driver_for, driver_name
from zscout.drivers.resource_controller import ResourceController
from zscout.drivers.tolerance import Tolerance
from zscout.mesh import Mesh, MeshError
from zscout.mesh.supervision import StallWatch
from zscout.types import SECOND, RcName

log = logging.getLogger("zscout.node")


class RcNotOpened(Exception):
    """An RC could not be started; the message names it. The cause has been logged."""


@dataclass(slots=True)
class _Running:
    spec: RcConfig
    rc: ResourceController
    lock: ExitStack

    async def stop(self) -> None:
        await self.rc.stop()
        self.lock.close()


class LocalRcs:
    """`folder` returns the state folder, if any. `on_failure` gets the error of an RC that fails later. Raises BadInput
    if a driver is missing."""

    def __init__(
        self,
        mesh: Mesh,
        node: Node,
        folder: Callable[[], Path | None],
        stall: StallWatch,
        on_failure: Callable[[Exception], object],
    ) -> None:
        self._mesh, self._node, self._folder, self._stall, self._on_failure = mesh, node, folder, stall, on_failure
        self._drivers: dict[RcName, Driver] = {spec.name: driver_for(spec) for spec in node.rcs}
        self._confirmations: ConfirmServer | None = None
        self._running: dict[RcName, _Running] = {}

    @property
    def controllers(self) -> Collection[ResourceController]:
        return [running.rc for running in self._running.values()]

    async def start(self) -> None:
        """Raises MeshError or RcNotOpened at the first RC that can't be started."""
        for spec in _robots_last(self._node.rcs):
            await self._open(spec, self._drivers.pop(spec.name))

    async def take(self, node: Node) -> None:
        """Stop RCs no longer listed, start new ones, restart changed ones; the others continue. Raises RcNotOpened once
        all have been tried."""
        wanted, faults = {spec.name: spec for spec in node.rcs}, list[str]()
        gone = [name for name, running in self._running.items() if wanted.get(name) != running.spec]
        await self._close(gone, {name: "changed in" if name in wanted else "removed from" for name in gone})
        for spec in _robots_last(spec for spec in node.rcs if spec.name not in self._running):
            try:
                await self._open(spec, driver_for(spec))
            except (BadInput, MeshError, RcNotOpened) as error:
                faults.append(str(error))
        if faults:
            raise RcNotOpened("; ".join(faults))

    async def stop(self) -> None:
        await self._close([*self._running], {})

    async def _open(self, spec: RcConfig, driver: Driver) -> None:
        mesh, lock, folder = self._mesh, ExitStack(), self._folder()
        lock.enter_context(only_here(self._node.fleet.name, mesh.me.host, spec.name, folder))
        if self._confirmations is None:
            self._confirmations = ConfirmServer(mesh)
        rc = ResourceController(
            mesh,
            spec.name,
            driver,
            hold_lease=self._node.fleet.timing.hold_lease / SECOND,
            settle=spec.settle / SECOND,
            begin_within=None if spec.begin_within is None else spec.begin_within / SECOND,
            tolerance=tolerance(spec, driver),
            last_holder=LastHolderFile(folder, spec.name) if folder is not None else UnknownLastHolder(),
            stall=self._stall,
            confirmations=self._confirmations,
            on_failure=self._on_failure,
        )
        self._running[spec.name] = _Running(spec, rc, lock)
        try:
            await rc.start()
        except Exception as error:
            await self._running.pop(spec.name).stop()
            if isinstance(error, MeshError):
                raise
            log.exception("%s can't be opened", spec.name)
            raise RcNotOpened(f"{spec.name} can't be opened: {error!r}; see the log") from error
        log.info("started %s (%s)", spec.name, driver_name(spec))

    async def _close(self, names: Collection[RcName], why: dict[RcName, str]) -> None:
        """Robots first: the last packet to a robot goes through a radio, which may be one of this node."""
        for kind in (True, False):
            stopping = []
            for name in (name for name in names if isinstance(self._running[name].spec, RobotRc) is kind):
                if name in why:
                    self._running[name].rc.fail(f"it was {why[name]} the node file of {self._mesh.me.host}")
                stopping.append(self._running[name].stop())
            await asyncio.gather(*stopping)
        for name in names:
            del self._running[name]
            if name in why:
                log.info("stopped %s: it was %s the node file", name, why[name])


def tolerance(spec: RcConfig, driver: Driver) -> Tolerance:
    """Seconds from the table of an RC, else from its driver."""
    held = round(driver.tolerate * SECOND) if spec.tolerate is None else spec.tolerate
    most = max(held, round(driver.tolerate_max * SECOND)) if spec.tolerate_max is None else spec.tolerate_max
    return Tolerance(held, spec.tolerate_free, most)


def _robots_last(specs: Iterable[RcConfig]) -> list[RcConfig]:
    return sorted(specs, key=lambda spec: isinstance(spec, RobotRc))
