"""Resource use of process trees, read from /proc in one pass: each component of a node, or the whole node."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from zscout.messages import MAX_COMPONENTS, ComponentUse
from zscout.types import SECOND

TICK: Final = 1 / os.sysconf("SC_CLK_TCK")
PAGE: Final = os.sysconf("SC_PAGE_SIZE")
MAX_THREADS: Final = 4_096  # threads of one tree whose waiting time is read
PROC: Final = Path("/proc")


def since_boot() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class RunningComponent(NamedTuple):
    """`pid` is the component's root process, a child not waited for yet, so that its number is not reused."""

    component: str
    kind: str
    incarnation: int
    pid: int


Running: TypeAlias = Callable[[], Iterable[RunningComponent]]  # the components of a node; callable from any thread


class _Process(NamedTuple):
    parent: int
    state: bytes
    cpu: float  # seconds, including children it waited for
    started: float  # seconds since the host's start
    memory: int


_Demand: TypeAlias = tuple[int, int]  # nanoseconds that a thread ran, and waited for a processor


class _Tree(NamedTuple):
    """A process and all its descendants at one moment, `at` in seconds since the host's start."""

    at: float
    started: float = 0.0  # start of its root, on the same clock
    cpu: float = 0.0  # processor seconds so far
    memory: int = 0
    pids: Sequence[int] = ()
    threads: Mapping[int, _Demand] = {}

    def cores(self, before: _Tree) -> float:
        """Average since `before`. Processes that leave the tree take their time with them."""
        elapsed = self.at - before.at
        return max(0.0, self.cpu - before.cpu) / elapsed if elapsed > 0 else 0.0


def _trees(proc: Path, at: float, roots: Iterable[int], *, ended: bool = False) -> dict[int, _Tree]:
    """The trees of living roots; with `ended` also of processes not waited for."""
    table: dict[int, _Process] = {}
    children: dict[int, list[int]] = {}
    for name in _names(str(proc)):
        if name.isascii() and name.isdigit():
            process = _parse(_read(f"{proc}/{name}/stat"))
            if process is not None and (ended or process.state not in b"ZXx"):
                table[int(name)] = process
                children.setdefault(process.parent, []).append(int(name))
    found = {}
    for root in roots:
        if root in table:
            # The table is read while processes change: it may hold a circle of parents.
            pids = {root: table[root]}
            queue = [root]
            for pid in queue:
                for child in children.get(pid, ()):
                    if child not in pids:
                        pids[child] = table[child]
                        queue.append(child)
            cpu, memory = (
                sum(process.cpu for process in pids.values()),
                sum(process.memory for process in pids.values()),
            )
            found[root] = _Tree(at, table[root].started, cpu, memory, queue, _threads(proc, queue))
    return found


class UseMeter:
    """Measures the use of components, averaged since the last call or their start."""

    def __init__(self, running: Running, *, proc: Path = PROC, now: Callable[[], float] = since_boot) -> None:
        self._running, self._proc, self._now = running, proc, now
        self._last: dict[RunningComponent, _Tree] = {}

    def measure(self) -> tuple[ComponentUse, ...]:
        """One entry per component with a living root, at most MAX_COMPONENTS."""
        running = list(self._running())[:MAX_COMPONENTS]
        trees = _trees(self._proc, self._now(), {component.pid for component in running}) if running else {}
        last, self._last = self._last, {known: trees[known.pid] for known in running if known.pid in trees}
        return tuple(_use(known, last.get(known) or _Tree(tree.started), tree) for known, tree in self._last.items())


def _use(running: RunningComponent, before: _Tree, tree: _Tree) -> ComponentUse:
    ran, waited = _demand(before.threads, tree.threads)
    return ComponentUse(
        component=running.component,
        kind=running.kind,
        incarnation=running.incarnation,
        cpu=round(tree.cores(before), 4),
        memory=tree.memory,
        processes=len(tree.pids),
        served=round(ran / (ran + waited), 4) if ran + waited > 0 else None,
    )


class TreeUse(NamedTuple):
    elapsed: float  # seconds since then
    cores: float  # average used
    wanted: float  # used, plus those its threads waited for
    memory: int  # bytes resident; shared memory counts for each


