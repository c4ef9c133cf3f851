"""What process trees use, read from /proc in one pass: each component of a node, or the whole node."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from zscout.messages import MAX_COMPONENTS, ComponentUse

TICK: Final = 1 / os.sysconf("SC_CLK_TCK")
PAGE: Final = os.sysconf("SC_PAGE_SIZE")
MAX_THREADS: Final = 4_096
"""Of one tree whose waiting for a processor is looked at."""
SECOND: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class RunningComponent:
    """A component that runs on this host. `pid` is its root process: a child that was not waited for yet, so
    that the number can't have passed to another."""

    component: str
    kind: str
    incarnation: int
    pid: int


class ComponentProcesses(Protocol):
    """The components of a node; may be asked from any thread."""

    def running(self) -> Iterable[RunningComponent]: ...


class NoComponents:
    """The registry of a node without components."""

    def running(self) -> Iterable[RunningComponent]:
        return ()


class _Process(NamedTuple):
    parent: int
    state: str
    cpu: float
    """Seconds, with those of the children that it waited for."""
    started: float
    """Seconds since the host's start."""
    memory: int


class _Wanted(NamedTuple):
    """Nanoseconds that a thread ran, and that it waited for a processor."""

    ran: int
    waited: int


@dataclass(slots=True)
class _Last:
    at: float
    cpu: float
    threads: Mapping[int, _Wanted] = field(default_factory=dict)


class UseMeter:
    """Measures what components use; a figure over time is that since the last call, or since the start of
    the component. `proc` and `now` (seconds since the host's start) are the system's own."""

    def __init__(
        self,
        processes: ComponentProcesses,
        *,
        proc: Path = Path("/proc"),
        now: Callable[[], float] | None = None,
    ) -> None:
        self._processes, self._proc = processes, proc
        self._now = now or _since_boot
        self._last: dict[tuple[str, int, int], _Last] = {}

    def measure(self) -> tuple[ComponentUse, ...]:
        """One entry for each component whose root process lives, MAX_COMPONENTS at most."""
        running = list(self._processes.running())[:MAX_COMPONENTS]
        last, self._last = self._last, {}
        if not running:
            return ()
        now, table = self._now(), _table(self._proc)
        children = _children(table)
        found = []
        for one in running:
            root = table.get(one.pid)
            if root is not None:
                key = (one.component, one.incarnation, one.pid)
                before = last.get(key) or _Last(root.started, 0.0)
                tree = _tree(one.pid, children)
                use, self._last[key] = self._use(one, [table[pid] for pid in tree], tree, before, now)
                found.append(use)
        return tuple(found)

    def _use(
        self, one: RunningComponent, processes: list[_Process], pids: list[int], before: _Last, now: float
    ) -> tuple[ComponentUse, _Last]:
        cpu = sum(process.cpu for process in processes)
        threads = _threads(self._proc, pids)
        elapsed = now - before.at
        # A process that left the tree for another parent takes its time with it.
        cores = max(0.0, cpu - before.cpu) / elapsed if elapsed > 0 else 0.0
        use = ComponentUse(
            component=one.component,
            kind=one.kind,
            incarnation=one.incarnation,
            cpu=round(cores, 4),
            memory=sum(process.memory for process in processes),
            processes=len(processes),
            served=_served(before.threads, threads),
        )
        return use, _Last(now, cpu, threads)


class TreeUse(NamedTuple):
    """What one process tree used since it was last looked at."""

    elapsed: float
    """Seconds since then."""
    cores: float
    """That it had on average."""
    wanted: float
    """Cores that it wanted: those that it had, and those that its threads waited for."""
    memory: int
    """Bytes resident; what processes share counts for each."""


class TreeMeter:
    """Measures the process `root` (this one, if not given) and all its descendants again and again.

    Where the system does not tell how long threads waited, `wanted` is how many could run at this moment. Use
    it from one thread at a time. Raises OSError where there is no /proc."""

    def __init__(
        self,
        root: int | None = None,
        *,
        proc: Path = Path("/proc"),
        now: Callable[[], float] | None = None,
    ) -> None:
        self._root = os.getpid() if root is None else root
        self._proc = proc
        self._now = now or _since_boot
        self._last, _, _ = self._look()

    def measure(self) -> TreeUse:
        before = self._last
        self._last, memory, pids = self._look()
        elapsed = self._last.at - before.at
        if elapsed <= 0:
            return TreeUse(0.0, 0.0, 0.0, memory)
        # What leaves the tree takes its time with it; what comes late from ended children is no use of now.
        cores = min(max(0.0, self._last.cpu - before.cpu) / elapsed, float(os.cpu_count() or 1))
        if self._last.threads:
            ran, waited = _demand(before.threads, self._last.threads)
            wanted = min((ran + waited) / SECOND / elapsed, float(len(self._last.threads)))
        else:
            wanted = float(_runnable(self._proc, pids))
        return TreeUse(elapsed, cores, max(cores, wanted), memory)

    def _look(self) -> tuple[_Last, int, list[int]]:
        # A child that ended keeps its time until somebody waits for it, and then hands it on.
        now, table = self._now(), _table(self._proc, ended=True)
        if self._root not in table:
            raise OSError(f"{self._proc} does not tell of process {self._root}; mount it, or set load = true")
        pids = _tree(self._root, _children(table))
        tree = [table[pid] for pid in pids]
        last = _Last(now, sum(one.cpu for one in tree), _threads(self._proc, pids))
        return last, sum(one.memory for one in tree), pids


