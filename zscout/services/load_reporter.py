"""Tells the mesh how loaded this host is: real figures, once a second, dropped rather than queued."""

from __future__ import annotations

import asyncio
import os

import psutil

from zscout.keyexpr import Role, Token, new_instance
from zscout.mesh import Declared, Mesh
from zscout.messages import LoadReport

PERIOD = 1.0
"""Seconds between two reports."""


class LoadReporter:
    """Publishes this host's load until stopped."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._number = 0
        self._declared: list[Declared] = []
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        me = self.mesh.me
        self._publisher = self.mesh.publisher(self.mesh.keys.load(me.host), LoadReport, data=True)
        self._declared = [self.mesh.alive(Token(me.host, Role.LOAD, me.client, new_instance()))]
        psutil.cpu_percent(None)  # the first reading has no interval to speak of
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
            self._publisher.close()
        for declared in self._declared:
            declared.close()

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(PERIOD)
            self._number += 1
            self._publisher.put(measure(self.mesh.me.host, self._number))


def measure(host: str, number: int) -> LoadReport:
    """The host's load now; CPU use since the last call."""
    memory = psutil.virtual_memory()
    return LoadReport(
        host=host,
        number=number,
        cores=os.cpu_count() or 1,
        load_average=os.getloadavg(),
        cpu=psutil.cpu_percent(None),
        memory_available=memory.available,
        memory_total=memory.total,
    )
