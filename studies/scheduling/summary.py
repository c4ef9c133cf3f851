"""The summary of many trials: a line for each family and strategy, and when and how much the heuristic loses."""

from __future__ import annotations

import statistics
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from studies.scheduling.families import FAMILIES
from studies.scheduling.foretell import Rule, correlations, fit
from studies.scheduling.measures import Curve, Measures, percentile
from studies.scheduling.situations import FEATURES, Situation
from studies.scheduling.trial import JUDGED, SchedulingTrial
from zscout.types import SECOND

MAX_FORETOLD: Final = 300_000
"""Most situations that are kept with their features. Later situations are only counted."""
MICROSECOND: Final = 1000


@dataclass(frozen=True, slots=True)
class Decisions:
    """Durations of passes in microseconds: the only figures that differ from run to run."""

    median: float
    p99: float
    longest: float
    first_median: float
    """Median of the first pass of each run. In families that ask at once it is the paper's experiment."""
    first_p99: float


@dataclass(frozen=True, slots=True)
class StrategyReport:
    """One strategy on one family. Waits in seconds: mean, p99 and longest of all ARCs of all seeds."""

    strategy: str
    in_use: float
    first: float
    wait_mean: float
    wait_p99: float
    wait_longest: float
    wait_longest_mean: float
    """Mean of the seeds' longest waits."""
    unserved: int
    preemptions: float
    """Mean per run."""
    thrown_away: float
    end: float
    """Mean end of a run's last hold, in seconds."""
    decision_us: Decisions


@dataclass(frozen=True, slots=True)
class Degeneracy:
    """How often the heuristic is behind the best set in the same situation, and how far. Ratios: pairs in use divided
    by pairs in the best set; `first` ratios are from each run's first situation."""

    situations: int
    behind: int
    ratio_mean: float
    ratio_behind: float | None
    """Mean where it is behind."""
    ratio_worst: float
    first_mean: float
    first_worst: float


@dataclass(frozen=True, slots=True)
class FamilyReport:
    family: str
    summary: str
    strategies: tuple[StrategyReport, ...]
    degenerate: Degeneracy | None
    """None if the heuristic was not among the strategies, or if no request ever waited."""


@dataclass(frozen=True, slots=True)
class SchedulingReport:
    seeds: tuple[int, ...]
    families: tuple[FamilyReport, ...]
    correlations: dict[str, float | None]
    rule: Rule | None


@dataclass(slots=True)
class _Runs:
    """Collected trials of one family and strategy."""

    measures: list[Measures] = field(default_factory=list)
    """Without waits, which are in `waits`."""
    waits: array[int] = field(default_factory=lambda: array("q"))
    longest: array[int] = field(default_factory=lambda: array("q"))
    decisions: array[int] = field(default_factory=lambda: array("q"))
    firsts: array[int] = field(default_factory=lambda: array("q"))


@dataclass(slots=True)
class _Found:
    """Collected situations of one family."""

    ratios: array[float] = field(default_factory=lambda: array("d"))
    behind: array[int] = field(default_factory=lambda: array("b"))
    firsts: array[float] = field(default_factory=lambda: array("d"))


class Study:
    """Collects trials in the order of their jobs, because sums of floats depend on the order."""

    def __init__(self, families: Sequence[str], strategies: Sequence[str], seeds: Sequence[int]) -> None:
        self.families, self.strategies, self.seeds = families, strategies, seeds
        self.curves: dict[tuple[str, str], Curve] = {}
        """Curves of drawn trials, by family and strategy."""
        self._runs = {(family, strategy): _Runs() for family in families for strategy in strategies}
        self._found = {family: _Found() for family in families}
        self._features = array("d")
        self._behind = array("b")
        self._fitted = array("b")

    def add(self, trial: SchedulingTrial) -> None:
        job = trial.job
        runs = self._runs[job.family, job.strategy]
        runs.measures.append(replace(trial.measures, waits=()))
        runs.waits.extend(trial.measures.waits)
        runs.longest.append(max(trial.measures.waits, default=0))
        runs.decisions.extend(trial.decisions)
        runs.firsts.extend(trial.decisions[:1])
        if trial.curve is not None:
            self.curves[job.family, job.strategy] = trial.curve
        self._judge(job.family, job.seed, trial.situations)

    def _judge(self, family: str, seed: int, situations: Sequence[Situation]) -> None:
        found = self._found[family]
        found.ratios.extend(situation.ratio for situation in situations)
        found.behind.extend(situation.behind for situation in situations)
        found.firsts.extend(situation.ratio for situation in situations[:1])
        for situation in situations[: MAX_FORETOLD - len(self._behind)]:
            self._features.extend(situation.features)
            self._behind.append(situation.behind)
            self._fitted.append(seed % 2 == 0)

    def report(self) -> SchedulingReport:
        features = np.array(self._features).reshape(-1, len(FEATURES))
        behind = np.array(self._behind, dtype=bool)
        fitted = np.array(self._fitted, dtype=bool)
        return SchedulingReport(
            seeds=tuple(self.seeds),
            families=tuple(self._family(family) for family in self.families),
            correlations=correlations(features, behind) if JUDGED in self.strategies else {},
            rule=fit(features, behind, fitted),
        )

    def _family(self, family: str) -> FamilyReport:
        reports = tuple(_strategy(name, self._runs[family, name]) for name in self.strategies)
        return FamilyReport(family, FAMILIES[family].summary, reports, _degeneracy(self._found[family]))


def _strategy(name: str, runs: _Runs) -> StrategyReport:
    measures = runs.measures
    return StrategyReport(
        strategy=name,
        in_use=statistics.fmean(measured.in_use for measured in measures),
        first=statistics.fmean(measured.first for measured in measures),
        wait_mean=statistics.fmean(runs.waits) / SECOND if runs.waits else 0.0,
        wait_p99=percentile(runs.waits, 0.99) / SECOND,
        wait_longest=max(runs.longest) / SECOND,
        wait_longest_mean=statistics.fmean(runs.longest) / SECOND,
        unserved=sum(measured.unserved for measured in measures),
        preemptions=statistics.fmean(measured.preemptions for measured in measures),
        thrown_away=statistics.fmean(measured.thrown_away for measured in measures),
        end=statistics.fmean(measured.end for measured in measures) / SECOND,
        decision_us=Decisions(
            median=percentile(runs.decisions, 0.5) / MICROSECOND,
            p99=percentile(runs.decisions, 0.99) / MICROSECOND,
            longest=max(runs.decisions, default=0) / MICROSECOND,
            first_median=percentile(runs.firsts, 0.5) / MICROSECOND,
            first_p99=percentile(runs.firsts, 0.99) / MICROSECOND,
        ),
    )


def _degeneracy(found: _Found) -> Degeneracy | None:
    if not found.ratios:
        return None
    lost = [ratio for ratio, behind in zip(found.ratios, found.behind, strict=True) if behind]
    return Degeneracy(
        situations=len(found.ratios),
        behind=len(lost),
        ratio_mean=statistics.fmean(found.ratios),
        ratio_behind=statistics.fmean(lost) if lost else None,
        ratio_worst=min(found.ratios),
        first_mean=statistics.fmean(found.firsts),
        first_worst=min(found.firsts),
    )
