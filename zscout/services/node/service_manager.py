"""Notifies the service manager: systemd's `sd_notify`, one datagram to a socket.

Watchdog messages come from the event loop, so that a node with a blocked loop is restarted."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from collections.abc import MutableMapping
from typing import Final, Self

from zscout.types import clean

log = logging.getLogger(__name__)

BEATS: Final = 3  # messages per watchdog interval
LONGEST: Final = 0.1  # seconds that the event loop waits for a service manager that does not read


class ServiceManager:
    """Without `address` nothing is sent. `watchdog` is in seconds; 0: none."""

    def __init__(self, address: str = "", watchdog: float = 0.0) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._every = watchdog / BEATS
        self._beat: asyncio.TimerHandle | None = None
        self._deaf = False

    @classmethod
    def from_env(cls, env: MutableMapping[str, str] = os.environ) -> Self:
        """From systemd's variables, removed from `env` for the sake of child processes."""
        address = env.pop("NOTIFY_SOCKET", "")
        within, pid = env.pop("WATCHDOG_USEC", ""), env.pop("WATCHDOG_PID", "")
        for_us = within.isdecimal() and pid in ("", str(os.getpid()))
        return cls(address, int(within) / 1e6 if for_us else 0.0)

    def ready(self, status: str) -> None:
        """Report that the service runs, or has finished reloading. The first call starts the watchdog messages."""
        self._notify("READY=1", status)
        if self._beat is None and self._every:
            self._beat = asyncio.get_running_loop().call_later(self._every, self._live)

    def reloading(self) -> None:
        """Report that the service reads its files again; `ready` ends that."""
        now = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1_000
        self._notify(f"RELOADING=1\nMONOTONIC_USEC={now}", "reloading its files")

    def stopping(self, status: str) -> None:
        """Report that the service stops, and end the watchdog messages."""
        if self._beat is not None:
            self._beat.cancel()
        self._notify("STOPPING=1", status)

    def _live(self) -> None:
        self._notify("WATCHDOG=1")
        self._beat = asyncio.get_running_loop().call_later(self._every, self._live)

    def _notify(self, word: str, status: str = "") -> None:
        if not self._address:
            return
        lines = f"{word}\nSTATUS={' '.join(clean(status).split())}" if status else word
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as speaking:
                speaking.settimeout(LONGEST)
                speaking.sendto(lines.encode(), self._address)
            self._deaf = False
        except OSError as error:
            if not self._deaf:
                log.warning("can't send %s to the service manager: %s", word.splitlines()[0], error)
            self._deaf = True
