"""Tokens of `zscout acquire`: files and sockets in the user's runtime folder, and the words on these sockets.

A token is the name of a file, mode 0600, and of the socket beside it, at which the process listens that holds the
devices. Both lie in `$XDG_RUNTIME_DIR/zscout`, else `/run/user/UID/zscout`, else `/tmp/zscout-UID`: folders that only
the user can enter. When the hold has ended the file says how, for a day."""

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

MAX_WORD: Final = 60_000
"""Bytes of one word on a socket."""
KEPT_FOR: Final = 86_400.0
"""Seconds for which the file of a hold that has ended is kept."""
LONGEST_PATH: Final = 100
"""Characters of a socket's path; the system has 107."""
_TOKEN: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}-[0-9a-f]{12}")

T = TypeVar("T")


class TokenFile(msgspec.Struct, frozen=True):
    """What the file of a token has."""

    arc: str
    id: str
    client: str
    fleet: str
    rcs: list[str]
    pid: int
    ended: str = ""
    """Why the hold has ended; empty: it lasts, if the process does."""
    code: int = 0
    """The exit code of `zscout run` since then."""


class ToHolder(msgspec.Struct, frozen=True):
    """To the process that holds: `run` (with a descriptor, whose other end is closed once all of the command is gone),
    `gone`, `renew`, `release`."""

    op: str
    seconds: float = 0


class FromHolder(msgspec.Struct, frozen=True, omit_defaults=True):
    """From it: `hold` (a command may run), `until`, `notice` (what the hold yields to, in words), `end`, `done`,
    `refused`."""

    op: str
    env: dict[str, str] = {}
    grace: float = 0
    """Seconds, at most, from SIGTERM to SIGKILL."""
    at: Ns = 0
    """`hold`, `until`: when a command is to be ended unless a later time comes. `end`: when the hold ended."""
    why: str = ""
    code: int = 0
    withdrawn: bool = False
    """`notice`: True if its cause is gone."""
    remaining: float = 0
    """`done`, of `renew`: seconds for which the hold is protected."""


class TokenGranted(msgspec.Struct, frozen=True):
    """From the process that holds to the one that started it."""

    token: str
    text: str
    details: dict[str, Any]


class TokenChannel:
    """One connection, or socketpair, of words."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket = connection

    def send(self, word: msgspec.Struct, fds: Sequence[int] = ()) -> None:
        """A word that can't be sent is dropped: the other process has ended, or has not read for long."""
        with suppress(OSError):
            socket.send_fds(self._socket, [msgspec.json.encode(word)], fds)

    async def receive(self, kind: type[T]) -> tuple[T, list[int]] | None:
        """The next word, and descriptors that came with it. None: the other process has gone, or sent none."""
        while True:
            try:
                data, fds, _, _ = socket.recv_fds(self._socket, MAX_WORD, 1)
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
    """Wait until something, or the end, can be read from it."""
    loop = asyncio.get_running_loop()
    ready = asyncio.Event()
    loop.add_reader(fd, ready.set)
    try:
        await ready.wait()
    finally:
        loop.remove_reader(fd)


# Files


def folders() -> list[Path]:
    """The folders in which tokens may lie, the first being the one for new ones."""
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
    """The folder for new tokens, made if need be, without those that are a day old. Raises OSError."""
    for folder in folders():
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
        if _is_ours(folder):
            _sweep(folder)
            return folder
    raise PermissionError(f"{folders()[-1]} is not a folder of yours alone; remove it, or set $XDG_RUNTIME_DIR")


def _sweep(folder: Path) -> None:
    for path in folder.glob("*.json"):
        with suppress(OSError, ValueError, msgspec.DecodeError):
            old = time.time() - path.stat().st_mtime > KEPT_FOR
            if old and (read(path).ended or not _lives(path)):
                remove(path)


def find(token: str) -> Path | None:
    """The file of a token, or None where there is none of this user on this host."""
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


# Sockets


@contextmanager
def _reachable(path: Path) -> Iterator[str]:
    """A path of the socket that the system takes, however long its own is."""
    if len(str(path)) <= LONGEST_PATH:
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
    """A process of the same user, or None."""
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
    """A connection to the process that holds for the token; None: it has ended."""
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
