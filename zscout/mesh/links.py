"""The sockets of a Zenoh session: how it closes at once, and loses single links.

Zenoh closes a session only after each of its attempts to connect has ended. A process that is frozen, or cut off in the
middle, lets an attempt last 10 s, in which all links of the session stand, and peers take it for alive
(docs/zenoh.md)."""

from __future__ import annotations

import atexit
import ipaddress
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, NamedTuple, Protocol, TypeAlias

import psutil
import zenoh

CLOSE_SOON_S: Final = 0.25
"""Seconds after which a session that is being closed loses its listeners and its attempts to connect."""
LINKS_END_S: Final = 1.0
"""Seconds after which it loses its links. On a busy host its last messages may take a while."""
ZENOHS_CLOSE_S: Final = 11.0
"""Seconds after which Zenoh gives up closing a session, and a second more."""
_LOCATOR: Final = re.compile(r"[a-z]+/\[?(?P<ip>[0-9a-f.:]+)\]?:(?P<port>[0-9]+)(?:[?#].*)?")

Address: TypeAlias = tuple[str, int]
Ends: TypeAlias = tuple[Address, Address]
"""The address and port of this end, and of the other end."""
NOWHERE: Final[Address] = ("", 0)
CLOSING: Final = "closes a session"
"""Name of the threads in which Zenoh closes a session."""
CLOSER: Final = "closes the mesh"
"""Name of threads that close a session, and may be the last to refer to it."""


class Link(Protocol):
    """A link of a session, by the endpoints of both ends and the id of the other session."""

    @property
    def zid(self) -> object: ...

    @property
    def src(self) -> object: ...

    @property
    def dst(self) -> object: ...


class Socket(NamedTuple):
    fd: int
    inode: int
    """Unlike `fd`, no later socket has the same."""
    ends: Ends
    """The other end of a listener is NOWHERE."""


class Sessions:
    """The open sessions of this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: list[zenoh.Session] = []
        self._at_work: set[threading.Event] = set()
        atexit.register(self._wait)

    def open(self, settings: zenoh.Config) -> zenoh.Session:
        """Raises ZError."""
        with self._awaited():
            session = zenoh.open(settings)
        with self._lock:
            self._open.append(session)
        return session

    def close(self, session: zenoh.Session, sought: Iterable[str] = (), listening: Iterable[str] = ()) -> None:
        """Close a session. It may be trying to connect to the endpoints `sought`, and alone has the ports of
        `listening`. Blocks, for up to 10 s if it tries to connect elsewhere; its links end after LINKS_END_S. Raises
        ZError."""
        with self._awaited():
            self._close(session, sought, listening)

    def _close(self, session: zenoh.Session, sought: Iterable[str], listening: Iterable[str]) -> None:
        errors = list[zenoh.ZError]()

        def close() -> None:
            try:
                session.close()  # type: ignore[no-untyped-call]
            except zenoh.ZError as error:
                errors.append(error)

        with self._lock:
            self._open = [other for other in self._open if other is not session]
        attempts = {address(endpoint) for endpoint in sought} - {NOWHERE}
        ports = {address(endpoint)[1] for endpoint in listening} - {0}
        closing = threading.Thread(target=close, name=CLOSING, daemon=True)
        closing.start()
        began = time.monotonic()
        closing.join(CLOSE_SOON_S)
        # The next session may have the same ports and endpoints, as soon as these are shut.
        standing = {found.inode for found in _sockets()} if closing.is_alive() else set()
        while closing.is_alive():  # others may link to it as long as it listens
            own = _links(session) if time.monotonic() - began >= LINKS_END_S else set()
            with self._lock:
                kept = {link for other in self._open for link in _links(other)}

            def goes(found: Socket, own: set[Ends] = own, kept: set[Ends] = kept) -> bool:
                here, there = found.ends
                if found.ends in own:
                    return True
                if found.inode not in standing:
                    return False
                if there == NOWHERE:
                    return here[1] in ports
                return there in attempts and found.ends not in kept

            shut(goes)
            closing.join(CLOSE_SOON_S)
        if errors:
            raise errors[0]

    @contextmanager
    def _awaited(self) -> Iterator[None]:
        """A thread that comes back from Zenoh while Python ends aborts the process: the end waits for it."""
        ready = threading.Event()
        self._at_work.add(ready)
        try:
            yield
        finally:
            self._at_work.discard(ready)
            ready.set()

    def _wait(self) -> None:
        """Wait for these threads, ZENOHS_CLOSE_S at most."""
        until = time.monotonic() + ZENOHS_CLOSE_S
        while self._at_work and (left := until - time.monotonic()) > 0:
            for ready in list(self._at_work)[:1]:
                ready.wait(left)
        # A thread that frees a session calls Zenoh too.
        for thread in threading.enumerate():
            if thread.name == CLOSER:
                thread.join(max(0.0, until - time.monotonic()))


SESSIONS: Final = Sessions()


def _links(session: zenoh.Session) -> set[Ends]:
    with suppress(zenoh.ZError):  # it is being closed
        return {ends(link) for link in session.info.links()}
    return set()


def address(endpoint: object) -> Address:
    """The address and port of an endpoint of TCP or TLS; NOWHERE for names, and for other endpoints."""
    found = _LOCATOR.fullmatch(str(endpoint))
    return NOWHERE if found is None else _plain((found["ip"], int(found["port"])))


def ends(link: Link) -> Ends:
    return address(link.src), address(link.dst)


def is_local(link: Link) -> bool:
    """Return True for a link within this host."""
    (here, _), (there, _) = ends(link)
    return here == there != ""


def by_network(link: Link) -> bool:
    """Return True for a link within this host by a network address: it ends with that address."""
    return is_local(link) and not ipaddress.ip_address(ends(link)[0][0]).is_loopback


def shut(chosen: Callable[[Socket], bool]) -> None:
    """Shut down chosen sockets of this process: Zenoh can't end a single link."""
    for found in _sockets():
        if chosen(found):
            # A copy: the descriptor may be closed meanwhile, and its number be given to another socket.
            with suppress(OSError), socket.socket(fileno=os.dup(found.fd)) as copy:
                if os.fstat(copy.fileno()).st_ino == found.inode:
                    copy.shutdown(socket.SHUT_RDWR)


def _sockets() -> list[Socket]:
    """The TCP sockets of this process; empty where they can't be listed."""
    found = list[Socket]()
    with suppress(psutil.Error, OSError):
        for known in psutil.Process().net_connections("tcp"):
            both = _plain(known.laddr), _plain(known.raddr) if len(known.raddr) else NOWHERE
            with suppress(OSError):  # it was closed
                found.append(Socket(known.fd, os.fstat(known.fd).st_ino, both))
    return found


def _plain(name: Sequence[Any]) -> Address:
    """An address of `socket` without scope, and without the form of IPv4 addresses that IPv6 sockets have."""
    return str(name[0]).removeprefix("::ffff:"), int(name[1])
