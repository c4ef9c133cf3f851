"""Other users of this machine: which user holds a name or port that is free for all users to take."""

from __future__ import annotations

import ipaddress
import os
import pwd
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeAlias

Address: TypeAlias = ipaddress.IPv4Address | ipaddress.IPv6Address
Uid: TypeAlias = int

ROOT: Final[Uid] = 0
TABLES: Final = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_LISTEN: Final = "0A"


def is_stranger(uid: Uid) -> bool:
    """Return True for a user that is neither root nor the user of this process."""
    return uid not in (ROOT, os.geteuid())


def user_name(uid: Uid) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def listeners(address: Address, port: int) -> Iterator[Uid]:
    """The users of this machine's sockets that listen at exactly this address. Raises OSError."""
    for table in TABLES:
        with suppress(FileNotFoundError):
            for line in table.read_text().splitlines()[1:]:
                fields = line.split()
                host, _, number = fields[1].partition(":")
                if fields[3] == _LISTEN and int(number, 16) == port and _address(host) == address:
                    yield int(fields[7])


def _address(text: str) -> Address:
    """From the kernel's notation: words of 32 bits in the byte order of this machine."""
    words = (bytes.fromhex(text[at : at + 8])[::-1] for at in range(0, len(text), 8))
    return ipaddress.ip_address(b"".join(words))
