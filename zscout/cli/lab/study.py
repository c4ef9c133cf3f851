"""`zscout study`: experiments with random workloads, in virtual time and on all processors."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any, Final

import click

from zscout import terminal
from zscout.cli import common
from zscout.cli.lab.options import (
    DefaultGroup,
    check_rrd,
    jobs_option,
    numbers_option,
    rrd_option,
    seed_option,
    seeds_option,
)
from zscout.cli.requests.options import seconds_within
from zscout.config.strict import BadInput, quoted
from zscout.lab.study.scheduling.bookings import BOOKABLE, DEFAULT_FAMILIES, SHARES
from zscout.lab.study.scheduling.families import FAMILIES
from zscout.lab.study.scheduling.trial import STRATEGIES, SchedulingJob, run_timed

MAX_SCHEDULES: Final = 5_000
"""More would fill the memory with their waits."""
MAX_SEEDS: Final = 1_000
"""More take hours."""
MAX_NETS: Final = 5_000
"""At ten seconds each they take half a day."""
MAX_CASES: Final = 100_000
MAX_FAULT_RUNS: Final = 100_000
MAX_CREW: Final = 16
MAX_BAUD: Final = 1_000_000
MIN_BAUD: Final = 110
MAX_SLOT: Final = 3_600


@click.group(cls=DefaultGroup, default="schedule")
def study() -> None:
    """Runs experiments with random workloads in virtual time; `schedule` unless another one is named.

    \b
    Examples:
      zscout study
      zscout study schedule --family paper --seeds 100
      zscout study bookings --seeds 20
      zscout study forecasts --family load65
      zscout study placement --seeds 20
      zscout study robots --starts 40
      zscout study faults --runs 1000
      zscout study shares
      zscout study schedule --help
    """


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
    seeds: range,
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
    trials = len(chosen) * len(compared) * len(seeds)
    if trials > MAX_SCHEDULES:
        raise BadInput(f"--seeds: {trials} trials are more than {MAX_SCHEDULES}; ask for fewer seeds or families")
    check_rrd(rrd)
    # numpy is wanted from here on.
    from zscout.lab.study.process_pool import run_trials
    from zscout.lab.study.scheduling.summary import Study
    from zscout.lab.study.scheduling.tables import print_report

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
        from zscout.lab.plots.scheduling import record

        record(rrd, report, result.curves)
    _show(dataclasses.asdict(report), rrd, partial(print_report, report), as_json=as_json)


@study.command()
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
    who never book. docs/study.md says what was found.

    \b
    Examples:
      zscout study bookings
      zscout study bookings --family load65 --seeds 50 --json
    """
    chosen = list(dict.fromkeys(families)) or list(DEFAULT_FAMILIES)
    trials = len(chosen) * len(SHARES) * len(seeds)
    if trials > MAX_SCHEDULES:
        raise BadInput(f"--seeds: {trials} trials are more than {MAX_SCHEDULES}; ask for fewer seeds or families")
    from zscout.lab.study.process_pool import run_trials
    from zscout.lab.study.scheduling import bookings as study_of
    from zscout.lab.study.scheduling.tables import print_bookings

    found: list[study_of.BookingTrial] = []
    common.run(run_trials(study_of.run, study_of.jobs(chosen, seeds), processes, found.append))
    report = study_of.report(found)
    _show(dataclasses.asdict(report), None, partial(print_bookings, report), as_json=as_json)


