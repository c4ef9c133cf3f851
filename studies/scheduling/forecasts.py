"""The accuracy of forecasts if people ask for more time than they need: from the requested times, from learned
runtimes (`runtimes.py`), and from the true runtimes.

Each ARC of a workload is a run of one of a few programs, and asks for a multiple of the time that it takes: about the
same multiple for all runs of a program. When it is first queued, its start is forecast in each way. Forecasts do not
change the run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from statistics import median
from typing import Final

from msgspec.structs import replace

from studies.scheduling.families import FAMILIES, MILLISECOND
from studies.scheduling.trial import STRATEGIES
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import ArcRequest, Effect, Granted, Hold, HoldEnded, Propose, Queued
from zscout.scheduling.runtimes import RequestTraits, RuntimeEstimator
from zscout.simulation.replay import SERVED, replay
from zscout.simulation.workload import Arrival, Workload
from zscout.types import SECOND, ArcId, Ns

PROGRAMS: Final = 12
FACTORS: Final = (2.0, 10.0)
"""Range of the programs' factors by which they ask for too much time."""
NOISE: Final = 0.2
"""Largest relative deviation of a single request from its program's factor."""
NEAR: Final = 0.2
"""A forecast is right if the start is within this share of the forecast wait."""
WAYS: Final = ("asked", "learned", "true")


@dataclass(frozen=True, slots=True, order=True)
class ForecastJob:
    family: str
    seed: int
    strategy: str
    exact: bool = False
    """True if all ask for exactly the time that they take."""


@dataclass(frozen=True, slots=True)
class ForetoldStart:
    """Forecast and true waits from when an ARC was first queued, in ns. None: it never starts."""

    waits: tuple[Ns | None, ...]
    """In the order of `WAYS`."""
    waited: Ns


@dataclass(frozen=True, slots=True)
class ForecastTrial:
    job: ForecastJob
    foretold: tuple[ForetoldStart, ...]


@dataclass(frozen=True, slots=True)
class Accuracy:
    near: float
    """Share of the queued ARCs that started within `NEAR` of the forecast wait."""
    error: float
    """Median error in seconds of the ARCs with a forecast wait."""


@dataclass(frozen=True, slots=True)
class FamilyForecasts:
    family: str
    queued: int
    ways: Mapping[str, Accuracy]


class _TrueRuntimes(RuntimeEstimator):
    def __init__(self, lasting: Mapping[ArcId, Ns]) -> None:
        super().__init__()
        self._lasting = lasting

    def end(self, request: ArcRequest, hold: Hold, now: Ns) -> Ns | None:
        return max(now + 1, hold.start + self._lasting[request.arc])


def overestimated(workload: Workload, random: Random, *, exact: bool = False) -> tuple[Workload, Mapping[ArcId, Ns]]:
    """The workload as runs of programs that ask for too much time, unless `exact`; and the ns that each ARC takes."""
    factors = [random.uniform(*FACTORS) for _ in range(PROGRAMS)]
    arrivals = []
    for arrival in workload.arrivals:
        program = random.randrange(PROGRAMS)
        factor = 1.0 if exact else factors[program] * random.uniform(1 - NOISE, 1 + NOISE)
        asked = round(arrival.request.min_runtime * factor / MILLISECOND) * MILLISECOND
        arrivals.append(Arrival(arrival.at, replace(arrival.request, label=f"program{program}", min_runtime=asked)))
    lasting = {arrival.request.arc: arrival.request.min_runtime for arrival in workload.arrivals}
    return Workload(workload.rcs, tuple(arrivals)), lasting


def run(job: ForecastJob) -> ForecastTrial:
    """Raises KeyError for an unknown family or strategy."""
    random = Random(f"{job.family}/{job.seed}/asked")  # noqa: S311 - workloads, not secrets
    workload, lasting = overestimated(FAMILIES[job.family].workload(job.seed), random, exact=job.exact)
    requests = {arrival.request.arc: arrival.request for arrival in workload.arrivals}
    learned, true = RuntimeEstimator(), _TrueRuntimes(lasting)
    queued: dict[ArcId, Ns] = {}
    foretold: dict[ArcId, tuple[Ns | None, ...]] = {}
    started: dict[ArcId, Ns] = {}
    since: dict[ArcId, Ns] = {}

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Granted(arc=arc):
                    started.setdefault(arc, now)
                    since[arc] = now
                case HoldEnded(arc=arc, outcome=outcome):
                    learned.observe(RequestTraits.of(requests[arc]), now - since[arc], whole=outcome in SERVED)
                case Queued(arc=arc) if arc not in started:
                    queued.setdefault(arc, now)
        if any(isinstance(effect, Propose) for effect in effects):
            return
        new = [arc for arc in queued if arc not in foretold and arc not in started]
        if not new:
            return
        found = [forecast(core, now, runtimes=runtimes).starts for runtimes in (None, learned, true)]
        for arc in new:
            foretold[arc] = tuple(starts[arc] - now if arc in starts else None for starts in found)

    replay(workload, watch, strategy=STRATEGIES[job.strategy](), lasting=lasting)
    found = (ForetoldStart(waits, started[arc] - queued[arc]) for arc, waits in foretold.items() if arc in started)
    return ForecastTrial(job, tuple(found))


def accuracy(foretold: Sequence[tuple[Ns | None, Ns]]) -> Accuracy:
    """The accuracy of pairs of forecast wait and true wait."""
    errors = [abs(waited - wait) for wait, waited in foretold if wait is not None]
    near = sum(wait is not None and abs(waited - wait) <= NEAR * wait for wait, waited in foretold)
    return Accuracy(near / len(foretold) if foretold else 0.0, median(errors) / SECOND if errors else 0.0)


def report(trials: Iterable[ForecastTrial]) -> list[FamilyForecasts]:
    """By family, in the order of the trials."""
    families: dict[str, list[ForetoldStart]] = {}
    for trial in trials:
        families.setdefault(trial.job.family, []).extend(trial.foretold)
    return [
        FamilyForecasts(
            family,
            len(foretold),
            {name: accuracy([(start.waits[way], start.waited) for start in foretold]) for way, name in enumerate(WAYS)},
        )
        for family, foretold in families.items()
    ]
