"""How processes of one host find each other without a network.

Each session listens on loopback, and publishes its port in the name of an abstract Linux socket. The kernel lists these
names, removes them with their process, and keeps them apart for each network namespace, as it does loopback. A new
session connects to the sessions that it finds. Where multicast was first, and linked the two by a network address, the
new session ends that link: it would end with the address. Like an answer to multicast, a name grants no rights:
it only gives an address."""

from __future__ import annotations

import hashlib
import re
import socket
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from zscout.config.fleet import MeshConfig
from zscout.mesh.links import Link, by_network, ends, shut
from zscout.types import SECOND

MAX_NEIGHBOURS: Final = 64
"""A new session connects to at most this many sessions, the oldest first, so to nodes. Multicast finds the others."""
LISTEN_TIMEOUT_S: Final = 0.5
RELINK_TIMEOUT_S: Final = 0.5
POLL_S: Final = 0.005
YOUNG: Final = 2 * SECOND
"""Nanoseconds. A neighbour that was opened so long ago listens, or its process hangs."""
_NAMES: Final = Path("/proc/net/unix")
_LISTENERS: Final = Path("/proc/net/tcp")
_LISTENS: Final = re.compile(r"^ *\d+: 0100007F:([0-9A-F]{4}) \S+ 0A ", re.MULTILINE)
_RETRY: Final = "#retry_period_init_ms=50;retry_period_max_ms=5000;retry_period_increase_factor=2"
"""Retry seldom: Zenoh tries to reach an ended neighbour as long as this session lives."""


class Meeting:
    """Reserves and publishes the loopback port of one session of a fleet until it is closed, and lists the endpoints of
    its neighbours in `others`. Raises OSError if the sockets can't be made.

    `at`: when it was published, in ns since 1970. Of two sessions the one with the later time makes the link."""

    def __init__(self, fleet: str, mesh: MeshConfig, protocol: str) -> None:
        meeting = hashlib.sha256(" ".join([fleet, *mesh.known_by]).encode()).hexdigest()[:16]
        self._reserved = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._published = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            # Reserves the port for Zenoh, which may bind it too, until this socket is closed.
            self._reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._reserved.bind(("127.0.0.1", 0))
            port, self.at = self._reserved.getsockname()[1], time.time_ns()
            self.endpoint = f"{protocol}/127.0.0.1:{port}"
            # Publish before listing: of two sessions that start together at least one finds the other.
            self._published.bind(f"\0zscout-mesh-{meeting}-{protocol}-{port}-{self.at}")
            self._name = re.compile(
                rf"@zscout-mesh-{meeting}-{protocol}-(\d{{1,5}})-(\d{{1,20}})$", re.ASCII | re.MULTILINE
            )
            # Of two sessions the newer one makes the link.
            older = [(at, port) for at, port in self._neighbours() if at < self.at][:MAX_NEIGHBOURS]
            self.others = [f"{protocol}/127.0.0.1:{port}{_RETRY}" for _, port in older]
            self._older = {time_in_id(at) for at, _ in older}
            self._young = {time_in_id(at): port for at, port in older if self.at - at < YOUNG}
        except OSError:
            self.close()
            raise

    def wait_for_others(self) -> None:
        """Wait until the neighbours listen that were opened at about the same time. Blocks LISTEN_TIMEOUT_S at most."""
        tries = round(LISTEN_TIMEOUT_S / POLL_S) if self._young else 0
        while tries and not set(self._young.values()) <= _listening():
            tries -= 1
            time.sleep(POLL_S)

    def relink(self, links: Callable[[], Iterable[Link]]) -> None:
        """End the links of a new session to older neighbours by network addresses: Zenoh soon tries loopback again, and
        has nothing to lose yet. Blocks RELINK_TIMEOUT_S at most, while such a link stands or a neighbour of the same
        moment is not linked yet."""
        waiting = set(self._young)
        for _ in range(round(RELINK_TIMEOUT_S / POLL_S)):
            found = {ends(link): (_time_of(link.zid), by_network(link)) for link in links()}
            wrong = {both: peer for both, (peer, bad) in found.items() if bad and peer in self._older}
            waiting = waiting.union(wrong.values()) - {peer for peer, bad in found.values() if not bad}
            if wrong:
                shut(lambda known, wrong=wrong: known.ends in wrong)  # type: ignore[misc]
            elif not waiting:
                return
            time.sleep(POLL_S)
            # Those that ended get no link.
            waiting = waiting and waiting & {time_in_id(at) for at, _ in self._neighbours()}

    def is_neighbour(self, peer: str) -> bool:
        """Return True for the id of a session of this host if one of the two links to the published address of the
        other, as long as both live."""
        began = _time_of(peer)
        return any(time_in_id(at) == began and (at > self.at or began in self._older) for at, _ in self._neighbours())

    def _neighbours(self) -> list[tuple[int, int]]:
        """Times and ports of all sessions with names, its own too, the oldest first."""
        found = list[tuple[int, int]]()
        with suppress(OSError):
            found = [(int(at), int(port)) for port, at in self._name.findall(_NAMES.read_text(errors="replace"))]
        return sorted((at, port) for at, port in found if at < 1 << 64 and 0 < port < 65_536)

    def release_port(self) -> None:
        """Close the reserving socket: Zenoh listens on the port now."""
        self._reserved.close()

    def close(self) -> None:
        self._reserved.close()
        self._published.close()


def time_in_id(at: int) -> str:
    """The end of the id of a session with this time, in ns since 1970, which orders ids by time (`increasing_id`)."""
    return at.to_bytes(8, "little").hex()[4:]


def _time_of(peer: object) -> str:
    return str(peer)[-12:]


def _listening() -> set[int]:
    """Ports of loopback on which processes of this host listen."""
    with suppress(OSError):
        return {int(port, 16) for port in _LISTENS.findall(_LISTENERS.read_text(errors="replace"))}
    return set()
