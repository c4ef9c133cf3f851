"""Links that were lost, or could not be made, are made at once.

Of two peers the one with the greater id makes their link: that is who joins, as ids increase, but for clocks that
differ. Zenoh looks for peers by multicast, once it has run for a while every 8 s: for so long two processes that live
may be without a link after a fault of a moment. But peers that are linked to a third are told of one another by it
(gossip), and link. So who had made a link sees whether the other listens still, asks by multicast for both addresses,
and opens a session that links to these two until they have found each other (docs/zenoh.md). A relay is a router, which
answers nobody who looks for peers: `connect` names it."""

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

log = logging.getLogger(__name__)

PAUSES: Final = (0.02, 0.1, 0.1, 0.2, 0.2, 0.5, *(1.0,) * 30)
"""Seconds before each look for a peer. After the last one it is left to Zenoh."""
TOGETHER: Final = 0.25
"""Seconds within which two losses mean that this process was away: it looks for those, too, that make the link."""
LOOKS_FOR_GREATER: Final = 4
"""So often: many may do so at one time."""
PROBE_TIMEOUT: Final = 0.25
PROBES_TIMEOUT: Final = 1.0
"""For all of one look: where many are lost, each has its turn."""
SCOUT_TIMEOUT: Final = 0.5
GREET_TIMEOUT: Final = 0.1
MEET_TIMEOUT: Final = 0.25
"""They are told of one another at once. An end that has not lost the link yet makes or takes no other."""
POLL: Final = 0.002
MEETING: Final = "6d656574"
"""So begins the id of a session that is opened for a moment: nobody misses it."""
_ADDRESS: Final = re.compile(r"^(?:tcp|tls)/(.+):(\d+)(?:[?#].*)?$")


@dataclass(slots=True)
class _Lost:
    at: float
    addresses: list[str] = field(default_factory=list)
    """Of the other ends of its links: where it listens, if they were made from here."""
    looks: int = 0
    listens: bool | None = None
    """Once it is known to, it is not asked again: each connection that a TLS listener sees closed unused keeps others
    out for 0.1 s (docs/zenoh.md), and one that was frozen sees them all when it goes on."""
    together: bool = False
    """Whether it is looked for though it is it that makes the link."""


class Relinking:
    """Of one session, in a thread that lives while something is lost.

    `scouting` says how peers are asked who is there; `meeting` gives the settings of a session that links to the
    addresses it is given, and to nobody else. It is one of a moment: its id, by which others know that, is set here."""

    def __init__(
        self, session: zenoh.Session, scouting: zenoh.Config, meeting: Callable[[Sequence[str]], zenoh.Config]
    ) -> None:
        self._session, self._scouting, self._meeting = session, scouting, meeting
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
            if alone and self._thread is None:  # a link may have come and gone already
                self._begin(greet=True)

    def close(self) -> None:
        """Before the session is closed. Returns when the thread has ended, in a second or two: one that is inside Zenoh
        when its process ends makes that a crash."""
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
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT or self._closed.is_set() or peer.startswith(MEETING):
                return  # of a link that is there a look tells: one may come and go without another event
            if peer in self._routers:
                self._routers.remove(peer)
                return
            self._lost.setdefault(peer, _Lost(now)).addresses.append(event.link.dst)
            lately = [one for one in self._lost.values() if now - one.at < TOGETHER]
            for one in lately:
                if len(lately) > 1 and not one.together:
                    one.together, one.looks = True, 0
            if self._thread is None:
                self._begin(greet=False)

    def _begin(self, *, greet: bool) -> None:
        self._thread = threading.Thread(target=self._run, args=(greet,), name="links again", daemon=True)
        self._thread.start()

    def _greet(self) -> None:
        """Nobody was there who is to wait for a link from here; those who make it may not know of this process."""
        found = self._scout(GREET_TIMEOUT)
        with self._lock:
            for peer in found.keys() - {self._own}:
                self._lost.setdefault(peer, _Lost(time.monotonic(), together=True))

    def _run(self, greet: bool) -> None:
        try:
            if greet:
                self._greet()
            while (pause := self._next()) is not None:
                self._closed.wait(pause)
                try:
                    self._look()
                except zenoh.ZError as error:  # the next look may do better
                    log.debug("looking for lost links failed: %s", error)
        except Exception:
            log.exception("lost links are left to Zenoh: looking for them failed")
            with self._lock:
                self._lost, self._thread = {}, None

    def _next(self) -> float | None:
        """Seconds until the next look; None: there is nobody to look for."""
        with self._lock:
            still = {peer: one for peer, one in self._lost.items() if one.looks < len(PAUSES)}
            self._lost = {} if self._closed.is_set() else still
            if self._lost:
                return min(PAUSES[one.looks] for one in self._lost.values())
            self._thread = None
            return None

    def _look(self) -> None:
        linked, now = self._linked(), time.monotonic()
        with self._lock:
            # One that has just been lost may be on the list still.
            self._lost = {
                peer: one for peer, one in self._lost.items() if peer not in linked or now - one.at < TOGETHER
            }
            lost = {peer: one for peer, one in self._lost.items() if peer not in linked}
        wanted, until = set(), time.monotonic() + PROBES_TIMEOUT
        for peer, one in sorted(lost.items(), key=lambda known: known[1].looks):
            if time.monotonic() > until or self._closed.is_set():
                break
            one.looks += 1
            one.listens = one.listens or _listens(one.addresses)
            if one.listens or (one.together and one.looks <= LOOKS_FOR_GREATER):
                wanted.add(peer)
            elif one.listens is False and time.monotonic() - one.at >= TOGETHER:
                # Its process has gone, or it is it that makes the link. Until then another may be lost.
                one.looks = len(PAUSES)
        if wanted and not self._closed.is_set():
            there = self._scout(SCOUT_TIMEOUT, wanted)
            if self._own in there and len(there) > 1:
                self._introduce(there)

    def _linked(self) -> set[str]:
        return {str(peer) for peer in self._session.info.peers_zid()}

    def _scout(self, seconds: float, wanted: Collection[str] = ()) -> dict[str, list[str]]:
        """The addresses of all who are there; of those who are wanted, and of this one, as soon as they are known."""
        found: dict[str, list[str]] = {}
        until = time.monotonic() + seconds
        with zenoh.scout(what="peer", config=self._scouting) as scout:
            while time.monotonic() < until and not (wanted and {*wanted, self._own} <= found.keys()):
                if (hello := scout.try_recv()) is None:
                    if self._closed.wait(POLL):
                        break
                elif not wanted or str(hello.zid) in {*wanted, self._own}:
                    # An address that holds on one link of a network only is none without the name of that link.
                    found[str(hello.zid)] = [one for one in hello.locators if "[fe80:" not in one]
        return found

    def _introduce(self, there: dict[str, list[str]]) -> None:
        addresses = [address for known in there.values() for address in known]
        peers, settings = there.keys() - {self._own}, self._meeting(addresses)
        settings.insert_json5("id", f'"{MEETING}{secrets.token_hex(10)}"')
        with zenoh.open(settings):
            until = time.monotonic() + MEET_TIMEOUT
            while time.monotonic() < until and not self._closed.wait(POLL):
                if peers <= self._linked():
                    log.info("linked again: %s", ", ".join(sorted(peers)))
                    return


def _listens(addresses: Sequence[str]) -> bool | None:
    """Whether anybody does at one of these; None: it can't be told now."""
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
