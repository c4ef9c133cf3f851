"""Restore links at once that were lost or could not be made.

Of two peers the one with the greater id makes the link: usually the newer peer, as ids increase. After its start Zenoh
scouts only every 8 s, so a short fault may leave two live processes unlinked that long. Two peers that are linked to a
third learn of each other from it (gossip), and link. So the process that had made a link probes the other's listener,
scouts for the addresses of both, and opens a temporary session linked to both until they have a link (docs/zenoh.md).
Relays are routers, which scouting does not find: `connect` names them."""

from __future__ import annotations

import logging
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import zenoh
from zenoh.handlers import Callback

from zscout.mesh.interfaces import LOOPBACK
from zscout.mesh.links import SESSIONS, by_network, ends, is_local

log = logging.getLogger(__name__)

ATTEMPT_PAUSES: Final = (0.02, 0.1, 0.1, 0.2, 0.2, 0.5, *(1.0,) * 30)
"""Seconds before each attempt; after the last one only Zenoh tries."""
SIMULTANEOUS: Final = 0.25
"""Seconds between two losses that mean that this process was cut off: then it looks for all peers."""
GREATER_ID_ATTEMPTS: Final = 4  # attempts for peers with a greater id; few, as many processes may try at once
PROBE_TIMEOUT: Final = 0.25
PROBES_TIMEOUT: Final = 1.0  # seconds for all probes of one attempt
SCOUT_TIMEOUT: Final = 0.5
GREET_TIMEOUT: Final = 0.1
MEET_TIMEOUT: Final = 0.25  # seconds; a peer that has not noticed the loss accepts no second link
POLL: Final = 0.002
TEMPORARY_ID: Final = "6d656574"  # prefix of the ids of temporary sessions, whose end is ignored
_ADDRESS: Final = re.compile(r"^(?:tcp|tls)/(.+):(\d+)(?:[?#].*)?$")


@dataclass(slots=True)
class _Lost:
    at: float
    addresses: list[str] = field(default_factory=list)  # on which the peer listens
    attempts: int = 0
    listens: bool | None = None  # once True not probed again: an unused connection blocks a TLS listener for 0.1 s
    together: bool = False  # True if this process looks for the peer though the peer makes the link
    neighbour: bool = False  # Zenoh tries its loopback address again at once; gossip would link by a network address


