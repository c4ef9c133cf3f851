"""A port of pyserial, by any name: a device, a link to a device, or a URL. Blocking.

Bytes that the other end does not take within TIMEOUT are discarded, never sent later. For this, the port checks the
system's count of bytes not yet taken by the device or peer, TCP gives up after TIMEOUT, and a failed connection is
reset. A pty has no such count: up to 4,095 bytes can wait unseen at its other end."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import socket
import stat
import struct
import sys
import termios
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from ipaddress import IPv6Address, ip_address
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any, Final
from urllib.parse import urlsplit

from zscout.drivers.lock import InUse, port_lock
from zscout.mesh import clock
from zscout.types import SECOND, Ns

TIMEOUT: Final = 1.0
"""Seconds for reading or writing. After this time no written byte may still be on its way."""
IDLE: Final = 0.2
"""Seconds between two checks of an open port: that it exists, and how many bytes it has taken."""
CONNECT: Final = 2.0
READ_AT_ONCE: Final = 4_096
SEND_BUFFER: Final = 16_384
IDLE_TIMEOUT: Final = 4.0
"""Seconds after which a peer that answers no probes counts as gone, when nothing was written to it."""
OPTIONS: Final = (
    ("SOL_SOCKET", "SO_SNDBUF", SEND_BUFFER),
    ("SOL_SOCKET", "SO_KEEPALIVE", 1),
    ("IPPROTO_TCP", "TCP_NODELAY", 1),
    ("IPPROTO_TCP", "TCP_KEEPIDLE", 1),
    ("IPPROTO_TCP", "TCP_KEEPINTVL", 1),
    ("IPPROTO_TCP", "TCP_KEEPCNT", 4),
)
PTS: Final = range(136, 144)
"""Major device numbers of pseudo-terminals. Each container has its own minor numbers."""

_NOT_THERE: Final = "is not there; is it plugged in?"
_MOVED: Final = "leads to another device now"
_SILENT: Final = f"took nothing for {TIMEOUT:g} s; has the connected device stalled?"
_WORDS: Final = {
    **dict.fromkeys((errno.ENOENT, errno.ENODEV, errno.ENXIO), _NOT_THERE),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM), "can't be opened by this user; add the user to the port's group, often dialout"
    ),
    **dict.fromkeys((errno.EBUSY, errno.EAGAIN), "is used by another program"),
    errno.ENOTTY: "is no serial port",
    errno.ECONNREFUSED: "refuses connections: no program listens there",
    **dict.fromkeys((errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN), "can't be reached; is its host up?"),
    **dict.fromkeys((errno.ECONNRESET, errno.EPIPE, errno.ECONNABORTED), "was cut off by the other end"),
    errno.ETIMEDOUT: _SILENT,
    errno.EIO: "was unplugged",
}
_TEXTS: Final = (
    (_MOVED, _MOVED),
    ("open port.*timed out", f"did not answer within {CONNECT:g} s"),
    ("timed out|Write timeout", _SILENT),
    ("exclusively lock", _WORDS[errno.EBUSY]),
    ("write failed|device reports readiness", _WORDS[errno.EIO]),
    ("socket disconnected|connection failed", _WORDS[errno.EPIPE]),
    ("no ports found", _NOT_THERE),
    (r"\[Errno -\d+\]", "names an unknown host"),
    ("not seem to support RFC2217", "does not speak RFC 2217; is it a plain socket://?"),
    ("not accept parameter change", "does not take this baud rate"),
)
_NUMBER: Final = re.compile(r"(?:\[Errno |\()(\d+)[],]")
"""The error number in a message of pyserial."""


class SerialPort:
    """`url`: for `serial_for_url`. `dtr`, `rts`: states of these lines; None: pyserial's default. It can be reopened
    after `close`. Methods raise any exception that pyserial does not catch: see `plain`."""

    def __init__(self, url: str, baud: int, *, dtr: bool | None = None, rts: bool | None = None) -> None:
        self.url = url
        self._baud, self._dtr, self._rts = baud, dtr, rts
        self._port: Any = None
        self._locked = ExitStack()
        self._recent: deque[tuple[Ns, int]] = deque()
        """The writes within TIMEOUT: instant and size."""
        self._source: Any = None
        """The local address and TCP port of the last failed connection. A peer that has not noticed the failure accepts
        a new connection if it comes from the same port."""

    def open(self) -> None:
        import serial
        from serial import rfc2217
        from serial.urlhandler import protocol_socket

        port: Any = serial.serial_for_url(self.url, self._baud, timeout=TIMEOUT, do_not_open=True)
        if not isinstance(port, rfc2217.Serial):  # which has no write timeout
            port.write_timeout = TIMEOUT
        if self._dtr is not None:
            port.dtr = self._dtr
        if self._rts is not None:
            port.rts = self._rts
        is_device = isinstance(port, serial.Serial)
        is_network = isinstance(port, rfc2217.Serial | protocol_socket.Serial)
        if is_device:
            # Two programs on one line would garble each other's bytes.
            port.exclusive = True
        names = _device_names(port.port) if is_device else _network_names(self.url) if is_network else ()
        self._locked.enter_context(port_lock(names))
        try:
            if is_network:
                # pyserial's own `open`, but with bounded connection times.
                sockets = SimpleNamespace(**(vars(socket) | {"create_connection": self._connect}))
                module = vars(sys.modules[type(port).__module__])
                FunctionType(type(port).open.__code__, {**module, "socket": sockets})(port)
            else:
                port.open()
        except BaseException:
            self._locked.close()
            raise
        self._port = port
        self._recent.clear()
        if is_device and (self._dtr is not None or self._rts is not None):
            _keep_lines(port.fileno())

    def write(self, data: bytes) -> None:
        self._bound(TIMEOUT)
        self._recent.append((clock.now(), len(data) + data.count(0xFF)))  # RFC 2217 doubles these
        self._port.write(data)

    def look(self) -> int:
        """Call this every IDLE seconds. Return the number of received bytes. Raises if the port has become unusable."""
        left = self.outstanding()
        if not left:
            self._bound(IDLE_TIMEOUT)
        since = clock.now() - round((TIMEOUT - IDLE) * SECOND)
        while self._recent and self._recent[0][0] < since:
            self._recent.popleft()
        if left > sum(size for _, size in self._recent):
            raise OSError(errno.ETIMEDOUT, _SILENT)
        if hasattr(self._port, "fd"):
            with suppress(FileNotFoundError):
                if Path(self._port.port).stat().st_rdev != os.fstat(self._port.fd).st_rdev:
                    raise RuntimeError(_MOVED)
        waiting = self._port.in_waiting
        came = len(self._port.read(min(waiting, READ_AT_ONCE))) if waiting else 0
        if waiting and not came:
            raise OSError(errno.EPIPE, "the connection has ended")
        return came

    def outstanding(self) -> int:
        """Written bytes that the device or the peer has not taken yet; 0 if the system does not count them."""
        with suppress(Exception):
            at = self._socket or self._port
            return int(struct.unpack("i", fcntl.ioctl(at.fileno(), termios.TIOCOUTQ, bytes(4)))[0])
        return 0

    def close(self, *, discard: bool) -> None:
        """`discard`: drop the bytes that were not taken, because they would arrive late."""
        connection = self._socket
        with suppress(Exception):
            if connection is None:
                if discard:
                    self._port.reset_output_buffer()
            elif discard:
                self._source = connection.getsockname()
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with suppress(Exception):
            self._port.close()
        if connection is not None:
            connection.close()
        self._port = None
        self._locked.close()

    @property
    def _socket(self) -> Any:
        return getattr(self._port, "_socket", None)

    def _bound(self, seconds: float) -> None:
        """Set how long TCP waits for its peer; longer while nothing is sent: a lost keepalive is not repeated."""
        if self._socket is not None and hasattr(socket, "TCP_USER_TIMEOUT"):
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * seconds))

    def _connect(self, address: tuple[str, int], timeout: float | None = None) -> socket.socket:
        failed = OSError(errno.EADDRNOTAVAIL, "no address")
        for family, kind, number, _, to in socket.getaddrinfo(*address, type=socket.SOCK_STREAM):
            connection = socket.socket(family, kind, number)
            try:
                for level, option, value in OPTIONS:
                    if hasattr(socket, option):
                        connection.setsockopt(getattr(socket, level), getattr(socket, option), value)
                if self._source is not None:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    with suppress(OSError):  # in use, or its interface is gone: then use any port
                        connection.bind(self._source)
                connection.settimeout(CONNECT)
                connection.connect(to)
            except OSError as error:
                connection.close()
                if error.errno == errno.EADDRNOTAVAIL:
                    self._source = None
                failed = error
            else:
                connection.settimeout(TIMEOUT)
                return connection
        raise failed


def _device_names(path: str) -> Iterator[str]:
    """Yield a name of the device itself, whatever its path: a link, a relative path, a device node of a container."""
    found = Path(path).stat()
    if stat.S_ISCHR(found.st_mode):
        major = os.major(found.st_rdev)
        yield f"device {major}:{os.minor(found.st_rdev)}" + (f" of {found.st_dev}" if major in PTS else "")


def _network_names(url: str) -> Iterator[str]:
    """Yield names of a TCP port, one for each address of its host. All addresses of this host have the same name."""
    parts = urlsplit(url)
    if not parts.hostname or parts.port is None:
        raise ValueError(f"it names no host and port; write {parts.scheme}://host:7002, for example")
    for family, kind, _, _, to in socket.getaddrinfo(parts.hostname, parts.port, type=socket.SOCK_DGRAM):
        address = ip_address(str(to[0]).partition("%")[0])
        if isinstance(address, IPv6Address) and address.ipv4_mapped:
            address = address.ipv4_mapped
        here = address.is_loopback or address.is_unspecified
        if not here:
            with socket.socket(family, kind) as asking, suppress(OSError):
                asking.connect(to)  # sends nothing
                here = asking.getsockname()[0] == to[0]
        yield f"tcp {'here' if here else address} {parts.port}"


def _keep_lines(fd: int) -> None:
    """Keep the lines' states when the port is closed, so that reopening does not reset a board."""
    with suppress(termios.error):
        mode = termios.tcgetattr(fd)
        mode[2] &= ~termios.HUPCL
        termios.tcsetattr(fd, termios.TCSANOW, mode)


def plain(error: Exception) -> str:
    """The fault of a port as text that follows its name, for people who do not know pyserial."""
    if isinstance(error, InUse):
        return str(error)
    text = str(error)
    found = _NUMBER.search(text)
    number = getattr(error, "errno", None) or (int(found[1]) if found else None)
    if number in _WORDS:
        return _WORDS[number]
    return next(
        (words for form, words in _TEXTS if re.search(form, text)), f"fails: {text[:200] or type(error).__name__}"
    )
