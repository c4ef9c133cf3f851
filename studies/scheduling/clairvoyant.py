"""The waits of each strategy compared with the least possible ones, of a plan that knows all arrivals beforehand.

Small random cases with named RCs. The plan is computed by CP-SAT of OR-tools. It does not preempt, because with all
arrivals known throwing work away never pays. It minimizes the sum of waits, in which each priority level weighs 100
times as much as the level below."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Mapping
from functools import partial
from typing import Final

import click

from studies.options import MAX_SEEDS, jobs_option, seeds_option
from studies.scheduling.measures import measure
from studies.scheduling.trial import STRATEGIES
from zscout import terminal
from zscout.cli import common
from zscout.scheduling.model import ArcRequest
from zscout.simulation.replay import replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND

ARCS: Final = 14
WEIGHT: Final = 100
"""Weight factor of a wait per priority level."""


@dataclasses.dataclass(frozen=True, slots=True)
class ClairvoyantTrial:
    """`least`: the plan's weighted sum of waits in seconds; `proven`: it is the optimum. By strategy: `waits`, the same
    sum, and `ends`, when the last hold ended."""

    seed: int
    least: int
    proven: bool
    waits: Mapping[str, float]
    ends: Mapping[str, float]


def case(seed: int, levels: int) -> Workload:
    draw = random.Random(seed)  # noqa: S311
    rcs = [f"robot/r{number}" for number in range(draw.randint(4, 8))]
    together, at, arrivals = draw.random() < 0.4, 0, []
    for number in range(ARCS):
        width, runtime = draw.randint(1, min(5, len(rcs))), max(1, round(0.5 + draw.expovariate(1 / 8)))
        needs: dict[str, dict[str, object]] = {rc: {} for rc in draw.sample(rcs, width)}
        priority = 1 if levels == 1 else draw.randint(1, levels)
        request = ArcRequest(f"a{number}", "h/c", needs, priority, runtime * SECOND)  # type: ignore[arg-type]
        arrivals.append(Arrival(at * SECOND, request))
        at += 0 if together else draw.randint(0, 3)
    return Workload(tuple(map(WorkloadRc, rcs)), tuple(arrivals))


def least(work: Workload, seconds: float) -> tuple[int, bool]:
    """The least weighted sum of waits found within `seconds`, and whether it is proven to be optimal."""
    from ortools.sat.python import cp_model

    model, intervals, waits = cp_model.CpModel(), dict[str, list[cp_model.IntervalVar]](), []
    known = [
        (arrival.request, arrival.at // SECOND, arrival.request.min_runtime // SECOND) for arrival in work.arrivals
    ]
    horizon = max(at for _, at, _ in known) + sum(runtime for _, _, runtime in known)
    for request, at, runtime in known:
        start = model.new_int_var(at, horizon, "")
        waits.append(WEIGHT ** (request.priority - 1) * (start - at))
        for rc in request.needs:
            intervals.setdefault(rc, []).append(model.new_fixed_size_interval_var(start, runtime, ""))
    for held in intervals.values():
        model.add_no_overlap(held)
    model.minimize(sum(waits))
    solver = cp_model.CpSolver()
    solver.parameters.num_workers = 1
    solver.parameters.max_time_in_seconds = seconds
    status = solver.solve(model)
    return round(solver.objective_value), status == cp_model.OPTIMAL


def run(seed: int, levels: int, seconds: float) -> ClairvoyantTrial:
    work, waits, ends = case(seed, levels), {}, {}
    for name, strategy in STRATEGIES.items():
        played = replay(work, strategy=strategy())
        pairs = zip(measure(work, played).waits, work.arrivals, strict=True)
        waits[name] = sum(WEIGHT ** (arrival.request.priority - 1) * wait for wait, arrival in pairs) / SECOND
        ends[name] = max(hold.end for hold in played.holds) / SECOND
    return ClairvoyantTrial(seed, *least(work, seconds), waits, ends)


@click.command()
@seeds_option("100", "Cases: a number, or a range of seeds A-B.", MAX_SEEDS)
@click.option("--levels", type=click.IntRange(1, 5), default=1, show_default=True, help="Priorities.")
@click.option("--solver", type=click.FloatRange(0.1), default=10.0, show_default=True, help="Seconds for each plan.")
@jobs_option
@common.json_option("Print one JSON object instead of a table.")
def clairvoyant(seeds: range, levels: int, solver: float, processes: int | None, as_json: bool) -> None:
    """Compare each strategy with a plan that knows all arrivals beforehand, in small random cases (needs OR-tools).

    \b
    Examples:
      python -m studies clairvoyant
      python -m studies clairvoyant --seeds 25 --levels 3 --json
    """
    from studies.process_pool import run_trials

    found: list[ClairvoyantTrial] = []
    common.run(run_trials(partial(run, levels=levels, seconds=solver), seeds, processes, found.append))
    if as_json:
        terminal.print_json({"cases": [dataclasses.asdict(trial) for trial in found]})
        return
    least_of_all = max(1, sum(trial.least for trial in found))
    rows = [
        [
            name,
            f"{sum(trial.waits[name] for trial in found) / least_of_all:.2f}",
            f"{sum(trial.ends[name] for trial in found) / len(found):.1f} s",
        ]
        for name in STRATEGIES
    ]
    proven = sum(trial.proven for trial in found)
    title = f"Waits as multiples of the least ({proven} of {len(found)} proven), and the end of the last request"
    terminal.print_table(["strategy", "wait", "end"], rows, title=title)
