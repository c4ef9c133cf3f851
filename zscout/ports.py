"""Free TCP ports for servers."""

from __future__ import annotations

import random
import socket
from contextlib import suppress
from pathlib import Path
from typing import Final

EPHEMERAL_PORTS: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")
"""The ports that Linux assigns to outgoing connections, and to servers that ask for any port."""
LOWEST: Final = 10_000
HIGHEST: Final = 32_768
TRIES: Final = 100


def free_port(bind: str, *ports: int) -> int:
    """The first free port among `ports` on this IP address. 0 is any: a random port below the system's ephemeral ports,
    which no connection takes before the server starts. Raises OSError."""
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
        highest = int(EPHEMERAL_PORTS.read_text().split()[0])
    numbers = random.SystemRandom()
    return [numbers.randrange(LOWEST, highest) for _ in range(TRIES)] if highest > LOWEST else []


def _bound(bind: str, port: int) -> int:
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    with socket.create_server((bind, port), family=family) as server:
        return int(server.getsockname()[1])
