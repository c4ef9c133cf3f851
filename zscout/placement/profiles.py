"""What is learnt from how components run: the profiles of their kinds, and which metric to trust.

Metric `auto` (the paper's open question: which figures predict how well a component runs) keeps each
placement with every metric's score of the chosen host, and, once the component has run for a while, with how
well it ran. The metric whose scores agree best with that, by Spearman's rank correlation over the latest
placements, is used for the next. One placement in ten is made by the metrics in turn: a bad host that is
never tried is never known to be one.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from random import Random
from statistics import StatisticsError, correlation
from typing import Final, NamedTuple

from zscout.messages import ComponentUse
from zscout.placement.model import SCORES, Profile
from zscout.types import Metric

CHOICES: Final[tuple[Metric, ...]] = tuple(SCORES)
REMEMBERED: Final = 200
"""Placements that are learnt from: the latest."""
ENOUGH: Final = 12
"""Placements before any metric is trusted."""
EXPLORE: Final = 0.1
DEFAULT: Final[Metric] = "composite"
AHEAD: Final = 0.02
"""By how much another metric has to agree better than `DEFAULT`."""
LEAST_SERVED: Final = 0.05
"""A smaller share does not show what a component wants."""
LEARN: Final = 0.2
"""Weight of the latest figure in a profile."""


def learn_profile(known: Profile | None, use: ComponentUse, speed: float) -> Profile:
    """A profile with one sample more; memory is the most that was seen, forgotten slowly."""
    # What it wanted, not what a busy host gave it.
    wanted = use.cpu / max(use.served, LEAST_SERVED) if use.served is not None else use.cpu
    threads = max(1, math.ceil(round(wanted, 1)))
    if known is None:
        return Profile(wanted * speed, use.memory, 1, threads)
    return Profile(
        cpu=known.cpu + LEARN * (wanted * speed - known.cpu),
        memory=max(use.memory, round(known.memory + LEARN / 10 * (use.memory - known.memory))),
        samples=known.samples + 1,
        threads=max(known.threads, threads),
    )


class Observation(NamedTuple):
    """The metrics' scores of a host, and how fast a component then ran there (`model.rate`)."""

    scores: Mapping[Metric, float]
    rate: float


class MetricLearner:
    """Chooses the metric for `auto`."""

    def __init__(self) -> None:
        self.seen: deque[Observation] = deque(maxlen=REMEMBERED)
        self._turn = 0

    def add(self, observation: Observation) -> None:
        self.seen.append(observation)

    def agreement(self) -> dict[Metric, float]:
        """How well each metric's scores agree with how components ran: 1 is best, 0 is not at all."""
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
        """The metric that agrees best, and why."""
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
    try:
        return correlation(_ranks(one), _ranks(other))
    except StatisticsError:
        return 0.0


def _ranks(values: Sequence[float]) -> list[float]:
    ordered = sorted(values)
    return [float(bisect_left(ordered, value) + bisect_right(ordered, value)) for value in values]
