"""A limit of memory that a process sets itself, where its host can't set one for all its processes."""

from __future__ import annotations

import resource
from pathlib import Path


def limit_allocations(limit: int) -> None:
    """From now on this process, and each that it starts, uses no more than `limit` bytes: what it asks for
    beyond that is a MemoryError. 0: no limit."""
    if limit <= 0:
        return
    # Stacks and arenas that are reserved and not used count as data: only what is added from here on matters.
    reserved, used = _status("VmData"), _status("VmRSS")
    ceiling = reserved + max(0, limit - used)
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard != resource.RLIM_INFINITY:
        ceiling = min(ceiling, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (ceiling, ceiling))


def _status(name: str) -> int:
    """A size in /proc/self/status, in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        key, _, value = line.partition(":")
        if key == name:
            return int(value.split()[0]) * 1024
    return 0
