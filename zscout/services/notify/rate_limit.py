"""The rate of notifications to one URL. Pure: time is passed in."""

from __future__ import annotations

from typing import Final

from zscout.types import SECOND, Ns

MINUTE: Final[Ns] = 60 * SECOND


class RateLimit:
    """A token bucket for `per_minute` notifications, refilled evenly at that rate."""

    def __init__(self, per_minute: int) -> None:
        self._most = per_minute * MINUTE
        self._gain = per_minute
        self._level, self._at = self._most, 0

    def allows(self, now: Ns) -> bool:
        self._level = min(self._most, self._level + (now - self._at) * self._gain)
        self._at = now
        if self._level < MINUTE:
            return False
        self._level -= MINUTE
        return True
