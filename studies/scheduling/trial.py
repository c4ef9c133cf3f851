"""One trial: one workload under one strategy."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from studies.scheduling.families import FAMILIES
from studies.scheduling.measures import Curve, Measures, curve, measure
from studies.scheduling.situations import Observer, Situation
from zscout.scheduling import strategies
from zscout.scheduling.state import Actions, SchedulerState, Strategy
from zscout.simulation.replay import replay
from zscout.simulation.workload import Workload
from zscout.types import Ns

STRATEGIES: Final[Mapping[str, Callable[[], Strategy]]] = {
    str(name): make for name, make in strategies.STRATEGIES.items()
}
"""Factories of strategies; each run has its own instance."""
JUDGED = "priority"
"""The strategy whose situations are judged against the best: the paper's heuristic."""
BEST = "optimal"


@dataclass(frozen=True, slots=True, order=True)
class SchedulingJob:
    """A run. `drawn`: return the run's curve as well."""

    family: str
    seed: int
    strategy: str
    drawn: bool = False


@dataclass(frozen=True, slots=True)
class SchedulingTrial:
    job: SchedulingJob
    measures: Measures
    situations: tuple[Situation, ...]
    """Empty unless the strategy is `JUDGED`."""
    decisions: tuple[Ns, ...]
    """Duration of each pass on the caller's clock: the only part that differs from run to run."""
    curve: Curve | None = None


class _Watched:
    """A strategy with a stop watch, and perhaps an observer."""

    def __init__(self, strategy: Strategy, clock: Callable[[], Ns], observer: Observer | None) -> None:
        self.name = strategy.name
        self.strategy, self.clock, self.observer = strategy, clock, observer
        self.took: list[Ns] = []

    def log_line(self) -> str:
        return self.strategy.log_line()

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        if self.observer is not None:
            self.observer.before(state, state.now)
        begin = self.clock()
        self.strategy.run_pass(state, actions)
        self.took.append(self.clock() - begin)
        if self.observer is not None:
            self.observer.after(state)


def run(job: SchedulingJob, clock: Callable[[], Ns]) -> SchedulingTrial:
    """`clock` gives ns, and only times the passes. Raises KeyError for an unknown family or strategy."""
    return play(job, FAMILIES[job.family].workload(job.seed), clock)


def run_timed(job: SchedulingJob) -> SchedulingTrial:
    """Passes are timed in processor time, as a study keeps all processors busy; of all threads, as a solver may have
    several."""
    return run(job, time.process_time_ns)


def play(job: SchedulingJob, workload: Workload, clock: Callable[[], Ns]) -> SchedulingTrial:
    """The same with the caller's workload."""
    observer = Observer(workload.rcs, STRATEGIES[BEST]()) if job.strategy == JUDGED else None
    watched = _Watched(STRATEGIES[job.strategy](), clock, observer)
    played = replay(workload, strategy=watched)
    if observer is not None:
        observer.close()
    return SchedulingTrial(
        job,
        measure(workload, played),
        tuple(observer.found) if observer is not None else (),
        tuple(watched.took),
        curve(workload, played) if job.drawn else None,
    )
