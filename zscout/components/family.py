"""All processes of one component: those that made themselves a group of their own as well.

They are known by a word in their environment, which children inherit.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Final

VARIABLE: Final = "ZSCOUT_COMPONENT"
ROUNDS: Final = 20
"""How often it is looked for those that were started meanwhile."""
MAX_ENVIRONMENT: Final = 4_000_000
"""Bytes."""


def kill_family(tag: str, *, spare: int = 0) -> int:
    """Kills all processes in whose environment VARIABLE is `tag`, but for the process `spare`; returns how
    many. One that runs as another user can't be seen."""
    wanted = f"{VARIABLE}={tag}".encode()
    killed: set[int] = set()
    for _ in range(ROUNDS):
        found = [pid for pid in _processes() if pid != spare and pid not in killed and _kill(pid, wanted)]
        if not found:
            break
        killed.update(found)
    return len(killed)


def _processes() -> list[int]:
    return [int(name) for name in os.listdir("/proc") if name.isascii() and name.isdigit()]  # noqa: PTH208


def _kill(pid: int, wanted: bytes) -> bool:
    try:
        # A descriptor, not the number: that may have passed to another meanwhile.
        handle = os.pidfd_open(pid)
    except OSError:
        return False
    try:
        with Path(f"/proc/{pid}/environ").open("rb") as file:
            if wanted not in file.read(MAX_ENVIRONMENT).split(b"\0"):
                return False
        signal.pidfd_send_signal(handle, signal.SIGKILL)
    except OSError:
        return False
    finally:
        os.close(handle)
    return True
