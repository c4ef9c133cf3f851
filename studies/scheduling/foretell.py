"""Can a cheap rule predict that the heuristic will be behind? Plain statistics, checked on other data than fitted.

Each feature's correlation with "behind" (Pearson's; "behind" counts 0 or 1), and the best rule of one or two
thresholds. A rule is chosen on one half of the situations by balanced accuracy: the mean of its hit rates where the
heuristic is behind and where it is not, so that "never" does not win. Its hit rate is counted on the other half, and
compared with the rate of always giving the commoner answer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from studies.scheduling.situations import FEATURES

Matrix: TypeAlias = npt.NDArray[np.float64]
Flags: TypeAlias = npt.NDArray[np.bool_]

THRESHOLDS: Final = 39
"""Number of thresholds tried for each feature: its quantiles."""
FEWEST: Final = 20
"""Situations of each kind, in each half, below which no rule is fitted."""
GAIN: Final = 0.01
"""Least gain of a second condition on the fitted half."""


@dataclass(frozen=True, slots=True)
class Condition:
    """`feature` is at least `bound`, or below it."""

    feature: str
    at_least: bool
    bound: float

    def holds(self, features: Matrix) -> Flags:
        column = features[:, FEATURES.index(self.feature)]
        met: Flags = column >= self.bound if self.at_least else column < self.bound
        return met

    def __str__(self) -> str:
        return f"{self.feature} {'>=' if self.at_least else '<'} {self.bound:.3g}"


@dataclass(frozen=True, slots=True)
class Rule:
    """Predicts that the heuristic is behind if all conditions hold. The figures are from the half not used to fit."""

    conditions: tuple[Condition, ...]
    situations: int
    hit_rate: float
    """Share of the situations in which the rule is right."""
    base_rate: float
    """Hit rate of always giving the commoner answer."""
    named: float
    """Share of the situations that the rule names, in which a search would be made."""
    found: float
    """Share of named situations among those where the heuristic is behind."""
    precision: float
    """Share of situations where the heuristic is behind among those named."""

    def __str__(self) -> str:
        return " and ".join(map(str, self.conditions))


def correlations(features: Matrix, behind: Flags) -> dict[str, float | None]:
    """The correlation by feature; None if a column is constant. `features` has a row for each situation."""
    found: dict[str, float | None] = {}
    for name, column in zip(FEATURES, features.T, strict=True):
        varies = len(column) > 1 and column.std() > 0 and behind.any() and not behind.all()
        found[name] = float(np.corrcoef(column, behind)[0, 1]) if varies else None
    return found


def fit(features: Matrix, behind: Flags, fitted: Flags) -> Rule | None:
    """The best rule on the rows marked in `fitted`, judged on the others. None if there are too few rows."""
    known, truth = features[fitted], behind[fitted]
    others, outcome = features[~fitted], behind[~fitted]
    kinds = (truth.sum(), (~truth).sum(), outcome.sum(), (~outcome).sum())
    if min(kinds) < FEWEST:
        return None
    conditions = list(_conditions(known))
    if not conditions:
        return None
    best, foretold = max(
        ((condition, condition.holds(known)) for condition in conditions), key=lambda pair: _score(pair[1], truth)
    )
    chosen = [best]
    second = max(conditions, key=lambda condition: _score(foretold & condition.holds(known), truth))
    if _score(foretold & second.holds(known), truth) > _score(foretold, truth) + GAIN:
        chosen.append(second)
    foretold_there = np.logical_and.reduce([condition.holds(others) for condition in chosen])
    return Rule(
        conditions=tuple(chosen),
        situations=len(outcome),
        hit_rate=float((foretold_there == outcome).mean()),
        base_rate=float(max(outcome.mean(), 1 - outcome.mean())),
        named=float(foretold_there.mean()),
        found=float(foretold_there[outcome].mean()),
        precision=float(outcome[foretold_there].mean()) if foretold_there.any() else 0.0,
    )


def _conditions(features: Matrix) -> Iterator[Condition]:
    shares = np.linspace(0, 1, THRESHOLDS + 2)[1:-1]
    for name, column in zip(FEATURES, features.T, strict=True):
        for bound in np.unique(np.quantile(column, shares, method="higher")):
            yield Condition(name, True, float(bound))
            yield Condition(name, False, float(bound))


def _score(foretold: Flags, truth: Flags) -> float:
    return float((foretold[truth].mean() + (~foretold)[~truth].mean()) / 2)
