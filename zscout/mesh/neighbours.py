"""How processes of one host find each other without a network.

Each session listens on loopback, and shows where by the name of an abstract Linux socket. The kernel lists these names,
they are gone with their process, and another network namespace, with a loopback of its own, has others. A session
that is opened connects to those that were there before. A name is trusted as an answer to multicast is: it
admits nobody."""

from __future__ import annotations

import hashlib
import re
import socket
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from zscout.config.fleet import MeshConfig

MAX_NEIGHBOURS: Final = 64
"""Sessions that a new one connects to so: the oldest, nodes among them. Multicast finds the others."""
_NAMES: Final = Path("/proc/net/unix")
_RETRY: Final = "#retry_period_init_ms=50;retry_period_max_ms=5000;retry_period_increase_factor=2"
"""A neighbour that has ended is looked for in vain as long as this session lives: seldom."""


class Meeting:
    """Where one session of a fleet listens on loopback, shown until it is closed, and where its neighbours listen.
    Raises OSError where that can't be."""

    def __init__(self, fleet: str, mesh: MeshConfig, protocol: str) -> None:
        meeting = hashlib.sha256(" ".join([fleet, *mesh.known_by]).encode()).hexdigest()[:16]
        self._reserved = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._shown = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            # Zenoh can have the port beside this socket, and nobody else, until that is closed.
            self._reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._reserved.bind(("127.0.0.1", 0))
            port, at = self._reserved.getsockname()[1], time.time_ns()
            self.endpoint = f"{protocol}/127.0.0.1:{port}"
            # Shown before it looks: of two that begin at one time at least one sees the other.
            self._shown.bind(f"\0zscout-mesh-{meeting}-{protocol}-{port}-{at}")
            self.others = _others(meeting, protocol, at)
        except OSError:
            self.close()
            raise

    def listens(self) -> None:
        """Give up the port: Zenoh has it."""
        self._reserved.close()

    def close(self) -> None:
        self._reserved.close()
        self._shown.close()


def _others(meeting: str, protocol: str, before: int) -> list[str]:
    """The endpoints of the neighbours that are older, the oldest first: of two the newer one makes the link."""
    name = re.compile(rf"@zscout-mesh-{meeting}-{protocol}-(\d{{1,5}})-(\d{{1,20}})$", re.ASCII | re.MULTILINE)
    found = list[tuple[int, str]]()
    with suppress(OSError):
        found = [(int(at), port) for port, at in name.findall(_NAMES.read_text(errors="replace"))]
    older = sorted((at, port) for at, port in found if at < before and 0 < int(port) < 65_536)
    return [f"{protocol}/127.0.0.1:{port}{_RETRY}" for _, port in older[:MAX_NEIGHBOURS]]
