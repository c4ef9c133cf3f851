"""Notices when this process stood still: stopped, suspended, or starved. One watch per process."""

from __future__ import annotations

import asyncio
import logging
from typing import Self

from zscout import clock
from zscout.scheduling.model import SECOND, Ns

log = logging.getLogger(__name__)

PERIOD = 0.2
"""Seconds between two looks at the clock."""
THRESHOLD = SECOND // 5
"""A look that comes this much too late means a stall."""
AFTERMATH = SECOND // 4
"""What comes out of the network this soon after a stall may have waited through it."""


class StallWatch:
    """Knows the last stall of this process: how long it was, and when it ended."""

    def __init__(self) -> None:
        self.length: Ns = 0
        self.ended: Ns = 0
        self._last = clock.now()
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> Self:
        self._last = clock.now()
        self._timer = asyncio.get_running_loop().call_later(PERIOD, self._beat)
        return self

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def look(self) -> None:
        """Takes notice of a stall that has just ended."""
        now = clock.now()
        gap = now - self._last - round(PERIOD * SECOND)
        if gap > THRESHOLD:
            self.length, self.ended = gap, now
            log.warning("this process stood still for %.2f s", gap / SECOND)
        self._last = now

    def waited_through(self, arrived: Ns) -> Ns:
        """How long something may have waited in the network that came out of it at `arrived`."""
        self.look()
        return self.length if self.length and arrived <= self.ended + AFTERMATH else 0

    def fresh(self) -> bool:
        """Whether a stall ended so lately that what was said meanwhile may not have been read yet."""
        self.look()
        return bool(self.length) and clock.now() - self.ended <= AFTERMATH

    def _beat(self) -> None:
        self.look()
        self._timer = asyncio.get_running_loop().call_later(PERIOD, self._beat)
