"""Limits of memory and processor time for components, by control groups (v1, or v2 if permitted).

A component with a limit gets a group below the node's, else only a memory limit per process (RLIMIT_DATA)."""

from __future__ import annotations

import logging
import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

import psutil

from zscout.services.node.host_figures import group_folders, own_groups, read_field, read_text

log = logging.getLogger("zscout.components")

PERIOD_US: Final = 100_000
LEAST_US: Final = 1_000  # of each period: the kernel's minimum
START_CORES: Final = 1.0
PREFIX: Final = "zscout."
LEAF: Final = "zscout-node"  # the group (v2) for the node itself: a group with processes can't limit groups within it
CLOSE_TRIES: Final = 50
CLOSE_PAUSE: Final = 0.02  # seconds. The kernel must finish a group's last process before its removal.


class ComponentGroup:
    """The limits of one component. Methods wait for files, `close` up to 1 s: not for the event loop."""

    def __init__(self, memory: int, cpu: float) -> None:
        self.folders: list[Path] = []
        self.memory = memory  # bytes; 0: no limit
        self.cpu = cpu  # cores; 0: no limit
        self.memory_set = self.cpu_set = False
        self.throttle: tuple[Path, str] | None = None  # the file, and its content once the component is ready

    @property
    def each(self) -> int:
        """Bytes that each process limits itself to, without a group; 0: none."""
        return 0 if self.memory_set else self.memory

    @property
    def missing(self) -> str:
        """The limits that this host can't set, in words."""
        parts = []
        if self.memory and not self.memory_set:
            parts.append("memory_limit holds for each of its processes, not for all together")
        if self.cpu and not self.cpu_set:
            parts.append("cpu_limit can't be set")
        return f"{' and '.join(parts)}: the node may not make control groups on this host" if parts else ""

    def enter(self, pid: int) -> None:
        """Add a process, with all its later children. Raises OSError."""
        for folder in self.folders:
            _write(folder / "cgroup.procs", str(pid))

    def settle(self) -> None:
        """The component is ready: replace START_CORES, which speed its start, by its limit."""
        if self.throttle is not None:
            with suppress(OSError):  # the group has ended meanwhile
                _write(*self.throttle)

    def overdrawn(self) -> bool:
        """Return True if the kernel killed part of it for exceeding its memory limit."""
        names = ("memory.events", "memory.oom_control")
        return self.memory_set and any(
            (read_field(folder / name, "oom_kill") or 0) > 0 for folder in self.folders for name in names
        )

    def close(self) -> None:
        """Kill all processes left in it, and remove it."""
        for folder in self.folders:
            for last in range(CLOSE_TRIES):
                for pid in _numbers(folder / "cgroup.procs"):
                    with suppress(OSError):
                        os.kill(pid, signal.SIGKILL)
                try:
                    with suppress(FileNotFoundError):
                        folder.rmdir()
                    break
                except OSError as error:
                    if last == CLOSE_TRIES - 1:
                        log.warning("the control group %s can't be removed: %s", folder, error)
                    time.sleep(CLOSE_PAUSE)
        self.folders = []


