"""Deadlines of a pure state machine: set with a value, due by the time that is passed in."""

from __future__ import annotations

import heapq
from itertools import count
from typing import Generic, TypeVar

from zscout.types import Ns

T = TypeVar("T")


class Deadlines(Generic[T]):
    """A value whose reason is gone is ignored when it is due: nothing is cancelled."""

    def __init__(self) -> None:
        self._heap: list[tuple[Ns, int, T]] = []
        self._order = count()

    def set(self, at: Ns, value: T) -> None:
        heapq.heappush(self._heap, (at, next(self._order), value))

    def pop_due(self, now: Ns) -> T | None:
        """The next value that is due; None: none is."""
        return heapq.heappop(self._heap)[2] if self._heap and self._heap[0][0] <= now else None

    @property
    def next(self) -> Ns | None:
        return self._heap[0][0] if self._heap else None
