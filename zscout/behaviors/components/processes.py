"""Kill all processes of a component, and limit their memory.

A variable in their environment marks them, which children inherit, even in a process group of their own."""

from __future__ import annotations

import os
import resource
import select
import signal
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

VARIABLE: Final = "ZSCOUT_COMPONENT"
ROUNDS: Final = 20
"""Most searches of /proc: processes may fork between two."""
DYING: Final = 1.0
"""Seconds to wait for killed processes: one that hangs in the kernel may never die."""
MAX_ENVIRONMENT: Final = 4_000_000
"""Most bytes read of a process's environment."""


def kill_family(tag: str, *, spare: int = 0) -> int:
    """Kill all processes with VARIABLE=`tag` in their environment, but `spare`. Return their number once they are dead,
    or after DYING seconds. Other users' processes are not seen."""
    wanted = f"{VARIABLE}={tag}".encode()
    killed: dict[int, int] = {}
    try:
        for _ in range(ROUNDS):
            pids = [int(name) for name in _names("/proc") if name.isascii() and name.isdigit()]
            found = {pid: _kill(pid, wanted) for pid in pids if pid != spare and pid not in killed}
            new = {pid: handle for pid, handle in found.items() if handle is not None}
            if not new:
                break
            killed |= new
        _wait(killed.values())
    finally:
        for handle in killed.values():
            os.close(handle)
    return len(killed)


def _names(folder: str) -> list[str]:
    """None if it can't be read."""
    with suppress(OSError):
        return os.listdir(folder)  # noqa: PTH208
    return []


def _kill(pid: int, wanted: bytes) -> int | None:
    """Kill `pid` if `wanted` is in its environment, and return a pidfd of it; else return None."""
    try:
        # A pidfd rather than the pid, which the kernel may have reused.
        handle = os.pidfd_open(pid)
    except OSError:
        return None
    with suppress(OSError), Path(f"/proc/{pid}/environ").open("rb") as file:
        if wanted in file.read(MAX_ENVIRONMENT).split(b"\0"):
            signal.pidfd_send_signal(handle, signal.SIGKILL)
            return handle
    os.close(handle)
    return None


def _wait(handles: Iterable[int]) -> None:
    """Wait until these processes are dead: a killed process keeps its environment for a moment."""
    poll = select.poll()
    dying = set(handles)
    for handle in dying:
        poll.register(handle, select.POLLIN)
    deadline = time.monotonic() + DYING
    while dying and (left := deadline - time.monotonic()) > 0:
        for handle, _ in poll.poll(left * 1000):
            poll.unregister(handle)
            dying.discard(handle)


def limit_allocations(limit: int) -> None:
    """Limit this process and each that it starts to `limit` bytes; more raises MemoryError. 0: no limit. For hosts that
    can't limit a component's processes together."""
    if limit <= 0:
        return
    # RLIMIT_DATA also counts stacks and arenas that are reserved but unused, so leave those out.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    reserved, used = (int(status[size].split()[0]) * 1024 for size in ("VmData", "VmRSS"))
    ceiling = reserved + max(0, limit - used)
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard != resource.RLIM_INFINITY:
        ceiling = min(ceiling, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (ceiling, ceiling))
