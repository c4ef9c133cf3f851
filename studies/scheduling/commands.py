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
"""Trials at most: more would fill the memory with their waits."""
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
@seeds_option("5", "Workloads of each family: so many, or those of seeds A to B.")
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
    """Compares scheduling strategies on families of random workloads.

    For each: RCs in use, waiting, preemptions, work that they throw away, time per pass; and how often the
    paper's heuristic uses fewer RCs than the best set in the same situation, and what foretells it. A seed is
    the same workload on every machine, and all but the times of passes comes out the same. docs/evaluation says
    what was found.

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
    # numpy is wanted from here on.
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
@seeds_option("5", "Workloads of each family: so many, or those of seeds A to B.", MAX_SEEDS)
@jobs_option
@common.json_option("Print one JSON object instead of tables.")
def bookings(families: tuple[str, ...], seeds: range, processes: int | None, as_json: bool) -> None:
    """Measures what bookings cost, and what they give to those who book.

    The same random requests with none, a tenth, a fifth and two fifths of them booked half a minute to two
    minutes ahead, under strategy adaptive: RCs in use, lost to bookings (idle though somebody waited whom a
    booking kept out), work thrown away by preemption; how many of the booked began at their dates, how much
    later these were than wanted, and how many of the same began at once without bookings; and the wait of those
    who never book. docs/evaluation says what was found.

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
    "--strategy", type=click.Choice(list(STRATEGIES)), default="adaptive", show_default=True, help="Who schedules."
)
@click.option("--exact", is_flag=True, help="All ask for exactly what they take.")
@seeds_option("5", "Workloads of each family: so many, or those of seeds A to B.", MAX_SEEDS)
@jobs_option
@common.json_option("Print one JSON object instead of a table.")
def forecasts(
    families: tuple[str, ...], strategy: str, exact: bool, seeds: range, processes: int | None, as_json: bool
) -> None:
    """Measures how right it is what requests are told of their start, where they ask for 2 to 10 times too much.

    Each ARC is a run of one of 12 programs, and asks for so many times what it takes: always about as many for
    one program. As it is queued its start is foretold from what holds have asked for, from what was learned of
    how long they last, and from what they will take: the best there can be, as nobody knows who comes later.
    docs/evaluation says what was found.

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
        terminal.print_json({"families": [dataclasses.asdict(one) for one in found]})
        return
    columns = ["family", "queued", *(f"near, {way}" for way in study.WAYS), *(f"error, {way}" for way in study.WAYS)]
    rows = [
        [one.family, str(one.queued)]
        + [f"{one.ways[way].near:.1%}" for way in study.WAYS]
        + [f"{one.ways[way].error:.1f} s" for way in study.WAYS]
        for one in found
    ]
    title = f"Starts as they were foretold by what was asked for, learned and true ({strategy})"
    terminal.print_table(columns, rows, title=title)


@click.command()
@seeds_option("3", "Weeks: so many, or those of seeds A to B.", MAX_SEEDS)
@click.option(
    "--cases",
    type=click.IntRange(0, MAX_CASES),
    default=500,
    show_default=True,
    help="Random fleets in which one group asks otherwise than it needs.",
)
@jobs_option
@common.json_option("Print one JSON object instead of tables; it has the seeds of all cases in which it was of use.")
def shares(seeds: range, cases: int, processes: int | None, as_json: bool) -> None:
    """Measures fair shares: how equal two groups come out, and whether it is of use to inflate or split requests.

    A week of 10 RCs, with fair shares and without: one group is always at work, the other comes in bursts of 20.
    Then random fleets for an hour each, in which one group asks for more time than it needs, splits what it asks
    for, or asks for everything besides: does it get more of use? docs/evaluation says what was found.

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
@click.option("--first", type=click.IntRange(1), help="Only so many jobs. Default: all.")
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
    """Plays a job trace (Standard Workload Format, .swf or .swf.gz) on 32 exclusive devices.

    The strategies beside EASY backfill, conservative backfill and shortest first: waits in ratios to EASY, device time
    that preemption threw away, processor time per event. Runtimes are what was asked for. docs/scheduling.md says what
    was found on the NASA iPSC log of the Parallel Workloads Archive.

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
