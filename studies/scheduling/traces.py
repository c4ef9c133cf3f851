"""A job trace under zscout's strategies, compared with batch schedulers: waits, and work thrown away by preemption."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from studies.scheduling.backfill import POLICIES
from studies.scheduling.measures import measure
from studies.scheduling.swf import Job, read_trace, workload
from studies.scheduling.trial import STRATEGIES
from zscout.config.scheduling_policy import SchedulingPolicy
from zscout.scheduling.core import Core
from zscout.scheduling.model import Effect
from zscout.simulation.replay import replay
from zscout.types import SECOND, Ns

BASELINE = "EASY"


class TraceTrial(NamedTuple):
    path: Path
    policy: str
    """A strategy of zscout, or a name in `POLICIES`."""
    classes: bool
    first: int | None = None
    places: int = 0
    knobs: SchedulingPolicy = SchedulingPolicy()


@dataclass(frozen=True, slots=True)
class TraceReport:
    """Waits in seconds. `higher`: mean wait of the higher class; `thrown_away`: share of held device time; `event_us`:
    processor time per event of the core."""

    policy: str
    classes: bool
    mean: float
    longest: float
    higher: float
    thrown_away: float = 0.0
    preemptions: int = 0
    unserved: int = 0
    event_us: float | None = None


def run(trial: TraceTrial) -> TraceReport:
    jobs = read_trace(trial.path, trial.first, trial.places)
    if trial.policy in POLICIES:
        starts = POLICIES[trial.policy](jobs)
        return _report(trial, jobs, [start - job.at for start, job in zip(starts, jobs, strict=True)])
    batches = 0

    def count(_now: Ns, core: Core, _effects: list[Effect]) -> None:
        nonlocal batches
        batches = core.batches

    work = workload(jobs, classes=trial.classes)
    begin = time.process_time()
    played = replay(work, count, strategy=STRATEGIES[trial.policy](), policy=trial.knobs)
    took = time.process_time() - begin
    found = measure(work, played)
    lost = set(played.unserved)
    served = [job for number, job in enumerate(jobs) if f"j{number}" not in lost]
    rest = found.thrown_away, found.preemptions, found.unserved, took / max(1, batches) * 1e6
    return _report(trial, served, found.waits, *rest)


def _report(trial: TraceTrial, jobs: Sequence[Job], waits: Sequence[Ns], *rest: float) -> TraceReport:
    seconds = [wait / SECOND for wait in waits]
    higher = [wait for wait, job in zip(seconds, jobs, strict=True) if job.is_higher]
    found = statistics.fmean(seconds or [0.0]), max(seconds, default=0.0), statistics.fmean(higher or [0.0])
    thrown, preemptions, unserved, event_us = rest or (0.0, 0, 0, None)
    return TraceReport(trial.policy, trial.classes, *found, thrown, int(preemptions), int(unserved), event_us)


def rows(reports: Sequence[TraceReport]) -> list[list[str]]:
    """One line for each report, with waits as ratios to EASY."""
    base = next((report for report in reports if report.policy == BASELINE), None)
    found = []
    for report in sorted(reports, key=lambda report: report.classes):
        first = base is None or report is base
        found.append(
            [
                report.policy,
                "two" if report.classes else "one",
                f"{report.mean:,.0f} s" if base is None or first else f"{report.mean / base.mean:.2f}",
                f"{report.longest:,.0f} s" if base is None or first else f"{report.longest / base.longest:.2f}",
                f"{report.higher:,.0f} s" if base is None or first else f"{report.higher / base.higher:.2f}",
                f"{report.thrown_away:.1%}",
                str(report.preemptions),
                "" if report.event_us is None else f"{report.event_us:,.0f} us",
            ]
        )
    return found


COLUMNS = ["policy", "classes", "mean", "longest", "higher class", "thrown away", "preemptions", "per event"]
