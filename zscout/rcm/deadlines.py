"""Deadlines of a pure state machine: each is set with a value, and is due at the time that the caller passes in."""

from __future__ import annotations

import heapq
from itertools import count
from typing import Generic, TypeVar

from zscout.types import Ns

T = TypeVar("T")


class Deadlines(Generic[T]):
    """Nothing is cancelled: the caller ignores a due value that no longer matters."""

    def __init__(self) -> None:
        self._heap: list[tuple[Ns, int, T]] = []
        self._order = count()

    def set(self, at: Ns, value: T) -> None:
        heapq.heappush(self._heap, (at, next(self._order), value))

    def pop_due(self, now: Ns) -> T | None:
        return heapq.heappop(self._heap)[2] if self._heap and self._heap[0][0] <= now else None

    @property
    def next(self) -> Ns | None:
        return self._heap[0][0] if self._heap else None
