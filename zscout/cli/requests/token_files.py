"""Tokens of `zscout acquire`: files and sockets in the user's runtime folder, and the messages on these sockets.

A token is the name of a file, mode 0600, and of a socket beside it, at which the holder process listens. Both are in
`$XDG_RUNTIME_DIR/zscout`, else `/run/user/UID/zscout`, else `/tmp/zscout-UID`: folders that only the user can enter.
When the hold has ended the file has the reason, for a day."""

from __future__ import annotations

import asyncio
import os
import re
import socket
import stat
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from zscout.config.state_folder import write_durably
from zscout.types import Ns

MAX_MESSAGE_BYTES: Final = 60_000
KEEP_ENDED_S: Final = 86_400.0
"""The file of a hold that has ended is kept for this long."""
MAX_PATH: Final = 100
"""Characters of a socket's path; the system allows 107."""
_TOKEN: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}-[0-9a-f]{12}")

T = TypeVar("T")


class TokenFile(msgspec.Struct, frozen=True):
    """Content of a token's file, JSON."""

    arc: str
    id: str
    client: str
    fleet: str
    rcs: list[str]
    pid: int
    ended: str = ""
    """The reason that the hold has ended; empty: it lasts as long as the process."""
    code: int = 0
    """The exit code of `zscout run` after the end."""


class ToHolder(msgspec.Struct, frozen=True):
    """To the holder process: `run` (with a descriptor, whose other end is closed when all processes of the command have
    ended), `gone`, `renew`, `release`."""

    op: str
    seconds: float = 0


class FromHolder(msgspec.Struct, frozen=True, omit_defaults=True):
    """From the holder process: `hold` (a command may run), `until`, `notice` (something will end the hold, in words),
    `end`, `done`, `refused`."""

    op: str
    env: dict[str, str] = {}
    grace: float = 0
    """Most seconds from SIGTERM to SIGKILL."""
    at: Ns = 0
    """`hold`, `until`: the time at which the guardian ends the command, unless a later time comes before. `end`: the
    time at which the hold ended."""
    why: str = ""
    code: int = 0
    withdrawn: bool = False
    """`notice`: True if its cause no longer exists."""
    remaining: float = 0
    """`done` after `renew`: seconds for which the hold is protected."""


class TokenGranted(msgspec.Struct, frozen=True):
    """From the holder process to the process that started it."""

    token: str
    text: str
    details: dict[str, Any]


class TokenChannel:
    """A connection, or one end of a socketpair, for messages."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket = connection

    def send(self, word: msgspec.Struct, fds: Sequence[int] = ()) -> None:
        """A message that can't be sent is dropped: the other process has ended, or has not read for long."""
        with suppress(OSError):
            socket.send_fds(self._socket, [msgspec.json.encode(word)], fds)

    async def receive(self, kind: type[T]) -> tuple[T, list[int]] | None:
        """Return the next message and its descriptors; None: the other process has ended, or sent something else."""
        while True:
            try:
                data, fds, _, _ = socket.recv_fds(self._socket, MAX_MESSAGE_BYTES, 1)
            except BlockingIOError:
                await readable(self._socket.fileno())
                continue
            except OSError:
                return None
            try:
                return msgspec.json.decode(data, type=kind), fds
            except msgspec.DecodeError:
                for fd in fds:
                    os.close(fd)
                return None

    def close(self) -> None:
        self._socket.close()


async def readable(fd: int) -> None:
    """Wait until data, or the end, can be read from a descriptor."""
    loop = asyncio.get_running_loop()
    ready = asyncio.Event()
    loop.add_reader(fd, ready.set)
    try:
        await ready.wait()
    finally:
        loop.remove_reader(fd)


def folders() -> list[Path]:
    """Return the folders that may have tokens; the first is for new tokens."""
    uid = os.getuid()
    given = os.environ.get("XDG_RUNTIME_DIR")
    tops = [*([Path(given)] if given else []), Path(f"/run/user/{uid}")]
    found = [top / "zscout" for top in tops if _is_ours(top)]
    return [*dict.fromkeys(found), Path(f"/tmp/zscout-{uid}")]  # noqa: S108 - only the user can enter it


def _is_ours(folder: Path) -> bool:
    """Return True for a folder of this user's that others can't write."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022


def new_folder() -> Path:
    """Make the folder for new tokens if necessary, and remove tokens that ended a day ago. Raises OSError."""
    for folder in folders():
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
        if _is_ours(folder):
            _sweep(folder)
            return folder
    raise PermissionError(f"other users can write to {folders()[-1]}; remove it, or set $XDG_RUNTIME_DIR")


def _sweep(folder: Path) -> None:
    for path in folder.glob("*.json"):
        with suppress(OSError, ValueError, msgspec.DecodeError):
            old = time.time() - path.stat().st_mtime > KEEP_ENDED_S
            if old and (read(path).ended or not _lives(path)):
                remove(path)


def find(token: str) -> Path | None:
    """Return the file of a token; None if this user has no such token on this host."""
    if _TOKEN.fullmatch(token) is None:
        return None
    paths = (folder / f"{token}.json" for folder in folders() if _is_ours(folder))
    return next((path for path in paths if path.is_file()), None)


def tokens() -> list[str]:
    return sorted(path.stem for folder in folders() if _is_ours(folder) for path in folder.glob("*.json"))


def read(path: Path) -> TokenFile:
    """Raises OSError, DecodeError."""
    return msgspec.json.decode(path.read_bytes(), type=TokenFile)


def write(path: Path, content: TokenFile) -> None:
    """Raises OSError."""
    write_durably(path, msgspec.json.encode(content), mode=0o600)


def remove(path: Path) -> None:
    path.unlink(missing_ok=True)
    remove_socket(path)


def remove_socket(path: Path) -> None:
    _socket_of(path).unlink(missing_ok=True)


def _socket_of(path: Path) -> Path:
    return path.with_suffix(".sock")


@contextmanager
def _reachable(path: Path) -> Iterator[str]:
    """Yield a path of the socket that is short enough for the system."""
    if len(str(path)) <= MAX_PATH:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def listen(path: Path) -> socket.socket:
    """Listen for the token of this file. Raises OSError."""
    server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    server.setblocking(False)
    before = os.umask(0o177)
    try:
        with _reachable(_socket_of(path)) as name:
            server.bind(name)
    finally:
        os.umask(before)
    server.listen(64)
    return server


def accept(server: socket.socket) -> TokenChannel | None:
    """Accept a connection; None unless it is of the same user or root."""
    try:
        connection, _ = server.accept()
    except OSError:
        return None
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    _, uid, _ = struct.unpack("3i", credentials)
    if uid not in (0, os.getuid()):
        connection.close()
        return None
    return TokenChannel(connection)


def connect(path: Path) -> TokenChannel | None:
    """None: its process has ended."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        with _reachable(_socket_of(path)) as name:
            connection.connect(name)
    except OSError:
        connection.close()
        return None
    return TokenChannel(connection)


def _lives(path: Path) -> bool:
    if (channel := connect(path)) is None:
        return False
    channel.close()
    return True
