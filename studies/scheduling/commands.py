"""The studies of scheduling as commands: `schedule`, `bookings`, `forecasts`, `shares`, `traces`."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Final

import click

from studies.options import MAX_SEEDS, jobs_option, seeds_option, show
from studies.scheduling.backfill import POLICIES
from studies.scheduling.bookings import BOOKABLE, DEFAULT_FAMILIES, SHARES
from studies.scheduling.families import FAMILIES
from studies.scheduling.trial import STRATEGIES, SchedulingJob, run_timed
from zscout import terminal
from zscout.cli import common
from zscout.cli.simulation.options import check_rrd, rrd_option
from zscout.config.strict import BadInput

MAX_SCHEDULES: Final = 5_000
"""Most trials: more would fill the memory with their waits."""
MAX_CASES: Final = 100_000


@click.command()
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
@seeds_option("5", "Workloads of each family: a number, or a range of seeds A-B.")
@jobs_option
@common.json_option("Print one JSON object instead of tables.")
@rrd_option()
def schedule(
    families: tuple[str, ...],
    strategies: tuple[str, ...],
    seeds: range,
    processes: int | None,
    as_json: bool,
    rrd: Path | None,
) -> None:
    """Compare scheduling strategies on families of random workloads.

    For each: RCs in use, waits, preemptions and the work that they throw away, time per pass; how often the
    paper's heuristic uses fewer RCs than the best set in the same situation, and a rule that predicts it. A seed
    gives the same workload and results on every machine, except for the times of passes. The results are in
    docs/evaluation.

    \b
    Examples:
      python -m studies schedule --family paper --seeds 100
      python -m studies schedule --family load65 --strategy priority --strategy optimal --json
      python -m studies schedule --seeds 2 --rrd study.rrd && zscout view study.rrd
    """
    chosen = list(dict.fromkeys(families)) or list(FAMILIES)
    compared = list(dict.fromkeys(strategies)) or list(STRATEGIES)
    trials = len(chosen) * len(compared) * len(seeds)
    if trials > MAX_SCHEDULES:
        raise BadInput(f"--seeds: {trials} trials are more than {MAX_SCHEDULES}; ask for fewer seeds or families")
    check_rrd(rrd)
    # These modules import numpy.
    from studies.process_pool import run_trials
    from studies.scheduling.summary import Study
    from studies.scheduling.tables import print_report

    result = Study(chosen, compared, seeds)
    planned = [
        SchedulingJob(family, seed, strategy, drawn=rrd is not None and seed == seeds[0])
        for family in chosen
        for seed in seeds
        for strategy in compared
    ]
    common.run(run_trials(run_timed, planned, processes, result.add))
    report = result.report()
    if rrd is not None:
        from studies.scheduling.plots import record

        record(rrd, report, result.curves)
    show(dataclasses.asdict(report), rrd, partial(print_report, report), as_json=as_json)


@click.command()
@click.option(
    "--family",
    "families",
    multiple=True,
    type=click.Choice(BOOKABLE),
    help=f"A family of workloads; repeat it for several. Default: {', '.join(DEFAULT_FAMILIES)}.",
)
@seeds_option("5", "Workloads of each family: a number, or a range of seeds A-B.", MAX_SEEDS)
@jobs_option
@common.json_option("Print one JSON object instead of tables.")
def bookings(families: tuple[str, ...], seeds: range, processes: int | None, as_json: bool) -> None:
    """Measure the cost of bookings, and their benefit for the requests that book.

    The same random requests with none, a tenth, a fifth and two fifths of them booked half a minute to two
    minutes ahead, under strategy adaptive: RCs in use, lost to bookings (idle while a booking kept a request
    waiting), work thrown away by preemption; how many of the booked requests began at their dates, how much later
    than wanted these dates were, and how many of the same requests began at once without bookings; and the wait of
    requests that never book. The results are in docs/evaluation.

    \b
    Examples:
      python -m studies bookings
      python -m studies bookings --family load65 --seeds 50 --json
    """
    chosen = list(dict.fromkeys(families)) or list(DEFAULT_FAMILIES)
    trials = len(chosen) * len(SHARES) * len(seeds)
    if trials > MAX_SCHEDULES:
        raise BadInput(f"--seeds: {trials} trials are more than {MAX_SCHEDULES}; ask for fewer seeds or families")
    from studies.process_pool import run_trials
    from studies.scheduling import bookings as study_of
    from studies.scheduling.tables import print_bookings

    found: list[study_of.BookingTrial] = []
    common.run(run_trials(study_of.run, study_of.jobs(chosen, seeds), processes, found.append))
    report = study_of.report(found)
    show(dataclasses.asdict(report), None, partial(print_bookings, report), as_json=as_json)


@click.command()
@click.option(
    "--family",
    "families",
    multiple=True,
    type=click.Choice(list(FAMILIES)),
    help="A family of workloads; repeat it for several. Default: all whose requests come one after the other.",
)
@click.option(
    "--strategy", type=click.Choice(list(STRATEGIES)), default="adaptive", show_default=True, help="The strategy."
)
@click.option("--exact", is_flag=True, help="All ask for exactly the time that they take.")
@seeds_option("5", "Workloads of each family: a number, or a range of seeds A-B.", MAX_SEEDS)
@jobs_option
@common.json_option("Print one JSON object instead of a table.")
def forecasts(
    families: tuple[str, ...], strategy: str, exact: bool, seeds: range, processes: int | None, as_json: bool
) -> None:
    """Measure the accuracy of forecast starts if requests ask for 2 to 10 times too much time.

    Each ARC is a run of one of 12 programs, and asks for a multiple of the time that it takes: about the same
    multiple for each run of a program. When it is queued its start is forecast from the requested times, from
    learned durations, and from the true durations: the best possible forecast, as later requests are unknown.
    The results are in docs/evaluation.

    \b
    Examples:
      python -m studies forecasts
      python -m studies forecasts --family load65 --family bursts --seeds 20
      python -m studies forecasts --exact --strategy priority --json
    """
    chosen = list(dict.fromkeys(families)) or [name for name, family in FAMILIES.items() if not family.at_once]
    from studies.process_pool import run_trials
    from studies.scheduling import forecasts as study

    trials: list[study.ForecastTrial] = []
    planned = [study.ForecastJob(family, seed, strategy, exact) for family in chosen for seed in seeds]
    common.run(run_trials(study.run, planned, processes, trials.append))
    found = study.report(trials)
    if as_json:
        terminal.print_json({"families": [dataclasses.asdict(family) for family in found]})
        return
    columns = ["family", "queued", *(f"near, {way}" for way in study.WAYS), *(f"error, {way}" for way in study.WAYS)]
    rows = [
        [family.family, str(family.queued)]
        + [f"{family.ways[way].near:.1%}" for way in study.WAYS]
        + [f"{family.ways[way].error:.1f} s" for way in study.WAYS]
        for family in found
    ]
    title = f"Forecasts of starts from asked, learned and true durations ({strategy})"
    terminal.print_table(columns, rows, title=title)


@click.command()
@seeds_option("3", "Weeks: a number, or a range of seeds A-B.", MAX_SEEDS)
@click.option(
    "--cases",
    type=click.IntRange(0, MAX_CASES),
    default=500,
    show_default=True,
    help="Random fleets in which one group asks for more than it needs, or splits its requests.",
)
@jobs_option
@common.json_option("Print one JSON object instead of tables; it has the seeds of all cases in which it was of use.")
def shares(seeds: range, cases: int, processes: int | None, as_json: bool) -> None:
    """Measure fair shares: how equal two groups come out, and whether inflating or splitting requests pays.

    A week of 10 RCs, with fair shares and without: one group is always at work, the other comes in bursts of 20.
    Then random fleets for an hour each, in which one group asks for more time than it needs, splits its requests,
    or requests all RCs as well: does it get more useful RC-seconds? The results are in docs/evaluation.

    \b
    Examples:
      python -m studies shares
      python -m studies shares --seeds 1 --cases 10000 --json
    """
    from studies.process_pool import run_trials
    from studies.scheduling import shares as fair
    from studies.scheduling.tables import print_shares

    weeks: list[fair.WeekTrial] = []
    found: list[fair.CaseTrial] = []
    planned = [fair.Week(seed, on) for seed in seeds for on in (False, True)]
    common.run(run_trials(fair.play_week, planned, processes, weeks.append))
    if cases:
        common.run(run_trials(fair.play_case, range(cases), processes, found.append))
    report = fair.report(weeks, found)
    show(dataclasses.asdict(report), None, partial(print_shares, report), as_json=as_json)


@click.command()
@click.argument("trace", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option(
    "--policy",
    "policies",
    multiple=True,
    type=click.Choice([*POLICIES, *STRATEGIES]),
    help="A strategy or batch scheduler; repeat it for several. Default: all.",
)
@click.option(
    "--classes",
    type=click.Choice(["one", "two", "both"]),
    default="both",
    show_default=True,
    help="One priority for all, or a higher one for system personnel.",
)
@click.option("--first", type=click.IntRange(1), help="Number of jobs. Default: all.")
@click.option("--places", type=click.IntRange(0), default=0, help="Other places for programs. Default: 0.")
@jobs_option
@common.json_option("Print one JSON object instead of a table.")
def traces(
    trace: Path,
    policies: tuple[str, ...],
    classes: str,
    first: int | None,
    places: int,
    processes: int | None,
    as_json: bool,
) -> None:
    """Play a job trace (Standard Workload Format, .swf or .swf.gz) on 32 exclusive devices.

    The strategies are compared with EASY backfill, conservative backfill and shortest first: waits as ratios to EASY,
    device time that preemption threw away, processor time per event. Jobs ask for exactly their runtimes. The results
    for the NASA iPSC log of the Parallel Workloads Archive are in docs/evaluation.

    \b
    Examples:
      python -m studies traces NASA-iPSC-1993-3.1-cln.swf.gz
      python -m studies traces TRACE --policy EASY --policy adaptive --classes two --first 3000
    """
    from studies.process_pool import run_trials
    from studies.scheduling import traces as study

    chosen = list(dict.fromkeys(policies)) or [*POLICIES, *STRATEGIES]
    forms = {"one": [False], "two": [True], "both": [False, True]}[classes]
    planned = [
        study.TraceTrial(trace, policy, form, first, places)
        for form in forms
        for policy in chosen
        if policy in STRATEGIES or form is forms[0]
    ]
    found: list[study.TraceReport] = []
    common.run(run_trials(study.run, planned, processes, found.append))
    if as_json:
        terminal.print_json({"policies": [dataclasses.asdict(report) for report in found]})
    else:
        terminal.print_table(study.COLUMNS, study.rows(found), title="Waits in ratios to EASY backfill")