@study.command()
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
    docs/study.md says what was found.

    \b
    Examples:
      zscout study forecasts
      zscout study forecasts --family load65 --family bursts --seeds 20
      zscout study forecasts --exact --strategy priority --json
    """
    chosen = list(dict.fromkeys(families)) or [name for name, family in FAMILIES.items() if not family.at_once]
    from zscout.lab.study.process_pool import run_trials
    from zscout.lab.study.scheduling import forecasts as study

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


@study.command()
@seeds_option("5", "Runs of each kind: so many, or those of seeds A to B.", MAX_SEEDS)
@common.json_option("Print one JSON object instead of tables.")
@rrd_option(what=" of the load curves")
def placement(seeds: range, as_json: bool, rrd: Path | None) -> None:
    """Compares how the load balancer's policies and metrics place components, on simulated hosts.

    Three Place Sensor Nets on three workstations, started at once and a minute apart (Figure 3 of the paper),
    under every policy; a mixed batch on machines of unlike speed and memory under every metric; and what
    metric `auto` learns where one figure decides. A seed gives the same on every machine. docs/placement.md
    says what was found.

    \b
    Examples:
      zscout study placement
      zscout study placement --seeds 50 --json
      zscout study placement --rrd placement.rrd && zscout view placement.rrd
    """
    check_rrd(rrd)
    from zscout.lab.study.placement.study import parts
    from zscout.lab.study.placement.study import study as compare
    from zscout.lab.study.placement.tables import print_report

    with terminal.progress(len(seeds) * parts()) as advance:
        report, outcomes = compare(seeds, advance)
    if rrd is not None:
        from zscout.lab.plots.placement import record

        record(rrd, report, outcomes)
    _show(dataclasses.asdict(report), rrd, partial(print_report, report), as_json=as_json)


@study.command()
@seeds_option("2", "Runs of each kind in each building: so many, or those of seeds A to B.", MAX_SEEDS)
@numbers_option("--robots", 1, MAX_CREW, "How many robots, as in 1-4,8. Default: 1,2,4,6,8.")
@numbers_option("--channels", 1, MAX_CREW, "How many video channels, with a framegrabber each. Default: 1-4.")
@numbers_option("--framegrabbers", 1, 4, "How many framegrabbers for four robots and four channels. Default: 1-4.")
@numbers_option("--baud", MIN_BAUD, MAX_BAUD, "Rates of the radio. Default: 300,600,1200,2400,9600.")
@numbers_option("--slot", 1, MAX_SLOT, "Seconds of a robot's turn to hide in. Default: 30,60,90.")
@click.option(
    "--building",
    "buildings",
    multiple=True,
    metavar="NAME|FILE",
    help="One that is shipped, `drawn` (another one for each seed), or a TOML file; repeat it for several. "
    "Default: all shipped, and drawn.",
)
@click.option(
    "--seconds", type=seconds_within(1, 3_600), default="180", help="Of the building, that each run takes: 90s, 5m."
)
@click.option(
    "--starts",
    type=click.IntRange(1, MAX_SEEDS),
    help="Instead: so many random starts of one robot in each building, 120 s each.",
)
@jobs_option
@common.json_option("Print one JSON object instead of tables; it has every run as well.")
@rrd_option("--record", what=" of plots")
@click.option(
    "--svg",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="FOLDER",
    help="Write the plots as SVG files into this folder besides.",
)
def robots(
    seeds: range,
    robots: list[int] | None,
    channels: list[int] | None,
    framegrabbers: list[int] | None,
    baud: list[int] | None,
    slot: list[int] | None,
    buildings: tuple[str, ...],
    seconds: float,
    starts: int | None,
    processes: int | None,
    as_json: bool,
    rrd: Path | None,
    svg: Path | None,
) -> None:
    """Measures Place Sensor Net in simulated buildings: how soon robots are hidden, and what they then see.

    Against the number of robots and of video channels with a framegrabber each; against the number of
    framegrabbers, and the rate of the radio, with four robots and four channels; and against the length of their
    turns, with four robots on one channel. Whatever of --robots, --channels, --framegrabbers, --baud and --slot is
    given, only that is tried. Mind, votes and scheduling are those that run live; the mesh is left out, and time is
    virtual. docs/robots.md says what was found.

    \b
    Examples:
      zscout study robots --robots 2,4 --channels 1-2 --seeds 1
      zscout study robots --baud 300,9600 --building office --json
      zscout study robots --starts 40
      zscout study robots --rrd robots.rrd && zscout view robots.rrd
    """
    numbers = range(starts) if starts is not None else seeds
    check_rrd(rrd)
    from zscout.lab.study import robots as nets
    from zscout.lab.study.process_pool import run_trials
    from zscout.lab.study.robots_tables import print_report

    names = list(dict.fromkeys(buildings)) or nets.buildings()
    for name in names:
        # Those that are drawn have robots.
        if name != nets.DRAWN and not nets.plan_of(name, 0).robots and starts is not None:
            raise BadInput(f"--building {name}: there is no robot in it to start; add a [[robot]]")
    plan = nets.StudyPlan()
    if starts is None:
        plan = nets.StudyPlan.of(robots or [], channels or [], framegrabbers or [], baud or [], slot or [])
    planned = plan.jobs(names, numbers, seconds)
    if len(planned) > MAX_NETS:
        raise BadInput(f"--seeds: {len(planned)} runs are more than {MAX_NETS}; ask for fewer of something")
    trials: list[nets.RobotsTrial] = []
    common.run(run_trials(nets.run, planned, processes, trials.append))
    found = plan.report(trials)
    if rrd is not None:
        from zscout.lab.plots.robots import record

        record(rrd, found)
    if svg is not None:
        from zscout.lab.plots.robots_svg import write

        write(svg, found.grid, found.radio)
    # Not `asdict`: in Python 3.11 it takes counters apart.
    shown = {one.name: getattr(found, one.name) for one in dataclasses.fields(found)} | {"runs": trials}
    _show(shown, rrd, partial(print_report, found, names, len(numbers), seconds), as_json=as_json)


@study.command()
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
    for, or asks for everything besides: does it get more of use? docs/study.md says what was found.

    \b
    Examples:
      zscout study shares
      zscout study shares --seeds 1 --cases 10000 --json
    """
    from zscout.lab.study.process_pool import run_trials
    from zscout.lab.study.scheduling import shares as fair
    from zscout.lab.study.scheduling.tables import print_shares

    weeks: list[fair.WeekTrial] = []
    found: list[fair.CaseTrial] = []
    planned = [fair.Week(seed, on) for seed in seeds for on in (False, True)]
    common.run(run_trials(fair.play_week, planned, processes, weeks.append))
    if cases:
        common.run(run_trials(fair.play_case, range(cases), processes, found.append))
    report = fair.report(weeks, found)
    _show(dataclasses.asdict(report), None, partial(print_shares, report), as_json=as_json)


