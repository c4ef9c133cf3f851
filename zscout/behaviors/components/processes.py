"""All processes of one component, killed together, and their limit of memory.

They are known by a variable in their environment, which children inherit: those that made themselves a group
of their own as well.
"""

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
"""How often it is looked for those that were started meanwhile."""
DYING: Final = 1.0
"""Seconds that the killed have to die: one that hangs in the kernel may take for ever."""
MAX_ENVIRONMENT: Final = 4_000_000
"""Bytes."""


def kill_family(tag: str, *, spare: int = 0) -> int:
    """Kills all processes in whose environment VARIABLE is `tag`, but for the process `spare`; returns how
    many, once they are dead, or after DYING seconds. One that runs as another user can't be seen."""
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
    """Of what is in it; none where it can't be read."""
    with suppress(OSError):
        return os.listdir(folder)  # noqa: PTH208
    return []


def _kill(pid: int, wanted: bytes) -> int | None:
    """Kills `pid` if it is one of the family; returns a descriptor of it then."""
    try:
        # A descriptor, not the number: that may have passed to another meanwhile.
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
    """Waits until these processes are dead: one that is killed still has its environment for a moment."""
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
    """From now on this process, and each that it starts, uses no more than `limit` bytes: what it asks for
    beyond that is a MemoryError. 0: no limit. For hosts that can't limit all processes of one together."""
    if limit <= 0:
        return
    # Stacks and arenas that are reserved and not used count as data: only what is added from here on matters.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    reserved, used = (int(status[size].split()[0]) * 1024 for size in ("VmData", "VmRSS"))
    ceiling = reserved + max(0, limit - used)
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard != resource.RLIM_INFINITY:
        ceiling = min(ceiling, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (ceiling, ceiling))
