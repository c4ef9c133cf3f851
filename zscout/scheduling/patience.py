"""The patience of a fleet whose file sets none: a multiple of the mean minimum runtime of grants.

The mean is over the last grants of each owner. The owners with the shortest and the longest mean count with the mean of
the owner next to them; of two owners both count with the shorter mean. So no owner can raise the patience above what
the runtimes of others give."""

from __future__ import annotations

from typing import Final

from zscout.config.scheduling_policy import PATIENCE
from zscout.types import SECOND, Ns

PATIENCE_IN_RUNTIMES: Final = 28
"""See docs/scheduling/waiting.md."""
MAX_PATIENCE: Final[Ns] = 12 * 3_600 * SECOND
MAX_COUNTED_RUNTIME: Final[Ns] = 86_400 * SECOND
"""A longer minimum runtime counts as this."""
GRANTS_PER_OWNER: Final = 64
"""The latest grants of an owner that count."""
MAX_OWNERS: Final = 1_000
UPDATE_INTERVAL: Final[Ns] = 60 * SECOND


class RuntimeMean:
    def __init__(self) -> None:
        self._owners: dict[str, tuple[int, float]] = {}  # by owner, least recent first: grants that count, their mean
        self._previous: tuple[int, float] = 0, 0.0  # the same of the previous leader; its weight falls with each grant
        self._patience: Ns = PATIENCE
        self._next: Ns = 0  # the time of the next update

    def count(self, owner: str, min_runtime: Ns) -> None:
        grants, mean = self._owners.pop(owner, (0, 0.0))
        grants = min(grants + 1, GRANTS_PER_OWNER)
        self._owners[owner] = grants, mean + (min(min_runtime, MAX_COUNTED_RUNTIME) - mean) / grants
        if len(self._owners) > MAX_OWNERS:
            del self._owners[next(iter(self._owners))]
        self._previous = max(0, self._previous[0] - 1), self._previous[1]

    def restore(self, patience: Ns) -> None:
        """Continue from the patience that the previous leader published."""
        self._previous, self._next = (GRANTS_PER_OWNER, min(patience, MAX_PATIENCE) / PATIENCE_IN_RUNTIMES), 0

    def patience(self, now: Ns) -> Ns:
        """The patience of an ARC that is queued now, at most `UPDATE_INTERVAL` old."""
        if now >= self._next:
            self._patience, self._next = self._compute(), now + UPDATE_INTERVAL
        return self._patience

    def _compute(self) -> Ns:
        found = sorted((mean, grants) for grants, mean in self._owners.values())
        means = [mean for mean, _ in found]
        if len(found) > 1:
            means[0], means[-1] = means[min(1, len(means) - 2)], means[-2]
        counted = [*zip(means, (grants for _, grants in found), strict=True), (self._previous[1], self._previous[0])]
        grants = sum(count for _, count in counted)
        if not grants:
            return PATIENCE
        mean = sum(mean * count for mean, count in counted) / grants
        return max(PATIENCE, min(MAX_PATIENCE, round(PATIENCE_IN_RUNTIMES * mean)))
