"""TCP ports for servers that are started next."""

from __future__ import annotations

import random
import socket
from contextlib import suppress
from pathlib import Path
from typing import Final

GIVEN_AWAY: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")
"""The ports that Linux gives to outgoing connections, and to servers that ask for any."""
LOWEST: Final = 10_000
HIGHEST: Final = 32_768
TRIES: Final = 100


def free_port(bind: str, *ports: int) -> int:
    """Return the first of these ports that is free on this IP address. 0 stands for any: a random port below those that
    the system assigns to connections, so that it stays free until the server starts. Raises OSError."""
    error = OSError("no port was given")
    for port in ports:
        for number in [port] if port else [*_any(), 0]:
            try:
                return _bound(bind, number)
            except OSError as refused:
                error = refused
    raise error


def _any() -> list[int]:
    highest = HIGHEST
    with suppress(OSError, ValueError, IndexError):
        highest = int(GIVEN_AWAY.read_text().split()[0])
    numbers = random.SystemRandom()
    return [numbers.randrange(LOWEST, highest) for _ in range(TRIES)] if highest > LOWEST else []


def _bound(bind: str, port: int) -> int:
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    with socket.create_server((bind, port), family=family) as server:
        return int(server.getsockname()[1])
