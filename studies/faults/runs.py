"""Many runs under faults, their summary, and the reduction of a failed run to few faults."""

from __future__ import annotations

import re
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from studies.faults.guards import without
from studies.faults.simulation import Result, Size, simulate
from zscout import terminal

SHRINK_WITHIN = 200
"""Most runs in which faults are left out."""


@dataclass(slots=True)
class FaultRun:
    """The result of a run, without its transcript."""

    seed: int
    broken: list[str]
    counts: Counter[str]
    faults: Counter[str]
    span: float
    """Seconds of virtual time with faults."""
    served_after: float
    """Seconds of virtual time from the end of the last fault until all requests were served."""
    took: float
    """Seconds of a processor."""


def run(seed: int, guard: str | None = None) -> FaultRun:
    began = time.process_time()
    with without(guard):
        result = simulate(seed)
    kinds: Counter[str] = Counter(fault.kind for fault in result.faults)
    span, took = Size.of(seed).span, time.process_time() - began
    return FaultRun(seed, result.broken, result.counts, kinds, span, result.served_after, took)


def shrink(result: Result) -> Result:
    """Leave out faults one by one while the same promise breaks, and return the last such run."""
    if not result.broken:
        return result
    wanted, tries, at = promise(result.broken[0]), 0, 0
    while at < len(result.faults) and tries < SHRINK_WITHIN:
        fewer = [fault for number, fault in enumerate(result.faults) if number != at]
        less, tries = simulate(result.seed, faults=fewer), tries + 1
        if less.broken and promise(less.broken[0]) == wanted:
            result = less
        else:
            at += 1
    return result


def promise(broken: str) -> str:
    """The broken promise, without the names and numbers of this run."""
    _, _, text = broken.partition(" ")
    return re.sub(r"\b[hc]\d+\S*|[\d.]+", "*", text)[:80]


@dataclass
class FaultStudy:
    """Runs, added up."""

    runs: int = 0
    seconds: float = 0.0
    """Seconds of virtual time with faults."""
    took: float = 0.0
    """Seconds of processor time."""
    counts: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    served_after: list[float] = field(default_factory=list)
    broken: dict[str, list[int]] = field(default_factory=dict)
    """By promise: the seeds of the runs in which it was the first broken promise."""

    def add(self, run: FaultRun) -> None:
        self.runs += 1
        self.seconds += run.span
        self.took += run.took
        self.counts += run.counts
        self.faults += run.faults
        self.served_after.append(run.served_after)
        if run.broken:
            self.broken.setdefault(promise(run.broken[0]), []).append(run.seed)


def print_report(study: FaultStudy) -> None:
    hours = study.seconds / 3_600
    terminal.print_line(
        f"{terminal.many(study.runs, 'run')}, {hours:.1f} h of virtual time with faults,"
        f" {study.took / study.runs:.2f} s of a processor each"
    )
    for what, counted in (("faults", study.faults), ("events", study.counts)):
        terminal.print_table([what, "number"], [[name, f"{number:,}"] for name, number in sorted(counted.items())])
    served = sorted(study.served_after)
    terminal.print_line(
        f"all served after the last fault: median {statistics.median(served):.2f} s, worst {served[-1]:.2f} s"
    )
    for text, seeds in sorted(study.broken.items()):
        terminal.print_line(f"BROKEN in {terminal.many(len(seeds), 'run')}: {text}")
        terminal.print_line(
            f"  python -m studies faults --seed {seeds[0]}    (or {_some(seeds[1:])})"
            if seeds[1:]
            else f"  python -m studies faults --seed {seeds[0]}"
        )
    if not study.broken:
        terminal.print_line("every promise was kept")


def _some(seeds: Sequence[int]) -> str:
    return ", ".join(map(str, seeds[:8])) + (", ..." if len(seeds) > 8 else "")
