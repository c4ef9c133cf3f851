"""The patience of a fleet whose file names none: so many mean minimum runtimes, as they are granted.

The mean is over the last grants of each owner. The owners with the shortest and the longest count as if their means
were those of the next, and of two the longer as the shorter: so none makes others wait longer than they make each
other."""

from __future__ import annotations

from typing import Final

from zscout.config.scheduling_policy import PATIENCE
from zscout.types import SECOND, Ns

RUNTIMES: Final = 28
"""Measured: docs/scheduling.md."""
MOST: Final[Ns] = 12 * 3_600 * SECOND
LONGEST: Final[Ns] = 86_400 * SECOND
"""A longer minimum runtime counts as this."""
KEPT: Final = 64
"""Grants of one owner that count."""
MAX_OWNERS: Final = 1_000
EVERY: Final[Ns] = 60 * SECOND


class RuntimeMean:
    def __init__(self) -> None:
        self._owners: dict[str, tuple[int, float]] = {}  # by owner, least recent first: grants that count, their mean
        self._before: tuple[int, float] = 0, 0.0  # the same of the leader before, fading
        self._known: Ns = PATIENCE
        self._next: Ns = 0  # when it is reckoned anew

    def count(self, owner: str, min_runtime: Ns) -> None:
        """Count a grant."""
        grants, mean = self._owners.pop(owner, (0, 0.0))
        grants = min(grants + 1, KEPT)
        self._owners[owner] = grants, mean + (min(min_runtime, LONGEST) - mean) / grants
        if len(self._owners) > MAX_OWNERS:
            del self._owners[next(iter(self._owners))]
        self._before = max(0, self._before[0] - 1), self._before[1]

    def restore(self, patience: Ns) -> None:
        """Go on from what the leader before published."""
        self._before, self._next = (KEPT, min(patience, MOST) / RUNTIMES), 0

    def patience(self, now: Ns) -> Ns:
        """Of an ARC that is queued now; it is reckoned once in a while."""
        if now >= self._next:
            self._known, self._next = self._reckoned(), now + EVERY
        return self._known

    def _reckoned(self) -> Ns:
        found = sorted((mean, grants) for grants, mean in self._owners.values())
        means = [mean for mean, _ in found]
        if len(found) > 1:
            means[0], means[-1] = means[min(1, len(means) - 2)], means[-2]
        counted = [*zip(means, (grants for _, grants in found), strict=True), (self._before[1], self._before[0])]
        grants = sum(count for _, count in counted)
        if not grants:
            return PATIENCE
        mean = sum(mean * count for mean, count in counted) / grants
        return max(PATIENCE, min(MOST, round(RUNTIMES * mean)))
