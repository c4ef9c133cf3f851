"""The fault simulator as a command."""

from __future__ import annotations

import sys
from functools import partial
from itertools import count, islice
from typing import Final

import click

from studies.options import jobs_option, seed_option, show
from zscout import terminal
from zscout.cli import common
from zscout.config.strict import BadInput, quoted

MAX_FAULT_RUNS: Final = 100_000


@click.command()
@seed_option("0-99", "A run with its transcript, or a range of seeds A-B.", MAX_FAULT_RUNS)
@click.option("--runs", type=click.IntRange(1, MAX_FAULT_RUNS), help="Number of runs, from the first seed on.")
@click.option("--without", "guard", metavar="GUARD", help="Remove a guard of the protocol (docs/promises.md).")
@click.option("--bookings", is_flag=True, help="Only runs in which programs book; --runs counts these.")
@jobs_option
@common.json_option("Print one JSON object instead of tables.")
def faults(
    seeds: range, runs: int | None, guard: str | None, bookings: bool, processes: int | None, as_json: bool
) -> int:
    """Run a whole fleet under faults in virtual time, and check every promise (docs/promises.md).

    The real candidates, RCs and clients, on a mesh in memory: messages of each kind lost, late, or duplicated;
    partitions, freezes, crashes, drifting clocks. Every tenth run lasts 5 minutes with 20 programs; in every tenth
    only nodes fail, in the steps of a component's move; in every fifth, programs book. A seed always gives the same
    run, byte for byte. If a promise breaks, `--seed A` leaves out as many faults as possible and prints the
    transcript. Exit code 1: a promise was broken.

    \b
    Examples:
      python -m studies faults --runs 1000
      python -m studies faults --seed 2000-2999 --json
      python -m studies faults --seed 17
      python -m studies faults --runs 200 --without promise
      python -m studies faults --runs 1000 --bookings
    """
    from studies.faults.guards import GUARDS, without
    from studies.faults.runs import FaultRun, FaultStudy, print_report, run, shrink
    from studies.faults.simulation import Size, simulate

    if runs is not None:
        wanted = (seed for seed in count(seeds[0]) if not bookings or Size.of(seed).bookers)
        chosen = list(islice(wanted, runs))
    else:
        chosen = [seed for seed in seeds if not bookings or len(seeds) == 1 or Size.of(seed).bookers]
    if guard is not None and guard not in GUARDS:
        raise BadInput(f"--without {quoted(guard)}: unknown guard; write one of: {', '.join(GUARDS)}")
    if not chosen:
        raise BadInput("--seed: no program books in these runs; give more seeds, or leave out --bookings")
    if len(chosen) == 1:
        with without(guard):
            result = shrink(simulate(chosen[0]))
        if as_json:
            terminal.print_json(
                {name: getattr(result, name) for name in ("seed", "broken", "counts", "digest", "lines")}
            )
        else:
            for line in (*result.lines, *(f"BROKEN {text}" for text in result.broken)):
                terminal.print_line(line)
        return 1 if result.broken else 0
    from studies.process_pool import run_trials

    found = FaultStudy()

    def take(result: FaultRun) -> None:
        found.add(result)
        for text in result.broken[:1]:  # at once: thousands of runs take an hour
            terminal.print_line(f"seed {result.seed} BROKEN {text}", sys.stderr)

    common.run(run_trials(partial(run, guard=guard), chosen, processes, take))
    # Not `asdict`, which fails on counters in Python 3.11.
    show(vars(found), None, partial(print_report, found), as_json=as_json)
    return 1 if found.broken else 0
