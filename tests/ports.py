"""Ports for servers that tests have others start."""

from __future__ import annotations

import random
import socket
from pathlib import Path
from typing import Final

LOWEST: Final = 10_000


def free_port() -> int:
    """A TCP port of this machine that nobody listens on. It is below those that the system gives away by itself, so
    no connection that is made meanwhile gets it; a random one, so no test beside this one takes the same."""
    given_away = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    numbers = random.SystemRandom()
    while True:
        port = numbers.randrange(LOWEST, given_away)
        with socket.socket() as one:
            try:
                one.bind(("127.0.0.1", port))
            except OSError:
                continue
        return port