class ControlGroups:
    """Makes groups. `root`: their mount point; `of`: the file that lists the node's groups."""

    def __init__(self, root: Path = Path("/sys/fs/cgroup"), of: Path = Path("/proc/self/cgroup")) -> None:
        self._root = root
        self._of = own_groups(of)

    def group(self, name: str, memory: int, cpu: float) -> ComponentGroup:
        """A group for one component: `memory` in bytes, `cpu` in cores, 0 for no limit. Not for the event loop."""
        group = ComponentGroup(memory, cpu)
        name = f"{PREFIX}{os.getpid()}.{name}"
        group.memory_set = memory > 0 and self._limit(group, "memory", name)
        group.cpu_set = cpu > 0 and self._limit(group, "cpu", name)
        return group

    def sweep(self) -> None:
        """Remove the groups of killed nodes. Not for the event loop."""
        for parent in (self._own("memory"), self._own("cpu"), self._base()):
            for folder in parent.glob(f"{PREFIX}*"):
                owner = folder.name.removeprefix(PREFIX).partition(".")[0]
                if owner.isdecimal() and not Path("/proc", owner).exists():
                    with suppress(OSError):
                        folder.rmdir()

    def _own(self, controller: str) -> Path:
        """The node's group of v1, or its deepest visible parent: in a container the path may be the host's."""
        return group_folders(self._root / controller, self._of.get(controller, ()))[-1]

    def _limit(self, group: ComponentGroup, controller: str, name: str) -> bool:
        """Limit memory or processor time by a control group: of cgroup v1 if this controller is there, else of v2."""
        own, base, memory = self._own(controller), self._base(), str(group.memory)
        first, later = _quota(max(group.cpu, START_CORES)), _quota(group.cpu)
        also: dict[str, str] = {}
        if (own / "tasks").is_file():
            if controller == "memory":
                # The second includes swap; it is optional, and must not be below the first.
                wanted = {"memory.limit_in_bytes": memory}
                also = {"memory.memsw.limit_in_bytes": memory}
            else:
                wanted = {"cpu.cfs_period_us": str(PERIOD_US), "cpu.cfs_quota_us": str(first)}
                group.throttle = own / name / "cpu.cfs_quota_us", str(later)
            if _make(group, own / name, wanted, also):
                return True
        if not _may_delegate(base, controller):
            return False
        if controller == "memory":
            wanted = {"memory.max": memory}
            also = {"memory.swap.max": "0", "memory.oom.group": "1"}
        else:
            wanted = {"cpu.max": f"{first} {PERIOD_US}"}
            group.throttle = base / name / "cpu.max", f"{later} {PERIOD_US}"
        return _make(group, base / name, wanted, also)

    def _base(self) -> Path:
        own = self._own("")
        return own.parent if own.name == LEAF else own


def _make(group: ComponentGroup, folder: Path, wanted: dict[str, str], also: dict[str, str]) -> bool:
    try:
        folder.mkdir(exist_ok=True)
        for name, value in wanted.items():
            _write(folder / name, value)
    except OSError as error:
        log.info("can't use %s for limits: %s", folder, error)
        with suppress(OSError):
            folder.rmdir()
        return False
    for name, value in also.items():
        with suppress(OSError):
            if (folder / name).exists():
                _write(folder / name, value)
    if folder not in group.folders:
        group.folders.append(folder)
    return True


def _may_delegate(base: Path, controller: str) -> bool:
    """Return True if groups below `base` have, or now get, a controller. Only the root group passes one on while it
    holds processes: if all of `base` are the node's own, they move into a group below."""
    if controller not in read_text(base / "cgroup.controllers").split():
        return False
    switch = base / "cgroup.subtree_control"
    if controller in read_text(switch).split():
        return True
    try:
        try:
            _write(switch, f"+{controller}")
        except OSError:
            residents = _numbers(base / "cgroup.procs")
            if not residents or not all(map(_is_ours, residents)):
                raise
            (base / LEAF).mkdir(exist_ok=True)
            for pid in residents:
                _write(base / LEAF / "cgroup.procs", str(pid))
            _write(switch, f"+{controller}")
    except OSError as error:
        log.info("can't use %s for limits: %s", base, error)
        return False
    return True


def _is_ours(pid: int) -> bool:
    """Return True if a process is our own or a descendant."""
    try:
        return os.getpid() in (pid, *(parent.pid for parent in psutil.Process(pid).parents()))
    except psutil.Error:
        return False


def _quota(cores: float) -> int:
    return max(LEAST_US, round(cores * PERIOD_US))


def _write(file: Path, text: str) -> None:
    # Without O_CREAT: create no file in a folder that is no control group.
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_TRUNC), "w") as opened:
        opened.write(text)


def _numbers(file: Path) -> list[int]:
    return [int(word) for word in read_text(file).split() if word.isdecimal()]