class TreeMeter:
    """Measures the process `root` (default: our own) and its descendants, from one thread. Raises OSError without
    /proc. Without waiting times from the system, `wanted` is the number of runnable threads."""

    def __init__(self, root: int | None = None, *, proc: Path = PROC, now: Callable[[], float] = since_boot) -> None:
        self._root = os.getpid() if root is None else root
        self._proc, self._now = proc, now
        self._last = self._look()

    def measure(self) -> TreeUse:
        before, self._last = self._last, self._look()
        tree, elapsed = self._last, self._last.at - before.at
        if elapsed <= 0:
            return TreeUse(0.0, 0.0, 0.0, tree.memory)
        # Time of ended children arrives late, and is no present use.
        cores = min(tree.cores(before), float(os.cpu_count() or 1))
        if tree.threads:
            wanted = min(sum(_demand(before.threads, tree.threads)) / SECOND / elapsed, len(tree.threads))
        else:
            wanted = float(_runnable(self._proc, tree.pids))
        return TreeUse(elapsed, cores, max(cores, wanted), tree.memory)

    def _look(self) -> _Tree:
        # An ended child keeps its time until its parent waits for it, then passes it on.
        trees = _trees(self._proc, self._now(), [self._root], ended=True)
        if self._root not in trees:
            raise OSError(f"{self._proc} does not show process {self._root}; mount it, or set load = true")
        return trees[self._root]


def faded(averages: tuple[float, ...], wanted: float, seconds: float) -> tuple[float, float, float]:
    """Load averages over 1, 5 and 15 minutes after `wanted` cores for `seconds`, decaying like the kernel's."""
    first, second, third = (
        wanted + (past - wanted) * math.exp(-seconds / (60 * minutes))
        for past, minutes in zip(averages, (1, 5, 15), strict=True)
    )
    return first, second, third


def _fields(stat: bytes) -> list[bytes]:
    """The fields after the name, which is in brackets and may contain any character."""
    return stat[stat.rfind(b")") + 1 :].split()


def _parse(stat: bytes) -> _Process | None:
    """A line of /proc/PID/stat."""
    fields = _fields(stat)
    try:
        return _Process(
            parent=int(fields[1]),
            state=fields[0],
            cpu=sum(map(int, fields[11:15])) * TICK,
            started=int(fields[19]) * TICK,
            memory=max(0, int(fields[21])) * PAGE,
        )
    except (ValueError, IndexError):  # the process has just ended
        return None


def _tasks(proc: Path, pids: Iterable[int], file: str) -> Iterator[tuple[int, bytes]]:
    """Contents of `file` for each thread, at most MAX_THREADS: a process's own folder has only its first thread's."""
    tasks = ((f"{proc}/{pid}/task", name) for pid in pids for name in _names(f"{proc}/{pid}/task"))
    for folder, name in islice(tasks, MAX_THREADS):
        yield int(name), _read(f"{folder}/{name}/{file}")


def _threads(proc: Path, pids: Iterable[int]) -> dict[int, _Demand]:
    found: dict[int, _Demand] = {}
    for thread, figures in _tasks(proc, pids, "schedstat"):
        try:
            ran, waited, *_ = map(int, figures.split())
        except ValueError:  # the thread has just ended, or the system lacks the figure
            continue
        found[thread] = ran, waited
    return found


def _demand(before: Mapping[int, _Demand], now: Mapping[int, _Demand]) -> _Demand:
    """Time that the present threads ran and waited since `before`."""
    ran = waited = 0
    for thread, (ran_now, waited_now) in now.items():
        ran_then, waited_then = before.get(thread, (0, 0))
        if ran_now < ran_then or waited_now < waited_then:  # another thread with the same number
            ran_then = waited_then = 0
        ran += ran_now - ran_then
        waited += waited_now - waited_then
    return ran, waited


def _runnable(proc: Path, pids: Iterable[int]) -> int:
    """Except the caller."""
    mine = threading.get_native_id()
    return sum(thread != mine and _fields(stat)[:1] == [b"R"] for thread, stat in _tasks(proc, pids, "stat"))


def _names(folder: str) -> list[str]:
    with suppress(OSError), os.scandir(folder) as entries:
        return [entry.name for entry in entries]
    return []


def _read(path: str) -> bytes:
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return os.read(fd, 4_096)
        finally:
            os.close(fd)
    except OSError:
        return b""