class LoadAverage:
    """Averages over 1, 5 and 15 minutes in which the past fades, as the kernel's do; 0 at first."""

    def __init__(self) -> None:
        self.averages = 0.0, 0.0, 0.0

    def add(self, wanted: float, seconds: float) -> tuple[float, float, float]:
        """`wanted` cores, for so long; returns the averages."""
        one, five, fifteen = (
            wanted + (past - wanted) * math.exp(-seconds / (60 * minutes))
            for past, minutes in zip(self.averages, (1, 5, 15), strict=True)
        )
        self.averages = one, five, fifteen
        return self.averages


def _since_boot() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _table(proc: Path, *, ended: bool = False) -> dict[int, _Process]:
    """All processes that live; with `ended` also those that nobody has waited for yet."""
    table = {}
    for name in _names(str(proc)):
        if name.isascii() and name.isdigit():
            process = _parse(_read(f"{proc}/{name}/stat"))
            if process is not None and (ended or process.state not in "ZXx"):
                table[int(name)] = process
    return table


def _parse(stat: bytes) -> _Process | None:
    """A line of /proc/PID/stat. The name in brackets may hold anything, brackets and spaces too."""
    fields = stat[stat.rfind(b")") + 1 :].split()
    try:
        cpu = sum(map(int, fields[11:15])) * TICK
        return _Process(
            parent=int(fields[1]),
            state=fields[0].decode("ascii", "replace"),
            cpu=cpu,
            started=int(fields[19]) * TICK,
            memory=max(0, int(fields[21])) * PAGE,
        )
    except (ValueError, IndexError):  # it ended just now
        return None


def _children(table: Mapping[int, _Process]) -> dict[int, list[int]]:
    children: dict[int, list[int]] = {}
    for pid, process in table.items():
        children.setdefault(process.parent, []).append(pid)
    return children


def _tree(root: int, children: Mapping[int, list[int]]) -> list[int]:
    """A process and all its descendants. Processes come and go while the table is read, so that it may hold
    a circle of parents."""
    tree, seen = [root], {root}
    for pid in tree:
        for child in children.get(pid, ()):
            if child not in seen:
                seen.add(child)
                tree.append(child)
    return tree


def _threads(proc: Path, pids: Iterable[int]) -> dict[int, _Wanted]:
    """Of each thread: /proc/PID/schedstat is that of a process's first one only."""
    found: dict[int, _Wanted] = {}
    for pid in pids:
        folder = f"{proc}/{pid}/task"
        for name in _names(folder):
            if len(found) >= MAX_THREADS:
                return found
            try:
                ran, waited, *_ = map(int, _read(f"{folder}/{name}/schedstat").split())
                found[int(name)] = _Wanted(ran, waited)
            except ValueError:
                continue
    return found


def _served(before: Mapping[int, _Wanted], now: Mapping[int, _Wanted]) -> float | None:
    """The share of the time in which threads wanted a processor that they had one, from 0 to 1; None if they
    wanted none, or the system does not tell."""
    ran, waited = _demand(before, now)
    return round(ran / (ran + waited), 4) if ran + waited > 0 else None


def _demand(before: Mapping[int, _Wanted], now: Mapping[int, _Wanted]) -> _Wanted:
    """What the threads that are there now ran and waited since."""
    ran = waited = 0
    for thread, wanted in now.items():
        last = before.get(thread)
        if last is None or wanted.ran < last.ran or wanted.waited < last.waited:  # another of the same number
            last = _Wanted(0, 0)
        ran += wanted.ran - last.ran
        waited += wanted.waited - last.waited
    return _Wanted(ran, waited)


def _runnable(proc: Path, pids: Iterable[int]) -> int:
    """Threads that run or wait for a processor at this moment, but for the one that asks."""
    mine, found, looked = str(threading.get_native_id()), 0, 0
    for pid in pids:
        folder = f"{proc}/{pid}/task"
        for name in _names(folder):
            looked += 1
            if looked > MAX_THREADS:
                return found
            stat = _read(f"{folder}/{name}/stat")
            if name != mine and stat[stat.rfind(b")") + 1 :].split()[:1] == [b"R"]:
                found += 1
    return found


def _names(folder: str) -> list[str]:
    """What is in a folder; nothing if it has gone."""
    try:
        with os.scandir(folder) as entries:
            return [entry.name for entry in entries]
    except OSError:
        return []


def _read(path: str) -> bytes:
    """A small file of /proc; nothing if it has gone."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return b""
    try:
        return os.read(fd, 4_096)
    except OSError:
        return b""
    finally:
        os.close(fd)