class Relinking:
    """Restores the links of one session, in a thread that runs while a link is lost.

    `scouting`: settings for finding peers; `meeting`: for a temporary session with only the given addresses;
    `is_neighbour`: True for ids of sessions that Zenoh links by loopback (neighbours.py)."""

    def __init__(
        self,
        session: zenoh.Session,
        scouting: zenoh.Config,
        meeting: Callable[[Sequence[str]], zenoh.Config],
        is_neighbour: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._session, self._scouting, self._meeting = session, scouting, meeting
        self._is_neighbour = is_neighbour
        self._own = str(session.zid())
        self._lock = threading.Lock()
        self._lost: dict[str, _Lost] = {}
        self._routers: set[str] = set()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        callback: Callback[zenoh.LinkEvent] = Callback(self._on_link, lambda: None, indirect=False)
        seen: Callback[zenoh.TransportEvent] = Callback(self._on_transport, lambda: None, indirect=False)
        self._listeners: list[Any] = [
            session.info.declare_transport_events_listener(seen, history=True),
            session.info.declare_link_events_listener(callback),
        ]
        alone = not self._linked()
        with self._lock:
            if alone and self._thread is None:  # a link may have been made and lost already
                self._begin(greet=True)

    def close(self) -> None:
        """Close before the session. Waits up to 2 s for the thread: ending the process inside Zenoh would crash it."""
        self._closed.set()
        for listener in self._listeners:
            with suppress(zenoh.ZError):
                listener.undeclare()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        if event.kind == zenoh.SampleKind.PUT and event.transport.whatami == zenoh.WhatAmI.ROUTER:
            with self._lock:
                self._routers.add(str(event.transport.zid))

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        now, peer = time.monotonic(), str(event.link.zid)
        if event.kind == zenoh.SampleKind.PUT or peer.startswith(TEMPORARY_ID):
            return  # `_try_all` sees new links: they may vanish without another event
        neighbour = is_local(event.link) and self._is_neighbour(peer)
        if neighbour and by_network(event.link):
            return  # the newer one of the two ended it, and links by loopback
        neighbour = neighbour and ends(event.link)[0][0] == LOOPBACK
        with self._lock:
            if self._closed.is_set():
                return
            if peer in self._routers:
                self._routers.remove(peer)
                return
            self._lost.setdefault(peer, _Lost(now, neighbour=neighbour)).addresses.append(event.link.dst)
            recent = [lost for lost in self._lost.values() if now - lost.at < SIMULTANEOUS]
            for lost in recent:
                if len(recent) > 1 and not lost.together:
                    lost.together, lost.attempts = True, 0
            if self._thread is None:
                self._begin(greet=False)

    def _begin(self, *, greet: bool) -> None:
        self._thread = threading.Thread(target=self._run, args=(greet,), name="links again", daemon=True)
        self._thread.start()

    def _greet(self) -> None:
        """Look for all peers at the start: this process may be known to none of them."""
        try:
            found = self._scout(GREET_TIMEOUT)
        except zenoh.ZError as error:  # no interface is up, loopback included
            log.debug("looking for peers failed: %s", error)
            return
        # Each look for neighbours reads a file: not under the lock, for which Zenoh's callbacks wait.
        others = [peer for peer in found.keys() - {self._own} if not self._is_neighbour(peer)]
        with self._lock:
            for peer in others:
                self._lost.setdefault(peer, _Lost(time.monotonic(), together=True))

    def _run(self, greet: bool) -> None:
        try:
            if greet:
                self._greet()
            while (pause := self._next()) is not None:
                self._closed.wait(pause)
                try:
                    self._try_all()
                except zenoh.ZError as error:  # the next attempt may succeed
                    log.debug("looking for lost links failed: %s", error)
        except Exception:
            log.exception("restoring lost links failed; only Zenoh retries them")
            with self._lock:
                self._lost, self._thread = {}, None

    def _next(self) -> float | None:
        """Seconds until the next attempt; None if no link is lost."""
        with self._lock:
            still = {peer: lost for peer, lost in self._lost.items() if lost.attempts < len(ATTEMPT_PAUSES)}
            self._lost = {} if self._closed.is_set() else still
            if self._lost:
                return min(ATTEMPT_PAUSES[lost.attempts] for lost in self._lost.values())
            self._thread = None
            return None

    def _try_all(self) -> None:
        linked, now = self._linked(), time.monotonic()
        with self._lock:
            # A peer just lost may still be listed as linked.
            self._lost = {
                peer: link for peer, link in self._lost.items() if peer not in linked or now - link.at < SIMULTANEOUS
            }
            lost = {peer: link for peer, link in self._lost.items() if peer not in linked}
        wanted, until = set(), time.monotonic() + PROBES_TIMEOUT
        for peer, link in sorted(lost.items(), key=lambda known: known[1].attempts):
            if time.monotonic() > until or self._closed.is_set():
                break
            link.attempts += 1
            link.listens = not link.neighbour and (link.listens or _listens(link.addresses))
            if link.listens or (link.together and not link.neighbour and link.attempts <= GREATER_ID_ATTEMPTS):
                wanted.add(peer)
            elif link.listens is False and time.monotonic() - link.at >= SIMULTANEOUS:
                # The peer's process ended, or the peer makes the link. Until SIMULTANEOUS is over,
                # another loss may follow.
                link.attempts = len(ATTEMPT_PAUSES)
        if wanted and not self._closed.is_set():
            there = self._scout(SCOUT_TIMEOUT, wanted)
            if self._own in there and len(there) > 1:
                self._introduce(there)

    def _linked(self) -> set[str]:
        return {str(peer) for peer in self._session.info.peers_zid()}

    def _scout(self, seconds: float, wanted: Collection[str] = ()) -> dict[str, list[str]]:
        """Addresses by peer. With `wanted`, only of these and this process; returns as soon as all are found."""
        found: dict[str, list[str]] = {}
        until = time.monotonic() + seconds
        with zenoh.scout(what="peer", config=self._scouting) as scout:
            while time.monotonic() < until and not (wanted and {*wanted, self._own} <= found.keys()):
                if (hello := scout.try_recv()) is None:
                    if self._closed.wait(POLL):
                        break
                elif not wanted or str(hello.zid) in {*wanted, self._own}:
                    # A link-local address is useless without its interface.
                    found[str(hello.zid)] = [at for at in hello.locators if "[fe80:" not in at]
        return found

    def _introduce(self, there: dict[str, list[str]]) -> None:
        addresses = [address for known in there.values() for address in known]
        peers, settings = there.keys() - {self._own}, self._meeting(addresses)
        settings.insert_json5("id", f'"{TEMPORARY_ID}{secrets.token_hex(10)}"')
        temporary = SESSIONS.open(settings)
        try:
            until = time.monotonic() + MEET_TIMEOUT
            while time.monotonic() < until and not self._closed.wait(POLL):
                if peers <= self._linked():
                    log.info("linked again: %s", ", ".join(sorted(peers)))
                    return
        finally:
            SESSIONS.close(temporary)  # its attempts go to addresses to which others of this process connect as well


def _listens(addresses: Sequence[str]) -> bool | None:
    """Return True if one of these addresses accepts connections, None if that is unknown now."""
    listens: bool | None = False
    for address in addresses:
        if (found := _ADDRESS.match(address)) is None:
            continue
        try:
            socket.create_connection((found[1].strip("[]"), int(found[2])), PROBE_TIMEOUT).close()
        except ConnectionRefusedError:
            continue
        except OSError:
            listens = None
        else:
            return True
    return listens
