"""Figures of a host, read from the system: processors, their speed and use, memory, temperature.

Limits of control groups (cgroup v2, v1, or both) count if smaller than the host; unreadable files are no limit."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, Generic, NamedTuple, TypeVar

import psutil

from zscout.types import SECOND

WORK: Final = 12_000  # rounds of the speed benchmark: about a millisecond on a plain machine of 2024
TRIES: Final = 15  # the best try counts: caches and clocks warm up in the others
PAUSE: Final = 0.001  # seconds between two tries, for other threads

NO_LIMIT: Final = 1 << 60  # bytes; cgroup v1 writes about this much for no limit
MAX_DEPTH: Final = 64  # nested groups examined
MAX_BYTES: Final = 65_536  # of one file read

T = TypeVar("T")


class HostMemory(NamedTuple):
    """In bytes."""

    available: int
    total: int


class Cgroup:
    """Limits of a process's control groups and their parents. `root`: mount point; `of`: the file with its groups."""

    def __init__(self, root: Path = Path("/sys/fs/cgroup"), of: Path = Path("/proc/self/cgroup")) -> None:
        places = own_groups(of)
        unified = places.get("", ())
        # Beside groups of v1 systemd mounts v2 one folder deeper.
        self._v2 = [*group_folders(root, unified), *group_folders(root / "unified", unified)]
        self._cpu = group_folders(root / "cpu", places.get("cpu", ()))
        self._cpuacct = root / "cpuacct"
        self._memory = group_folders(root / "memory", places.get("memory", ()))

    def cores(self) -> float | None:
        """Most usable cores; None: no limit."""
        limit = self._tightest()
        return None if limit is None else limit[0]

    def used(self) -> float | None:
        """Processor seconds used by the group with the tightest limit; None without limit or figure."""
        limit = self._tightest()
        if limit is None:
            return None
        folder = limit[1]
        if (spent := read_field(folder / "cpu.stat", "usage_usec")) is not None:
            return spent / 1e6
        if folder in self._cpu:
            nested = folder.relative_to(self._cpu[0])
            for place in (folder, self._cpuacct / nested):
                if (spent := _number(place / "cpuacct.usage")) is not None:
                    return spent / SECOND
        return None

    def memory(self) -> HostMemory | None:
        """The tightest total, and the least left of any; None: no limit. Droppable file caches count as available."""
        found = []
        names = [(folder, "memory.max", "memory.current", "inactive_file") for folder in self._v2]
        v1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        for folder, limit, usage, dropped in [*names, *((folder, *v1) for folder in self._memory)]:
            total, used = _number(folder / limit), _number(folder / usage)
            if total is not None and used is not None and 0 < total < NO_LIMIT:
                free = total - used + (read_field(folder / "memory.stat", dropped) or 0)
                found.append(HostMemory(max(0, min(total, free)), total))
        if not found:
            return None
        return HostMemory(min(limit.available for limit in found), min(limit.total for limit in found))

    def _tightest(self) -> tuple[float, Path] | None:
        found = []
        for folder in self._v2:
            quota, _, period = read_text(folder / "cpu.max").partition(" ")
            found.append((_share(_whole(quota), _whole(period)), folder))
        for folder in self._cpu:
            quota_us, period_us = (_number(folder / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
            found.append((_share(quota_us, period_us), folder))
        limits = [(share, folder) for share, folder in found if share is not None]
        return min(limits, key=lambda limit: limit[0], default=None)


def _share(quota: int | None, period: int | None) -> float | None:
    """Cores by a quota of time per period; -1 is none."""
    return quota / period if quota and period and quota > 0 and period > 0 else None


def own_groups(of: Path) -> dict[str, tuple[str, ...]]:
    """The process's group path by controller; cgroup v2 has no name."""
    places = {}
    for line in read_text(of).splitlines():
        _, first, rest = line.partition(":")
        controllers, second, path = rest.partition(":")
        if first and second:
            parts = tuple(part for part in path.split("/") if part and part != ".")
            for controller in controllers.split(","):
                places[controller] = () if ".." in parts else parts[:MAX_DEPTH]
    return places


def group_folders(root: Path, parts: tuple[str, ...]) -> list[Path]:
    """The folders from the root to a group. In a container the path may be the host's, with only the root present."""
    folders = [root]
    for part in parts:
        folders.append(folders[-1] / part)
        if not folders[-1].is_dir():
            return folders[:-1]
    return folders


def read_text(file: Path) -> str:
    with suppress(OSError, ValueError), file.open("rb") as opened:
        return opened.read(MAX_BYTES).decode("ascii", "replace").strip()
    return ""


def _whole(text: str) -> int | None:
    text = text.strip()
    try:
        return int(text) if len(text) <= 20 else None
    except ValueError:
        return None


def _number(file: Path) -> int | None:
    return _whole(read_text(file))


def read_field(file: Path, name: str) -> int | None:
    """The figure after `name` in a file of named figures; None if absent."""
    for line in read_text(file).splitlines():
        key, _, value = line.partition(" ")
        if key == name:
            return _whole(value)
    return None


class CpuMeter:
    def __init__(self, cgroup: Cgroup) -> None:
        self._cgroup = cgroup
        self._host = _host_times()
        self._group = (time.monotonic(), cgroup.used())

    def percent(self, cores: float) -> float:
        """Percent of the host's processors or, if that is more, of a container's `cores`."""
        before, self._host = self._host, _host_times()
        busy, total = (now - then for now, then in zip(self._host, before, strict=True))
        percent = 100 * busy / total if total > 0 else 0.0
        (then, spent), self._group = self._group, (time.monotonic(), self._cgroup.used())
        now, used = self._group
        if spent is not None and used is not None and now > then:
            percent = max(percent, 100 * (used - spent) / ((now - then) * cores))
        return min(100.0, max(0.0, percent))


class Paced(Generic[T]):
    """A figure measured every `least` seconds at most, at a cost of `share` of one core at most; else cached."""

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
    """Usable cores: the fewest of present, bound, and limit."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return float(min(bound, cgroup.cores() or bound))


def memory(cgroup: Cgroup) -> HostMemory:
    """The host's memory, or the container's if less."""
    host = psutil.virtual_memory()
    limit = cgroup.memory() or host
    return HostMemory(min(limit.available, host.available), min(limit.total, host.total))


def clock() -> tuple[float, float]:
    """Processor clock in MHz, now and rated; 0 if unknown."""
    with suppress(OSError, NotImplementedError, RuntimeError, ValueError):
        if (found := psutil.cpu_freq()) is not None:
            return float(found.current or 0), float(found.max or 0)
    return 0.0, 0.0


def temperature() -> float | None:
    """The hottest sensor in degrees Celsius; None without one."""
    with suppress(AttributeError, OSError, RuntimeError, ValueError):  # not every system has this function
        found = psutil.sensors_temperatures()
        return max((sensor.current for group in found.values() for sensor in group if sensor.current), default=None)
    return None


def speed(tries: int = TRIES) -> float:
    """Speed of one core for Python code; 1.0 is a core that runs the benchmark in 1 ms. A try takes about 2 ms."""
    best = math.inf
    for _ in range(tries):
        # Thread time: other load does not slow the result.
        start = time.thread_time()
        total = 0
        for number in range(WORK):
            total += number * number & 0xFF
        best = min(best, max(time.thread_time() - start, 1e-9))
        time.sleep(PAUSE)
    return 1e-3 / best


def _host_times() -> tuple[float, float]:
    """Seconds of all processors so far: busy, and total."""
    times = psutil.cpu_times()._asdict()
    for within in ("guest", "guest_nice"):  # these are in `user` and `nice` already
        times.pop(within, None)
    total = sum(times.values())
    return total - times["idle"] - times.get("iowait", 0.0), total
