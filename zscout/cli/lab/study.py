"""`zscout study`: experiments with random workloads, in virtual time and on all processors."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Final

import click

from zscout.cli import common
from zscout.cli.groups import DefaultGroup
from zscout.cli.lab.study_options import (
    check_recording,
    jobs_option,
    parse_seeds,
    print_recording,
    rrd_option,
    run_trials,
    seeds_option,
)
from zscout.cli.lab.study_placement import placement
from zscout.cli.lab.study_robots import robots
from zscout.config.strict import BadInput
from zscout.lab.study.scheduling.families import FAMILIES
from zscout.lab.study.scheduling.trial import STRATEGIES, SchedulingJob, run_timed

MAX_TRIALS: Final = 5_000
"""More would fill the memory with their waits."""
DEFAULT: Final = "schedule"


@click.group(cls=DefaultGroup, default=DEFAULT)
def study() -> None:
    """Runs experiments with random workloads in virtual time; `schedule` unless another one is named.

    \b
    Examples:
      zscout study
      zscout study schedule --family paper --seeds 100
      zscout study placement --seeds 20
      zscout study robots --starts 40
      zscout study schedule --help
    """


study.add_command(placement)
study.add_command(robots)


@study.command()
@click.option(
    "--family",
    "families",
    multiple=True,
    type=click.Choice(list(FAMILIES)),
    help="A family of workloads; repeat it for several. Default: all.",
)
@click.option(
    "--strategy",
    "strategies",
    multiple=True,
    type=click.Choice(list(STRATEGIES)),
    help="A strategy; repeat it for several. Default: all.",
)
@seeds_option("5", "Workloads of each family: so many, or those of seeds A to B.")
@jobs_option
@common.json_option("Print one JSON object instead of tables.")
@rrd_option()
def schedule(
    families: tuple[str, ...],
    strategies: tuple[str, ...],
    seeds: str,
    processes: int | None,
    as_json: bool,
    rrd: Path | None,
) -> None:
    """Compares scheduling strategies on families of random workloads.

    For each: RCs in use, waiting, preemptions, work that they throw away, time per pass; and how often the
    paper's heuristic uses fewer RCs than the best set in the same situation, and what foretells it. A seed is
    the same workload on every machine, and all but the times of passes comes out the same. docs/study.md says
    what was found.

    \b
    Examples:
      zscout study schedule --family paper --seeds 100
      zscout study schedule --family load65 --strategy priority --strategy optimal --json
      zscout study schedule --seeds 2 --rrd study.rrd && zscout view study.rrd
    """
    chosen = list(dict.fromkeys(families)) or list(FAMILIES)
    compared = list(dict.fromkeys(strategies)) or list(STRATEGIES)
    numbers = parse_seeds(seeds)
    trials = len(chosen) * len(compared) * len(numbers)
    if trials > MAX_TRIALS:
        raise BadInput(
            f"--seeds: {trials} trials are more than {MAX_TRIALS}; ask for fewer seeds or families"
        )
    check_recording(rrd)
    # numpy is wanted from here on.
    from zscout.lab.study.scheduling.summary import Study

    result = Study(chosen, compared, numbers)
    planned = [
        SchedulingJob(family, seed, strategy, drawn=rrd is not None and seed == numbers[0])
        for family in chosen
        for seed in numbers
        for strategy in compared
    ]
    common.run(run_trials(run_timed, planned, processes, result.add))
    report = result.report()
    if rrd is not None:
        from zscout.lab.plots.scheduling import record

        record(rrd, report, result.curves)
    if as_json:
        common.print_json(dataclasses.asdict(report))
        return
    from zscout.cli.lab.study_tables import print_report

    print_report(report)
    print_recording(rrd)
