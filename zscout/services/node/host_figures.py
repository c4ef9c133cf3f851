"""What a host is and has: processors, their speed and use, memory, temperature. Read from the system.

The limits of a container count where they are smaller than the host.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from typing import Final, Generic, TypeVar

import psutil

from zscout.services.node.cgroup import Cgroup, HostMemory

WORK: Final = 12_000
"""Rounds of the piece of work that speed is measured by: about a millisecond on a plain machine of 2024."""
TRIES: Final = 15
"""The best of so many counts: caches and clocks were not ready for the others."""
PAUSE: Final = 0.001
"""Seconds between two tries, in which other threads have the interpreter."""

T = TypeVar("T")


class CpuMeter:
    """How much of the processors was in use since it was last asked."""

    def __init__(self, cgroup: Cgroup) -> None:
        self._cgroup = cgroup
        self._host = _host_times()
        self._group = (time.monotonic(), cgroup.used())

    def percent(self, cores: float) -> float:
        """In percent of the host's processors or, if that is more, of the `cores` a container may use."""
        before, self._host = self._host, _host_times()
        busy, total = (now - then for now, then in zip(self._host, before, strict=True))
        percent = 100 * busy / total if total > 0 else 0.0
        (then, spent), self._group = self._group, (time.monotonic(), self._cgroup.used())
        now, used = self._group
        if spent is not None and used is not None and now > then:
            percent = max(percent, 100 * (used - spent) / ((now - then) * cores))
        return min(100.0, max(0.0, percent))


class Paced(Generic[T]):
    """A figure that is measured no more often than every `least` seconds, and less often where measuring it
    would take more than `share` of one core; between that the last one is given."""

    def __init__(self, measure: Callable[[], T], *, least: float, share: float) -> None:
        self._measure, self._least, self._share = measure, least, share
        self._due = -math.inf

    def __call__(self) -> T:
        now = time.monotonic()
        if now >= self._due:
            start = time.thread_time()
            self._value = self._measure()
            cost = time.thread_time() - start
            self._due = now + max(self._least, cost / self._share)
        return self._value


def cores(cgroup: Cgroup) -> float:
    """Cores that this process can use: the fewest of what there are, what it is bound to, and its limits."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = cgroup.cores()
    return float(bound) if limit is None else min(float(bound), limit)


def memory(cgroup: Cgroup) -> HostMemory:
    """What the host has, or the container where that is less."""
    host = psutil.virtual_memory()
    limit = cgroup.memory()
    if limit is None:
        return HostMemory(host.available, host.total)
    return HostMemory(min(limit.available, host.available), min(limit.total, host.total))


def clock() -> tuple[float, float]:
    """Processor clock in MHz, now and rated; 0 where the system does not tell."""
    try:
        found = psutil.cpu_freq()
    except (OSError, NotImplementedError, RuntimeError, ValueError):
        found = None
    if found is None:
        return 0.0, 0.0
    return float(found.current or 0), float(found.max or 0)


def temperature() -> float | None:
    """The hottest of the host's sensors in degrees Celsius; None where there is none."""
    sensors = getattr(psutil, "sensors_temperatures", None)
    if sensors is None:
        return None
    try:
        found = sensors()
    except (OSError, RuntimeError, ValueError):
        return None
    current = [one.current for group in found.values() for one in group if one.current]
    return max(current, default=None)


def speed(tries: int = TRIES) -> float:
    """How fast one core is at Python's own work: 1.0 does the piece of work in a millisecond of processor
    time. Takes a few of them, 2 ms a try; call it in a thread of its own."""
    best = math.inf
    for _ in range(tries):
        best = min(best, _work())
        time.sleep(PAUSE)
    return 1e-3 / best


def _work() -> float:
    # Processor time of this thread: what others take from it says nothing about the machine.
    start = time.thread_time()
    total = 0
    for number in range(WORK):
        total += number * number & 0xFF
    return max(time.thread_time() - start, 1e-9)


def _host_times() -> tuple[float, float]:
    """Seconds of all processors so far: busy, and in all."""
    times = psutil.cpu_times()._asdict()
    for within in ("guest", "guest_nice"):  # these are in `user` and `nice` already
        times.pop(within, None)
    total = sum(times.values())
    return total - times["idle"] - times.get("iowait", 0.0), total
