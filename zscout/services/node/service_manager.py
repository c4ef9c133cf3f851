"""What a node tells the service manager that started it: systemd's `sd_notify`, which is one datagram to a socket.

The watchdog's word comes from the event loop, so that a node whose loop stands still is silent, and is started anew."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from collections.abc import MutableMapping
from typing import Final, Self

log = logging.getLogger(__name__)

BEATS: Final = 3
"""Words within the time after which a service that is silent is ended."""
LONGEST: Final = 0.1
"""Seconds that the event loop waits for a service manager that does not read."""


class ServiceManager:
    """Without `address` nobody is told anything. `watchdog` is in seconds; 0: nobody waits for a word."""

    def __init__(self, address: str = "", watchdog: float = 0.0) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._every = watchdog / BEATS
        self._beat: asyncio.TimerHandle | None = None
        self._deaf = False

    @classmethod
    def from_env(cls, env: MutableMapping[str, str] = os.environ) -> Self:
        """As systemd tells its services. Takes it out of `env`: what this process starts has nothing to say there."""
        address = env.get("NOTIFY_SOCKET", "")
        within, pid = env.pop("WATCHDOG_USEC", ""), env.pop("WATCHDOG_PID", "")
        for_us = within.isdecimal() and pid in ("", str(os.getpid()))
        return cls(address, int(within) / 1e6 if for_us else 0.0)

    def ready(self, status: str) -> None:
        """The service runs, or has done what `reloading` began. From the first time on the watchdog hears of it."""
        self._tell("READY=1", status)
        if self._beat is None and self._every:
            self._beat = asyncio.get_running_loop().call_later(self._every, self._live)

    def reloading(self) -> None:
        """Its files are read again; `ready` ends that."""
        now = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1_000
        self._tell(f"RELOADING=1\nMONOTONIC_USEC={now}", "reads its files again")

    def stopping(self, status: str) -> None:
        """The service ends, which is not for the watchdog to hear."""
        if self._beat is not None:
            self._beat.cancel()
        self._tell("STOPPING=1", status)

    def _live(self) -> None:
        self._tell("WATCHDOG=1")
        self._beat = asyncio.get_running_loop().call_later(self._every, self._live)

    def _tell(self, word: str, status: str = "") -> None:
        if not self._address:
            return
        lines = f"{word}\nSTATUS={' '.join(status.split())}" if status else word
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as speaking:
                speaking.settimeout(LONGEST)
                speaking.sendto(lines.encode(), self._address)
            self._deaf = False
        except OSError as error:
            if not self._deaf:
                log.warning("the service manager is not told %s: %s", word.splitlines()[0], error)
            self._deaf = True
