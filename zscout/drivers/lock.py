"""Prevents two processes of a host from offering the same RC, which would use its device twice.

There are two locks, both released with their process. A locked file in the state folder, where other users can't write,
excludes processes with the same folder. A name of Linux's abstract sockets excludes those with other folders, also
root's; any user can take such a name first, so only root and this user are believed."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import logging
import os
import socket
import struct
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from zscout.config.local_users import Uid, is_stranger, user_name
from zscout.mesh import MeshError

log = logging.getLogger(__name__)

_CREDENTIALS: Final = struct.Struct("3i")
BACKLOG: Final = 4_096
"""Processes that may connect to a holder to learn its user; no connection is ever accepted."""


class LockHolder(NamedTuple):
    pid: int
    uid: Uid

    def __str__(self) -> str:
        return f"process {self.pid} of user {user_name(self.uid)}"


@contextmanager
def only_here(fleet: str, host: str, rc: str, folder: Path | None = None) -> Iterator[None]:
    """Raises MeshError if another process of this user or root offers `rc` of `fleet` for `host`."""
    with ExitStack() as stack:
        if folder is not None:
            stack.enter_context(_file(folder / "served" / rc, host, rc))
        if sys.platform == "linux":
            name = hashlib.sha256(f"{fleet} {host} {rc}".encode()).hexdigest()
            try:
                stack.enter_context(_name(f"\0zscout-rc-{name}", rc))
            except InUse as used:
                raise _served(host, rc, used.holder) from None
        yield


class InUse(Exception):
    """Another device has a port already. The message follows the port's name."""

    def __init__(self, holder: LockHolder) -> None:
        here = holder.pid == os.getpid()
        super().__init__(f"is used by {'another device of this node' if here else holder}")
        self.holder = holder


@contextmanager
def port_lock(names: Iterable[str]) -> Iterator[None]:
    """Raises InUse if another device of this machine, in a process of this user or root, has one of these ports."""
    with ExitStack() as stack:
        for name in sorted(set(names)) if sys.platform == "linux" else ():
            stack.enter_context(_name(f"\0zscout-port-{hashlib.sha256(name.encode()).hexdigest()}", name))
        yield


@contextmanager
def _file(path: Path, host: str, rc: str) -> Iterator[None]:
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        opened = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError as error:
        log.warning("can't open %s (%s): no lock in the state folder", path, error.strerror)
        yield
        return
    try:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _served(host, rc, None) from None
        yield
    finally:
        os.close(opened)


@contextmanager
def _name(name: str, what: str) -> Iterator[None]:
    """Take an abstract name as the lock of `what`. Raises InUse if a process of this user or root has it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as lock:
        try:
            lock.bind(name)
            lock.listen(BACKLOG)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            holder = _holder(name)
            if holder is not None and not is_stranger(holder.uid):
                raise InUse(holder) from None
            other = holder or "an unknown process"
            log.warning("%s: its lock is held by %s, which is not trusted; serving it anyway", what, other)
        yield


def _holder(name: str) -> LockHolder | None:
    """The process that listens under an abstract name; None if there is none or it does not accept connections."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(name)
        except OSError:
            return None
        pid, uid, _ = _CREDENTIALS.unpack(asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
        return LockHolder(pid, uid)


def _served(host: str, rc: str, holder: LockHolder | None) -> MeshError:
    by = f" ({holder})" if holder is not None else ""
    return MeshError(f"{rc}: another process on {host} serves it already{by}; end that process, or rename this RC")
