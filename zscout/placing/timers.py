"""What is to be looked at again, and when: one time for each key, the soonest found at once."""

from __future__ import annotations

import heapq
from typing import Final

from zscout.balancing.model import Ns

SLACK: Final = 64
"""Entries that are out of date and may lie about, beside as many as count."""

Key = tuple[str, str]
"""What it is about, and whom."""


class Timers:
    """Times on the caller's clock."""

    def __init__(self) -> None:
        self._at: dict[Key, Ns] = {}
        self._heap: list[tuple[Ns, Key]] = []

    def set(self, key: Key, at: Ns | None) -> None:
        """Replaces what was set for `key`; None: nothing is to come."""
        if at is None:
            self._at.pop(key, None)
        elif self._at.get(key) != at:
            self._at[key] = at
            heapq.heappush(self._heap, (at, key))
            if len(self._heap) > 2 * len(self._at) + SLACK:
                self._heap = [(when, one) for one, when in self._at.items()]
                heapq.heapify(self._heap)

    def due(self, now: Ns) -> list[Key]:
        """Whose time has come, soonest first; they are set no more."""
        found = []
        while self._heap and self._heap[0][0] <= now:
            at, key = heapq.heappop(self._heap)
            if self._at.get(key) == at:
                del self._at[key]
                found.append(key)
        return found

    def next(self) -> Ns | None:
        """The soonest time that is set."""
        while self._heap and self._at.get(self._heap[0][1]) != self._heap[0][0]:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else None
