"""Tells the mesh how loaded this host is: real figures, once a second, dropped rather than queued."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Iterable
from typing import Final

from zscout.keyexpr import Role, Token, new_instance
from zscout.mesh import Declared, Mesh
from zscout.messages import LoadReport
from zscout.services.cgroup import Cgroup
from zscout.services.host_figures import CpuMeter, Paced, clock, cores, memory, speed, temperature
from zscout.services.process_use import Nothing, Processes, UseMeter

log = logging.getLogger("zscout.load")

PERIOD: Final = 1.0
"""Seconds between two reports."""
SPEED_EVERY: Final = 60.0
SPEED_TRIES: Final = 5
"""Of every measurement but the first."""
SENSORS_EVERY: Final = 10.0
"""Seconds; reading a sensor may take milliseconds, and one file for each core."""
SENSORS_SHARE: Final = 0.0002
USES_SHARE: Final = 0.002
"""Of one core, that is spent on looking at what components use: many are looked at less often."""


class LoadReporter:
    """Publishes this host's load until stopped. `labels` are the host's; `processes` its components."""

    def __init__(self, mesh: Mesh, labels: Iterable[str] = (), processes: Processes | None = None) -> None:
        self.mesh = mesh
        self._labels = tuple(labels)
        self._processes = processes or Nothing()
        self._declared: list[Declared] = []
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        me = self.mesh.me
        self._publisher = self.mesh.publisher(self.mesh.keys.load(me.host), LoadReport, data=True)
        self._declared = [self.mesh.alive(Token(me.host, Role.LOAD, me.client, new_instance()))]
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
            self._publisher.close()
        for declared in self._declared:
            declared.close()

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time() + PERIOD
        # In a thread: it reads files, of which a sensor's may take its time.
        gauge = await asyncio.to_thread(Gauge, self.mesh.me.host, self._labels, self._processes)
        failed = False
        while True:
            await asyncio.sleep(due - loop.time())
            # After a stall the reports that were missed are not made up for.
            due = max(due + PERIOD, loop.time())
            try:
                report = await asyncio.to_thread(gauge.report)
            except Exception:  # a host that can't be measured once may be the next time
                if not failed:
                    log.exception("this host's load can't be measured; it is tried again every second")
                failed = True
            else:
                failed = False
                self._publisher.put(report)


class Gauge:
    """Measures one host again and again. Takes 30 ms to make; use it from one thread at a time."""

    def __init__(
        self,
        host: str,
        labels: tuple[str, ...] = (),
        processes: Processes | None = None,
        cgroup: Cgroup | None = None,
    ) -> None:
        self._host, self._labels = host, labels
        self._cgroup = cgroup or Cgroup()
        self._cpu = CpuMeter(self._cgroup)
        self._number = 0
        self._speed = speed()
        self._fresh = True
        self._speeds = Paced(self._measure_speed, least=SPEED_EVERY, share=1.0)
        self._clocks = Paced(clock, least=SENSORS_EVERY, share=SENSORS_SHARE)
        self._temperatures = Paced(temperature, least=SENSORS_EVERY, share=SENSORS_SHARE)
        meter = UseMeter(processes or Nothing())
        self._uses = Paced(meter.measure, least=PERIOD / 2, share=USES_SHARE)

    def report(self) -> LoadReport:
        """The host's load now; CPU use since the last call."""
        self._number += 1
        size, free = cores(self._cgroup), memory(self._cgroup)
        now, rated = self._clocks()
        return LoadReport(
            host=self._host,
            number=self._number,
            # Readers of the first version take whole numbers only.
            cores=int(size) if size.is_integer() else size,
            load_average=os.getloadavg(),
            cpu=self._cpu.percent(size),
            memory_available=free.available,
            memory_total=free.total,
            speed=round(self._speeds(), 3),
            clock=round(now, 1),
            clock_rated=round(rated, 1),
            temperature=self._temperatures(),
            labels=self._labels,
            components=self._uses(),
        )

    def _measure_speed(self) -> float:
        if self._fresh:
            self._fresh = False
            return self._speed
        found = speed(SPEED_TRIES)
        # A few tries may find a processor that was only asleep: believed at once if faster, else by halves.
        self._speed = found if found > self._speed else (self._speed + found) / 2
        return self._speed
