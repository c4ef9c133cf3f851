"""What a host is and has: processors, their speed and use, memory, temperature. Read from the system.

The limits of a container, by its control groups (cgroup v2, v1, or both at once), count where they are smaller than the
host. A file that is missing or makes no sense is no limit."""

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

WORK: Final = 12_000
"""Rounds of the piece of work that speed is measured by: about a millisecond on a plain machine of 2024."""
TRIES: Final = 15
"""The best of so many counts: caches and clocks were not ready for the others."""
PAUSE: Final = 0.001
"""Seconds between two tries, in which other threads have the interpreter."""

NO_LIMIT: Final = 1 << 60
"""Bytes; cgroup v1 writes about so much where there is no limit."""
MAX_DEPTH: Final = 64
"""Groups within groups that are looked at."""
MAX_BYTES: Final = 65_536
"""Of one file that is read."""

T = TypeVar("T")


class HostMemory(NamedTuple):
    """In bytes."""

    available: int
    total: int


class Cgroup:
    """The limits of the control groups that a process is in, and of those above them.

    `root` is where they are mounted, `of` the file that says which the process is in."""

    def __init__(self, root: Path = Path("/sys/fs/cgroup"), of: Path = Path("/proc/self/cgroup")) -> None:
        places = own_groups(of)
        unified = places.get("", ())
        # Beside groups of v1 systemd mounts those of v2 one folder deeper.
        self._v2 = [*group_folders(root, unified), *group_folders(root / "unified", unified)]
        self._cpu = group_folders(root / "cpu", places.get("cpu", ()))
        self._cpuacct = root / "cpuacct"
        self._memory = group_folders(root / "memory", places.get("memory", ()))

    def cores(self) -> float | None:
        """Cores that may be used at most; None: no limit."""
        limit = self._tightest()
        return None if limit is None else limit[0]

    def used(self) -> float | None:
        """Seconds of processor time that the group of the tightest limit has used so far; None: no limit, or
        the system does not tell."""
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
        """The total of the tightest limit and what is left of the most used one; None: no limit. Files that
        the system can drop count as available."""
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
        return HostMemory(min(one.available for one in found), min(one.total for one in found))

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
    """Cores by a quota of time in each period; a quota of -1 is none."""
    return quota / period if quota and period and quota > 0 and period > 0 else None


def own_groups(of: Path) -> dict[str, tuple[str, ...]]:
    """The way to the process's group by controller; that of cgroup v2 has no name."""
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
    """The folder of a group and those above it, from the root on. In a container the way to the group may be
    the host's, of which only the root is there."""
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
    """A whole number of no more than 20 digits."""
    text = text.strip()
    try:
        return int(text) if len(text) <= 20 else None
    except ValueError:
        return None


def _number(file: Path) -> int | None:
    return _whole(read_text(file))


def read_field(file: Path, name: str) -> int | None:
    """One figure of a file that has a name and a figure in each line; None if it is not there."""
    for line in read_text(file).splitlines():
        key, _, value = line.partition(" ")
        if key == name:
            return _whole(value)
    return None


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
    return float(min(bound, cgroup.cores() or bound))


def memory(cgroup: Cgroup) -> HostMemory:
    """What the host has, or the container where that is less."""
    host = psutil.virtual_memory()
    limit = cgroup.memory() or host
    return HostMemory(min(limit.available, host.available), min(limit.total, host.total))


def clock() -> tuple[float, float]:
    """Processor clock in MHz, now and rated; 0 where the system does not tell."""
    with suppress(OSError, NotImplementedError, RuntimeError, ValueError):
        if (found := psutil.cpu_freq()) is not None:
            return float(found.current or 0), float(found.max or 0)
    return 0.0, 0.0


def temperature() -> float | None:
    """The hottest of the host's sensors in degrees Celsius; None where there is none."""
    with suppress(AttributeError, OSError, RuntimeError, ValueError):  # not every system has this function
        found = psutil.sensors_temperatures()
        return max((one.current for group in found.values() for one in group if one.current), default=None)
    return None


def speed(tries: int = TRIES) -> float:
    """How fast one core is at Python's own work: 1.0 does the piece of work in a millisecond of processor
    time. Takes a few of them, 2 ms a try; call it in a thread of its own."""
    best = math.inf
    for _ in range(tries):
        # Processor time of this thread: what others take from it says nothing about the machine.
        start = time.thread_time()
        total = 0
        for number in range(WORK):
            total += number * number & 0xFF
        best = min(best, max(time.thread_time() - start, 1e-9))
        time.sleep(PAUSE)
    return 1e-3 / best


def _host_times() -> tuple[float, float]:
    """Seconds of all processors so far: busy, and in all."""
    times = psutil.cpu_times()._asdict()
    for within in ("guest", "guest_nice"):  # these are in `user` and `nice` already
        times.pop(within, None)
    total = sum(times.values())
    return total - times["idle"] - times.get("iowait", 0.0), total
