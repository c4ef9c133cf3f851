"""Metric `auto`: which figures foretell how well a component then runs (the paper's open question).

Each placement is remembered with what every metric made of the host that was chosen, and, once the component
has run for a while, with how well it ran. The metric whose scores agree best with that, by Spearman's rank
correlation over the latest placements, is used for the next. One placement in ten is made by the metrics in
turn: who never tries a bad host does not learn that it is one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

from zscout.balancing.metrics import SCORES
from zscout.balancing.model import Metric

CHOICES: Final[tuple[Metric, ...]] = tuple(SCORES)
REMEMBERED: Final = 200
"""Placements that are learnt from: the latest."""
ENOUGH: Final = 12
"""Placements before any metric is believed."""
EXPLORE: Final = 0.1
DEFAULT: Final[Metric] = "composite"
AHEAD: Final = 0.02
"""By how much another metric has to agree better with what was seen than `DEFAULT`."""


@dataclass(frozen=True, slots=True)
class Observation:
    """What the metrics said of a host, and how fast a component then ran there (`metrics.rate`)."""

    scores: Mapping[Metric, float]
    rate: float


class Learner:
    """Remembers placements and says which metric to believe."""

    def __init__(self) -> None:
        self.seen: deque[Observation] = deque(maxlen=REMEMBERED)
        self._turn = 0

    def saw(self, observation: Observation) -> None:
        self.seen.append(observation)

    def agreement(self) -> dict[Metric, float]:
        """Of each metric, how well its scores agree with how components ran: 1 is best, 0 is not at all."""
        rates = [one.rate for one in self.seen]
        return {metric: spearman([one.scores[metric] for one in self.seen], rates) for metric in CHOICES}

    def choose(self, rng: Random) -> tuple[Metric, str]:
        """The metric for the next placement, and why."""
        if rng.random() < EXPLORE:
            metric = CHOICES[self._turn % len(CHOICES)]
            self._turn += 1
            return metric, f"tried in turn, to learn: {len(self.seen)} placements seen"
        return self.judge()

    def judge(self) -> tuple[Metric, str]:
        """The metric that what was seen speaks for, and how."""
        if len(self.seen) < ENOUGH:
            return DEFAULT, f"the default: {len(self.seen)} placements seen, {ENOUGH} tell enough"
        found = self.agreement()
        best = max(CHOICES, key=lambda metric: found[metric] + AHEAD * (metric == DEFAULT))
        others = ", ".join(f"{metric} {found[metric]:.2f}" for metric in CHOICES if metric != best)
        return best, (
            f"{best} agrees best with how {len(self.seen)} components ran: {found[best]:.2f} ({others})"
        )


def spearman(one: Sequence[float], other: Sequence[float]) -> float:
    """Rank correlation, ties shared, from -1 to 1; 0 where either does not vary."""
    if len(one) < 2:
        return 0.0
    return _pearson(_ranks(one), _ranks(other))


def _ranks(values: Sequence[float]) -> list[float]:
    order = sorted(range(len(values)), key=values.__getitem__)
    ranks = [0.0] * len(values)
    start = 0
    while start < len(order):
        end = start
        while end + 1 < len(order) and values[order[end + 1]] == values[order[start]]:
            end += 1
        for at in order[start : end + 1]:
            ranks[at] = (start + end) / 2
        start = end + 1
    return ranks


def _pearson(one: Sequence[float], other: Sequence[float]) -> float:
    mean, mean_other = sum(one) / len(one), sum(other) / len(other)
    both = sum((a - mean) * (b - mean_other) for a, b in zip(one, other, strict=True))
    spread = sum((a - mean) ** 2 for a in one) * sum((b - mean_other) ** 2 for b in other)
    return float(both / spread**0.5) if spread > 0 else 0.0
