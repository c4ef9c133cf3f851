"""The study of robots as a command."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Final

import click

from studies.options import MAX_SEEDS, jobs_option, numbers_option, seeds_option, show
from zscout.cli import common
from zscout.cli.requests.options import seconds_within
from zscout.cli.simulation.options import check_rrd, rrd_option
from zscout.config.strict import BadInput

MAX_NETS: Final = 5_000
"""Most runs: at ten seconds each they take half a day."""
MAX_CREW: Final = 16
MAX_BAUD: Final = 1_000_000
MIN_BAUD: Final = 110
MAX_SLOT: Final = 3_600


@click.command()
@seeds_option("2", "Runs of each kind in each building: a number, or a range of seeds A-B.", MAX_SEEDS)
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
    help="A shipped building, `drawn` (a random building for each seed), or a TOML file; repeat it for several. "
    "Default: all shipped, and drawn.",
)
@click.option("--seconds", type=seconds_within(1, 3_600), default="180", help="Virtual time of each run: 90s, 5m.")
@click.option(
    "--starts",
    type=click.IntRange(1, MAX_SEEDS),
    help="Instead: this number of random starts of one robot in each building, 120 s each.",
)
@jobs_option
@common.json_option("Print one JSON object instead of tables; it has every run as well.")
@rrd_option("--record", what=" of plots")
@click.option(
    "--svg",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="FOLDER",
    help="Also write the plots as SVG files into this folder.",
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
    """Measure Place Sensor Net in simulated buildings: how soon robots are hidden, and how much they then see.

    By number of robots and of video channels with a framegrabber each; by number of framegrabbers, and by rate of
    the radio, with four robots and four channels; and by length of the turns, with four robots on one channel. If
    any of --robots, --channels, --framegrabbers, --baud and --slot is given, only these are tried. Controllers, votes
    and scheduling are the real code; the mesh is left out, and time is virtual. The results are in docs/evaluation.

    \b
    Examples:
      python -m studies robots --robots 2,4 --channels 1-2 --seeds 1
      python -m studies robots --baud 300,9600 --building office --json
      python -m studies robots --starts 40
      python -m studies robots --rrd robots.rrd && zscout view robots.rrd
    """
    numbers = range(starts) if starts is not None else seeds
    check_rrd(rrd)
    from studies.process_pool import run_trials
    from studies.robots import study as nets
    from studies.robots.tables import print_report

    names = list(dict.fromkeys(buildings)) or nets.buildings()
    for name in names:
        # Drawn buildings have robots.
        if name != nets.DRAWN and not nets.plan_of(name, 0).robots and starts is not None:
            raise BadInput(f"--building {name}: it has no robot to start; add a [[robot]]")
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
        from studies.robots.plots import record

        record(rrd, found)
    if svg is not None:
        from studies.robots.svg import write

        write(svg, found.grid, found.radio)
    # Not `asdict`, which fails on counters in Python 3.11.
    shown = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)} | {"runs": trials}
    show(shown, rrd, partial(print_report, found, names, len(numbers), seconds), as_json=as_json)
