"""One trial: one workload under one strategy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from zscout.scheduling import strategies
from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Ns
from zscout.scheduling.priority import Actions, Strategy
from zscout.scheduling.replay import replay
from zscout.scheduling.study.families import FAMILIES
from zscout.scheduling.study.measures import Curve, Measures, curve, measure
from zscout.scheduling.study.situations import Observer, Situation
from zscout.scheduling.votes import Votes
from zscout.scheduling.workload import Workload

STRATEGIES: Final[Mapping[str, Callable[[], Strategy]]] = {
    str(name): make for name, make in strategies.STRATEGIES.items()
}
"""Each makes a strategy for one run."""
JUDGED = "priority"
"""The strategy whose situations are judged against the best: the paper's heuristic."""
BEST = "optimal"


@dataclass(frozen=True, slots=True, order=True)
class Job:
    """What to run. `drawn` asks for the run's curve as well."""

    family: str
    seed: int
    strategy: str
    drawn: bool = False


@dataclass(frozen=True, slots=True)
class Trial:
    job: Job
    measures: Measures
    situations: tuple[Situation, ...]
    """Empty unless the strategy is `JUDGED`."""
    decisions: tuple[Ns, ...]
    """How long each pass took on the caller's clock: the only part that is not the same every time."""
    curve: Curve | None = None


class _Watched:
    """A strategy with a stop watch, and perhaps an observer."""

    def __init__(self, strategy: Strategy, clock: Callable[[], Ns], observer: Observer | None) -> None:
        self.strategy, self.clock, self.observer = strategy, clock, observer
        self.took: list[Ns] = []

    def __call__(self, floor: Floor, votes: Votes, now: Ns, actions: Actions) -> None:
        if self.observer is not None:
            self.observer.before(floor, now)
        begin = self.clock()
        self.strategy(floor, votes, now, actions)
        self.took.append(self.clock() - begin)
        if self.observer is not None:
            self.observer.after(floor)


def run(job: Job, clock: Callable[[], Ns]) -> Trial:
    """Runs a job to its end. `clock` gives ns and only serves to time the passes.

    Raises KeyError for a family or strategy that does not exist."""
    return play(job, FAMILIES[job.family].workload(job.seed), clock)


def play(job: Job, workload: Workload, clock: Callable[[], Ns]) -> Trial:
    """The same with a workload of the caller's own."""
    observer = Observer(workload.rcs, STRATEGIES[BEST]()) if job.strategy == JUDGED else None
    watched = _Watched(STRATEGIES[job.strategy](), clock, observer)
    played = replay(workload, strategy=watched)
    if observer is not None:
        observer.close()
    return Trial(
        job,
        measure(workload, played),
        tuple(observer.found) if observer is not None else (),
        tuple(watched.took),
        curve(workload, played) if job.drawn else None,
    )
