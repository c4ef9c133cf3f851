"""Keeps two processes of one host from offering the same RC: both would hold its device."""

from __future__ import annotations

import errno
import hashlib
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from zscout.mesh import MeshError


@contextmanager
def only_here(fleet: str, host: str, rc: str) -> Iterator[None]:
    """Raises MeshError where another process of this machine offers `rc` of `fleet` for `host` already.

    A name of Linux's abstract sockets is the lock: unlike a file it goes with its process, however that ends, and
    nothing is left. Elsewhere only the tokens on the mesh keep two apart."""
    if sys.platform != "linux":
        yield
        return
    name = hashlib.sha256(f"{fleet} {host} {rc}".encode()).hexdigest()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as lock:
        try:
            lock.bind(f"\0zscout-rc-{name}")
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise MeshError(f"{rc}: another process on {host} serves it already; end that, or rename this") from None
        yield
