"""Detects that this process stood still: stopped, suspended, or starved. One watch per process."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Self

from zscout.mesh import clock
from zscout.types import SECOND, Ns

log = logging.getLogger(__name__)

PERIOD = 0.2
"""Seconds between two readings of the clock."""
THRESHOLD = SECOND // 5
"""A reading that comes this much too late means a stall."""
AFTERMATH = SECOND // 4
"""What comes out of the network this soon after a stall may have waited through it."""


class StallWatch:
    """The last stall of this process, on the clock `now`: how long it was, and when it ended."""

    def __init__(self, now: Callable[[], Ns] = clock.now) -> None:
        self.length: Ns = 0
        self.ended: Ns = 0
        self._now = now
        self._last = now()
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> Self:
        self._last = self._now()
        self._timer = asyncio.get_running_loop().call_later(PERIOD, self._beat)
        return self

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def check(self) -> None:
        """Records a stall that has just ended."""
        now = self._now()
        gap = now - self._last - round(PERIOD * SECOND)
        if gap > THRESHOLD:
            self.length, self.ended = gap, now
            log.warning("this process stood still for %.2f s", gap / SECOND)
        self._last = now

    def waited_through(self, arrived: Ns) -> Ns:
        """How long something may have waited in the network that came out of it at `arrived`."""
        self.check()
        return self.length if self.length and arrived <= self.ended + AFTERMATH else 0

    def fresh(self) -> bool:
        """Whether a stall ended so lately that what came meanwhile may not have been handled yet."""
        self.check()
        return bool(self.length) and self._now() - self.ended <= AFTERMATH

    def _beat(self) -> None:
        self.check()
        self._timer = asyncio.get_running_loop().call_later(PERIOD, self._beat)
