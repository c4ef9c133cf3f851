"""Checks of a recorder's answer, before `zscout view` shows its recording: only a recorder of this host counts.

Any sender may name a file and an address. Both must exist here, and belong to one local user or to root."""

from __future__ import annotations

import fcntl
import ipaddress
import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import Final

from zscout.config.local_users import ROOT, listeners
from zscout.messages import Recorded

MAGIC: Final = b"RRF"
"""The first bytes of every recording."""


def local_address(recorded: Recorded, bind: str) -> str | None:
    """The address of the live view, if this host serves it and a page on `bind` can show it; else None."""
    try:
        served = ipaddress.ip_address(recorded.bind)
        if not (served.is_unspecified or str(served) == bind or ipaddress.ip_address(bind).is_loopback):
            return None
        owner = _owner(recorded)
        if owner is None or not {owner, ROOT} & {*listeners(served, recorded.port)}:
            return None
    except (OSError, ValueError):
        return None
    return bind if served.is_unspecified else str(served)


def _owner(recorded: Recorded) -> int | None:
    """The owner's user id of a regular file that a recorder of this host writes now. Raises OSError, ValueError."""
    path = Path(recorded.file)
    if path.suffix != ".rrd" or not path.is_absolute():
        return None
    # Don't follow a link, and don't block on a pipe.
    opened = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        found = os.fstat(opened)
        if not stat.S_ISREG(found.st_mode) or found.st_ino != recorded.inode or os.read(opened, len(MAGIC)) != MAGIC:
            return None
        with suppress(BlockingIOError):
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return None  # no recorder has locked it
        return found.st_uid
    finally:
        os.close(opened)
