"""Ports for what is told its port in a file, before it listens there."""

from __future__ import annotations

import random
import socket
from contextlib import suppress
from pathlib import Path


def free_port() -> int:
    """One that nobody has now, and that the system gives to nobody by itself: it lies below those it gives away."""
    first = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    while True:
        # Workers side by side take others: random numbers here have no secret.
        port = random.SystemRandom().randrange(10_000, first)
        with suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
