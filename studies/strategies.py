"""`python -m studies strategies`: the number of RCs that each strategy gets into use, and its time.

The paper's experiment (10 RCs, 20 ARCs of 1 to 5, all at once), then larger experiments, compared with the best set of
CP-SAT. Each strategy decides in a core, as in the RCM: from the requests to the last pass. Times are CPU times of this
process, so that a busy machine matters less.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

from zscout.scheduling import optimal
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, Event, RcJoined, Requested, Tick, WakeAt
from zscout.scheduling.packing import PackingItem, PackingProblem, numbers, pack
from zscout.scheduling.strategies import STRATEGIES
from zscout.types import SECOND

PAPER = {"optimal": 39.3, "priority": 0.59}
"""Seconds, in the paper: its optimal strategy and its heuristic."""


@dataclass(frozen=True, slots=True)
class Row:
    """A strategy at one size. Shares are RCs in use, divided by the best possible number."""

    size: str
    strategy: str
    seeds: int
    in_use: float
    of_best: float
    least_of_best: float
    median_ms: float
    p99_ms: float
    longest_pass_ms: float
    paper_s: float | None = None


@dataclass(frozen=True, slots=True)
class Decided:
    in_use: int
    seconds: float
    longest: float
    """The longest single pass in seconds, during which the RCM would not answer."""


def experiment(seed: int, rcs: int, arcs: int) -> list[ArcRequest]:
    """ARCs of the same priority and runtime that need 1 to 5 RCs each."""
    draw = random.Random(seed)  # noqa: S311
    return [
        ArcRequest(f"a{number}", "host/a", {f"rc/{rc}": {} for rc in needs}, 1, SECOND)
        for number in range(arcs)
        for needs in [draw.sample(range(rcs), draw.randint(1, 5))]
    ]


def problem(requests: list[ArcRequest]) -> PackingProblem:
    """The requests as a problem for the packer."""
    masks = [sum(1 << int(rc.split("/")[1]) for rc in request.needs) for request in requests]
    return PackingProblem([PackingItem(mask, mask.bit_count(), 0) for mask in masks])


def decide(strategy: str, rcs: int, requests: list[ArcRequest]) -> Decided:
    """Let a strategy assign free RCs."""
    core = Core(STRATEGIES[strategy]())  # type: ignore[index]
    core.handle(0, *(RcJoined(f"rc/{number}", False) for number in range(rcs)))
    batch: list[Event] = [Requested(request) for request in requests]
    took: list[float] = []
    while batch:
        begin = time.process_time()
        effects = core.handle(0, *batch)
        took.append(time.process_time() - begin)
        again = any(isinstance(effect, WakeAt) and effect.at == 0 for effect in effects)
        batch = [Tick()] if again else []
    return Decided(sum(len(arc.needs) for arc in core.status().running), sum(took), max(took))


def rows(rcs: int, arcs: int, seeds: int, best: list[float], names: tuple[str, ...], paper: bool = False) -> list[Row]:
    """Measure each strategy. `best`: the best number of RCs by seed, for the shares."""
    found = []
    for name in names:
        runs = [decide(name, rcs, experiment(seed, rcs, arcs)) for seed in range(seeds)]
        shares = [run.in_use / most for run, most in zip(runs, best, strict=True)]
        took = sorted(run.seconds * 1e3 for run in runs)
        found.append(
            Row(
                f"{rcs}x{arcs}",
                name,
                seeds,
                round(statistics.fmean(run.in_use for run in runs), 2),
                round(statistics.median(shares) if not paper else statistics.fmean(shares), 4),
                round(min(shares), 4),
                round(statistics.median(took), 3),
                round(took[min(len(took) - 1, round(0.99 * len(took)))], 3),
                round(max(run.longest for run in runs) * 1e3, 3),
                PAPER.get(name) if paper else None,
            )
        )
    return found


def solved(rcs: int, arcs: int, seeds: int, seconds: float) -> list[float]:
    """The best number of RCs by seed that CP-SAT finds within `seconds`, on all cores."""
    return [float(reference(problem(experiment(seed, rcs, arcs)), seconds)) for seed in range(seeds)]


def reference(packing: PackingProblem, seconds: float) -> int:
    """Pairs in use of the best set that CP-SAT finds by itself, without our hint."""
    from ortools.sat.python import cp_model

    model = cp_model.CpModel()
    takes = [model.new_bool_var("") for _ in packing.items]
    covers: dict[int, list[cp_model.IntVar]] = {}
    for mask, take in zip(packing.masks, takes, strict=True):
        for rc in numbers(mask):
            covers.setdefault(rc, []).append(take)
    for cover in covers.values():
        model.add_at_most_one(cover)
    model.maximize(sum(item.width * take for item, take in zip(packing.items, takes, strict=True)))
    solver = cp_model.CpSolver()
    solver.parameters.max_time_in_seconds = seconds
    solver.parameters.num_workers = max(2, os.cpu_count() or 1)
    solver.solve(model)
    return round(solver.objective_value)


def border(seeds: int) -> list[dict[str, Any]]:
    """Times of branch and bound compared with CP-SAT, by size."""
    found = []
    for rcs, arcs in ((10, 20), (15, 30), (20, 40), (30, 60), (40, 80), (50, 100)):
        cases = [problem(experiment(seed, rcs, arcs)) for seed in range(seeds)]
        nodes, branch, solver, exact = [], [], [], 0
        for case in cases:
            begin = time.process_time()
            packing = pack(case, 20_000)
            branch.append((time.process_time() - begin) * 1e3)
            nodes.append(packing.nodes)
            exact += packing.exact
            if optimal.solver_available():
                begin = time.process_time()
                optimal.improve(case, case.complete(), 2.0)
                solver.append((time.process_time() - begin) * 1e3)
        found.append(
            {
                "size": f"{rcs}x{arcs}",
                "branch_ms": round(statistics.median(branch), 3),
                "branch_worst_ms": round(max(branch), 3),
                "nodes": statistics.median(nodes),
                "proven": exact / len(cases),
                "cpsat_ms": round(statistics.median(solver), 3) if solver else None,
            }
        )
    return found


def additions() -> float:
    """CPU ms of a million additions: how fast this machine is just now."""
    begin, total = time.process_time(), 0
    for number in range(1_000_000):
        total += number
    return (time.process_time() - begin) * 1e3


def table(measured: list[Row], borders: list[dict[str, Any]]) -> str:
    head = f"{'size':<9}{'strategy':<10}{'in use':>8}{'of best':>9}{'least':>8}{'median':>11}{'p99':>11}"
    lines = [head + f"{'longest pass':>14}{'paper':>9}"]
    lines += [
        f"{row.size:<9}{row.strategy:<10}{row.in_use:>8.2f}{row.of_best:>9.3f}{row.least_of_best:>8.3f}"
        f"{row.median_ms:>8.2f} ms{row.p99_ms:>8.2f} ms{row.longest_pass_ms:>11.2f} ms"
        + (f"{row.paper_s:>7g} s" if row.paper_s is not None else "")
        for row in measured
    ]
    lines += ["", f"{'size':<9}{'branch and bound':>18}{'worst':>11}{'proven':>8}{'CP-SAT':>12}"]
    lines += [
        f"{size['size']:<9}{size['branch_ms']:>15.2f} ms{size['branch_worst_ms']:>8.1f} ms{size['proven']:>8.0%}"
        + (f"{size['cpsat_ms']:>9.1f} ms" if size["cpsat_ms"] is not None else "")
        for size in borders
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies strategies", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--seeds", type=int, default=100, help="of the paper's experiment (default: 100)")
    parser.add_argument("--large", type=int, default=5, help="seeds of the larger experiments (default: 5)")
    parser.add_argument("--solver", type=float, default=60, help="seconds for CP-SAT at 300x600 (default: 60)")
    args = parser.parse_args()
    if args.seeds < 1 or args.large < 1 or args.solver <= 0:
        parser.error("at least one seed of each, and some time for the solver")
    load = os.getloadavg()[0]
    loop = additions()
    names = tuple(STRATEGIES)
    small = [problem(experiment(seed, 10, 20)) for seed in range(args.seeds)]
    best = [float(case.value(pack(case).chosen)) for case in small]
    measured = rows(10, 20, args.seeds, best, names, paper=True)
    if optimal.solver_available():
        for rcs, arcs, seconds in ((50, 100, 20.0), (300, 600, args.solver)):
            print(f"{rcs}x{arcs}: CP-SAT, up to {seconds:g} s for each of {args.large}", file=sys.stderr)
            best = solved(rcs, arcs, args.large, min(seconds, args.solver))
            measured += rows(rcs, arcs, args.large, best, names)
    borders = border(args.large)
    machine = {
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "load_average_at_start": round(load, 2),
        "load_average_at_end": round(os.getloadavg()[0], 2),
        "million_additions_ms": round(loop),
    }
    if args.json:
        print(json.dumps({"machine": machine, "rows": [asdict(row) for row in measured], "border": borders}))
        return
    print(table(measured, borders))
    print(
        f"\n{machine['cores']} cores, Python {machine['python']}; load average "
        f"{machine['load_average_at_start']} before, {machine['load_average_at_end']} after. CPU times. `of "
        "best`: the mean in the paper's experiment, else the median, of the best that CP-SAT found in its "
        f"time.\nA loop of a million additions took {loop:.0f} ms; some 50 on a quiet machine."
    )
    if not optimal.solver_available():
        print("Without OR-tools (the extra `optimal`) there are no larger sizes: their best sets are unknown.")
