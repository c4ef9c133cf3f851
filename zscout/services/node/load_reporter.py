"""Publishes the load of this host once a second, dropped rather than queued."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Final, TypeAlias

from msgspec.structs import replace

from zscout.keyexpr import Role, Token, new_instance
from zscout.mesh import Mesh, Supervisor
from zscout.messages import MAX_ERROR, LoadReport
from zscout.services.node import host_figures
from zscout.services.node.process_use import Running, TreeMeter, TreeUse, UseMeter, faded
from zscout.services.node.reload import FilesInForce
from zscout.services.recorder.process import RecorderProcess
from zscout.types import VERSION

log = logging.getLogger("zscout.load")

PERIOD: Final = 1.0  # seconds between two reports
RESTARTS: Final = (1.0, 60.0)  # seconds before a failed reporter restarts: the first time, and at most
SPEED_EVERY: Final = 60.0
SPEED_TRIES: Final = 5  # of every measurement but the first
SENSORS_EVERY: Final = 10.0  # seconds; a sensor may take milliseconds, and one file per core
SENSORS_SHARE: Final = 0.0002
USES_SHARE: Final = 0.002  # of one core, spent on measuring components: many are measured less often
TREE_SHARE: Final = 0.004  # the same for this process and its descendants


LoadFigures: TypeAlias = tuple[tuple[float, float, float], float, int]
"""Load averages, percent of all cores, bytes of memory available."""


class LoadReporter:
    """Publishes this host's load until stopped; with `tree`, of this process and its descendants only. A failure is
    logged, withdraws the liveliness token, and restarts after RESTARTS seconds: the node continues."""

    def __init__(
        self,
        mesh: Mesh,
        labels: Iterable[str] = (),
        running: Running = tuple,
        files: FilesInForce | None = None,
        *,
        tree: bool = False,
        recorder: RecorderProcess | None = None,
    ) -> None:
        self.mesh, self._files, self._recorder = mesh, files, recorder
        self._tree = tree
        self._labels, self._running = tuple(labels), running
        self._pause = RESTARTS[0]
        self._restart: asyncio.TimerHandle | None = None

    def start(self) -> None:
        me = self.mesh.me
        self._publisher = self.mesh.publisher(self.mesh.keys.load(me.host), LoadReport, data=True)
        self._token = self.mesh.alive(Token(me.host, Role.LOAD, me.client, new_instance()))
        self._supervisor = Supervisor("the load reporter", self._failed)
        self._supervisor.spawn(self._run())

    async def stop(self) -> None:
        if self._restart is not None:
            self._restart.cancel()
        if self._supervisor.active:
            self._leave()
        await self._supervisor.close()

    def _failed(self, _error: Exception) -> None:
        self._leave()
        self._restart = asyncio.get_running_loop().call_later(self._pause, self.start)
        self._pause = min(2 * self._pause, RESTARTS[1])

    def _leave(self) -> None:
        self._token.close()
        self._publisher.close()

    def _with_files(self, report: LoadReport) -> LoadReport:
        if self._recorder is not None:
            report = replace(report, recorder=self._recorder.fault[:MAX_ERROR])
        if (files := self._files) is not None:
            report = replace(report, rights=files.rights, fault=files.fault[:MAX_ERROR])
        own, now = self.mesh.validity, datetime.now(UTC)
        if own is None:
            return report
        left = own.ends_in(now)
        return replace(report, certificate_ends_in=round(left, 1), renew=left <= 0 or own.soon(now))

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time() + PERIOD
        # In a thread: reading files, such as a sensor's, may be slow.
        load = await asyncio.to_thread(TreeLoad) if self._tree else None
        gauge = await asyncio.to_thread(Gauge, self.mesh.me.host, self._labels, self._running, load=load)
        failed = False
        while True:
            await asyncio.sleep(due - loop.time())
            # Reports missed in a stall are skipped.
            due = max(due + PERIOD, loop.time())
            try:
                report = await asyncio.to_thread(gauge.report)
            except Exception:  # the next measurement may succeed
                if not failed:
                    log.exception("this host's load can't be measured; retrying every second")
                failed = True
            else:
                failed = False
                self._publisher.put(self._with_files(report))
                self._pause = RESTARTS[0]


class TreeLoad:
    """The load of the process `root` (default: our own) and its descendants alone."""

    def __init__(self, root: int | None = None) -> None:
        self._meter = TreeMeter(root)
        self._averages = 0.0, 0.0, 0.0
        self._uses = host_figures.Paced(self._measure, least=PERIOD / 2, share=TREE_SHARE)

    def __call__(self, size: float, ram: host_figures.HostMemory) -> LoadFigures:
        """The load on `size` cores and `ram` memory; CPU use since the last call."""
        use = self._uses()
        return self._averages, min(100.0, 100 * use.cores / size), max(0, ram.total - use.memory)

    def _measure(self) -> TreeUse:
        use = self._meter.measure()
        self._averages = faded(self._averages, use.wanted, use.elapsed)
        return use


class Gauge:
    """Measures one host repeatedly, the first time for 30 ms; for one thread at a time."""

    def __init__(
        self, host: str, labels: tuple[str, ...] = (), running: Running = tuple, *, load: TreeLoad | None = None
    ) -> None:
        self._host, self._labels = host, labels
        self._cgroup = host_figures.Cgroup()
        self._cpu = host_figures.CpuMeter(self._cgroup)
        self._load = load or self._host_load
        self._number = 0
        self._speed = 0.0
        self._speeds = host_figures.Paced(self._measure_speed, least=SPEED_EVERY, share=1.0)
        self._clocks = host_figures.Paced(host_figures.clock, least=SENSORS_EVERY, share=SENSORS_SHARE)
        self._temperatures = host_figures.Paced(host_figures.temperature, least=SENSORS_EVERY, share=SENSORS_SHARE)
        self._uses = host_figures.Paced(UseMeter(running).measure, least=PERIOD / 2, share=USES_SHARE)

    def report(self) -> LoadReport:
        """The host's load now; CPU use since the last call."""
        self._number += 1
        size, ram = host_figures.cores(self._cgroup), host_figures.memory(self._cgroup)
        averages, percent, available = self._load(size, ram)
        now, rated = self._clocks()
        return LoadReport(
            host=self._host,
            number=self._number,
            # Readers of the first version accept whole numbers only.
            cores=int(size) if size.is_integer() else size,
            load_average=averages,
            cpu=percent,
            memory_available=available,
            memory_total=ram.total,
            speed=round(self._speeds(), 3),
            clock=round(now, 1),
            clock_rated=round(rated, 1),
            temperature=self._temperatures(),
            labels=self._labels,
            components=self._uses(),
            version=VERSION,
        )

    def _host_load(self, size: float, ram: host_figures.HostMemory) -> LoadFigures:
        """Load of the host, or of a container with limits; CPU use since the last call."""
        return os.getloadavg(), self._cpu.percent(size), ram.available

    def _measure_speed(self) -> float:
        found = host_figures.speed(SPEED_TRIES) if self._speed else host_figures.speed()
        # A slow result may come from a sleeping processor: faster ones are believed at once, slower ones by half.
        self._speed = found if found > self._speed else (self._speed + found) / 2
        return self._speed