@study.command()
@seed_option("0-99", "One run, with its transcript; or those of seeds A to B.", MAX_FAULT_RUNS)
@click.option("--runs", type=click.IntRange(1, MAX_FAULT_RUNS), help="So many runs, from the first seed on.")
@click.option("--without", "guard", metavar="GUARD", help="Takes a guard of the protocol out (docs/promises.md).")
@click.option("--bookings", is_flag=True, help="Only runs in which programs book; --runs counts these.")
@jobs_option
@common.json_option("Print one JSON object instead of tables.")
def faults(
    seeds: range, runs: int | None, guard: str | None, bookings: bool, processes: int | None, as_json: bool
) -> int:
    """Runs a whole fleet under faults in virtual time, and checks every promise (docs/promises.md).

    Candidates, RCs and clients as they are, on a mesh in memory: messages of each kind lost, late, twice;
    partitions, freezes, crashes, clocks that run apart. Every tenth run is one of 5 minutes with 20 programs,
    in every tenth nothing fails but nodes, in the steps of a component's move, and in every fifth programs book.
    One seed is one run, to the byte. Where a promise breaks, `--seed A` leaves out faults until no more can
    be left out, and prints what happened. Exit code 1: a promise was not kept.

    \b
    Examples:
      zscout study faults --runs 1000
      zscout study faults --seed 2000-2999 --json
      zscout study faults --seed 17
      zscout study faults --runs 200 --without promise
      zscout study faults --runs 1000 --bookings
    """
    from zscout.lab.faults.guards import GUARDS, without
    from zscout.lab.faults.runs import FaultRun, FaultStudy, print_report, run, shrink
    from zscout.lab.faults.simulation import Size, simulate

    if runs is not None:
        wanted = (seed for seed in count(seeds[0]) if not bookings or Size.of(seed).bookers)
        chosen = list(islice(wanted, runs))
    else:
        chosen = [seed for seed in seeds if not bookings or len(seeds) == 1 or Size.of(seed).bookers]
    if guard is not None and guard not in GUARDS:
        raise BadInput(f"--without {quoted(guard)}: there is no such guard; write one of: {', '.join(GUARDS)}")
    if not chosen:
        raise BadInput("--seed: in none of these runs programs book; write more, or leave out --bookings")
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
    from zscout.lab.study.process_pool import run_trials

    found = FaultStudy()

    def take(one: FaultRun) -> None:
        found.add(one)
        for text in one.broken[:1]:  # at once: thousands of runs take an hour
            terminal.print_line(f"seed {one.seed} BROKEN {text}", sys.stderr)

    common.run(run_trials(partial(run, guard=guard), chosen, processes, take))
    # Not `asdict`: in Python 3.11 it takes counters apart.
    _show(vars(found), None, partial(print_report, found), as_json=as_json)
    return 1 if found.broken else 0


def _show(report: Any, rrd: Path | None, print_report: Callable[[], None], *, as_json: bool) -> None:
    """One JSON object of it; else its tables, and how to look at the recording."""
    if as_json:
        terminal.print_json(report)
        return
    print_report()
    if rrd is not None:
        terminal.print_line(f"\nRecording: {rrd} (zscout view {rrd})")
