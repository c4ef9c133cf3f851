"""How processes of one host find each other without a network.

Each session listens on loopback, and publishes its port in the name of an abstract Linux socket. The kernel lists these
names, removes them with their process, and keeps them apart for each network namespace, as it does loopback. A new
session connects to the sessions that it finds. Like an answer to multicast, a name grants no rights: it only gives an
address."""

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
"""A new session connects to at most this many sessions, the oldest first, so to nodes. Multicast finds the others."""
_NAMES: Final = Path("/proc/net/unix")
_RETRY: Final = "#retry_period_init_ms=50;retry_period_max_ms=5000;retry_period_increase_factor=2"
"""Retry seldom: Zenoh tries to reach an ended neighbour as long as this session lives."""


class Meeting:
    """Reserves and publishes the loopback port of one session of a fleet until it is closed, and lists the endpoints of
    its neighbours in `others`. Raises OSError if the sockets can't be made."""

    def __init__(self, fleet: str, mesh: MeshConfig, protocol: str) -> None:
        meeting = hashlib.sha256(" ".join([fleet, *mesh.known_by]).encode()).hexdigest()[:16]
        self._reserved = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._published = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            # Reserves the port for Zenoh, which may bind it too, until this socket is closed.
            self._reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._reserved.bind(("127.0.0.1", 0))
            port, at = self._reserved.getsockname()[1], time.time_ns()
            self.endpoint = f"{protocol}/127.0.0.1:{port}"
            # Publish before listing: of two sessions that start together at least one finds the other.
            self._published.bind(f"\0zscout-mesh-{meeting}-{protocol}-{port}-{at}")
            self.others = _others(meeting, protocol, at)
        except OSError:
            self.close()
            raise

    def release_port(self) -> None:
        """Close the reserving socket: Zenoh listens on the port now."""
        self._reserved.close()

    def close(self) -> None:
        self._reserved.close()
        self._published.close()


def _others(meeting: str, protocol: str, before: int) -> list[str]:
    """Endpoints of older neighbours, the oldest first: of two sessions the newer one makes the link."""
    name = re.compile(rf"@zscout-mesh-{meeting}-{protocol}-(\d{{1,5}})-(\d{{1,20}})$", re.ASCII | re.MULTILINE)
    found = list[tuple[int, str]]()
    with suppress(OSError):
        found = [(int(at), port) for port, at in name.findall(_NAMES.read_text(errors="replace"))]
    older = sorted((at, port) for at, port in found if at < before and 0 < int(port) < 65_536)
    return [f"{protocol}/127.0.0.1:{port}{_RETRY}" for _, port in older[:MAX_NEIGHBOURS]]
