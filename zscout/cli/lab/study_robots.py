"""`zscout study robots`: sensor nets of simulated Scouts with few and many robots, channels, and radio."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from zscout.cli import common
from zscout.cli.lab.study_options import (
    check_recording,
    jobs_option,
    parse_seeds,
    print_recording,
    rrd_option,
    run_trials,
    seeds_option,
)
from zscout.config.strict import BadInput, quoted

if TYPE_CHECKING:
    from zscout.lab.study.robots import FieldFigures, Quantiles, RobotsReport, RobotsTrial

MAX_SEEDS: Final = 1_000
MAX_TRIALS: Final = 5_000
"""At ten seconds each they take half a day."""
MAX_LISTED: Final = 64
MAX_CREW: Final = 16
MAX_BAUD: Final = 1_000_000
MIN_BAUD: Final = 110
MAX_SLOT: Final = 3_600


@click.command()
@seeds_option("2", "Runs of each kind in each building: so many, or those of seeds A to B.")
@click.option("--robots", metavar="LIST", help="How many robots, as in 1-4,8. Default: 1,2,4,6,8.")
@click.option("--channels", metavar="LIST", help="How many video channels and framegrabbers. Default: 1-4.")
@click.option("--baud", metavar="LIST", help="Rates of the radio. Default: 300,600,1200,2400,9600.")
@click.option("--slot", metavar="LIST", help="Seconds of a robot's turn to hide in. Default: 30,60,90.")
@click.option(
    "--building",
    "buildings",
    multiple=True,
    metavar="NAME|FILE",
    help="One that is shipped, `drawn` (another one for each seed), or a TOML file; repeat it for several. "
    "Default: all shipped, and drawn.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(1, 3_600),
    default=180.0,
    show_default=True,
    help="Of the building, that each run takes.",
)
@click.option(
    "--starts",
    type=click.IntRange(1, MAX_SEEDS),
    help="Instead: so many random starts of one robot in each building, 120 s each.",
)
@jobs_option
@common.json_option("Print one JSON object instead of tables; it has every run as well.")
@rrd_option("--record", what="of plots")
@click.option(
    "--svg",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="FOLDER",
    help="Write the plots as SVG files into this folder besides.",
)
def robots(
    seeds: str,
    robots: str | None,
    channels: str | None,
    baud: str | None,
    slot: str | None,
    buildings: tuple[str, ...],
    seconds: float,
    starts: int | None,
    processes: int | None,
    as_json: bool,
    rrd: Path | None,
    svg: Path | None,
) -> None:
    """Measures Place Sensor Net in simulated buildings: how soon robots are hidden, and what they then see.

    Against the number of robots and of video channels with a framegrabber each; against the rate of the
    radio, with four robots and four channels; and against the length of their turns, with four robots on one
    channel. Whatever of --robots, --channels, --baud and --slot is given, only that is tried. Mind, votes and
    scheduling are those that run live; the mesh is left out, and time is virtual. docs/robots.md says what
    was found.

    \b
    Examples:
      zscout study robots --robots 2,4 --channels 1-2 --seeds 1
      zscout study robots --baud 300,9600 --building office --json
      zscout study robots --starts 40
      zscout study robots --rrd robots.rrd && zscout view robots.rrd
    """
    crews = _numbers("--robots", robots, 1, MAX_CREW)
    channel_counts = _numbers("--channels", channels, 1, MAX_CREW)
    bauds = _numbers("--baud", baud, MIN_BAUD, MAX_BAUD)
    slots = _numbers("--slot", slot, 1, MAX_SLOT)
    numbers = range(starts) if starts is not None else parse_seeds(seeds)
    if len(numbers) > MAX_SEEDS:
        raise BadInput(f"--seeds: {len(numbers)} are more than {MAX_SEEDS}; ask for fewer")
    check_recording(rrd)
    from zscout.lab.study import robots as study

    names = list(dict.fromkeys(buildings)) or study.buildings()
    for name in names:
        # Those that are drawn have robots.
        if name != study.DRAWN and not study.plan_of(name, 0).robots and starts is not None:
            raise BadInput(f"--building {name}: there is no robot in it to start; add a [[robot]]")
    plan = study.StudyPlan.of(crews, channel_counts, bauds, slots) if starts is None else study.StudyPlan()
    planned = plan.jobs(names, numbers, seconds)
    if len(planned) > MAX_TRIALS:
        raise BadInput(f"--seeds: {len(planned)} runs are more than {MAX_TRIALS}; ask for fewer of something")
    trials: list[RobotsTrial] = []
    common.run(run_trials(study.run, planned, processes, trials.append))
    found = plan.report(trials)
    if rrd is not None:
        from zscout.lab.plots.robots import record

        record(rrd, found.grid, found.radio, found.turns, found.starts)
    if svg is not None:
        from zscout.lab.plots.robots_svg import write

        write(svg, found.grid, found.radio)
    if as_json:
        shown = dataclasses.asdict(found)
        common.print_json({**shown, "runs": [dataclasses.asdict(trial) for trial in trials]})
        return
    _print(found, names, len(numbers), seconds)
    print_recording(rrd)


def _numbers(option: str, text: str | None, low: int, high: int) -> list[int]:
    """`1-4,8` is 1, 2, 3, 4 and 8; nothing is nothing. Raises BadInput."""
    if text is None:
        return []
    listed: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        ends = [first, last] if dash else [first, first]
        if not all(end.isascii() and end.isdigit() and len(end) <= 7 for end in ends):
            raise BadInput(f"{option} {quoted(text)}: write numbers and ranges of them, as in 1-4,8")
        begin, end = int(ends[0]), int(ends[1])
        if not low <= begin <= end <= high:
            raise BadInput(
                f"{option} {quoted(text)}: {quoted(part)} is not within {low} to {high}, or backwards"
            )
        if len(listed) + end - begin >= MAX_LISTED:
            raise BadInput(f"{option} {quoted(text)}: these are more than {MAX_LISTED} numbers; give fewer")
        listed += range(begin, end + 1)
    return list(dict.fromkeys(listed))


# For people

COLUMNS: Final = (
    "all placed (10-90 %)",
    "placed",
    "truly dark",
    "walks noticed",
    "crossings in 1 s",
    "false/h",
    "preempted",
    "unheld",
    "stands in",
)


def _print(found: RobotsReport, names: Sequence[str], seeds: int, seconds: float) -> None:
    where = f"{seconds:g} s, {seeds} seed{'s' * (seeds != 1)} in each of {', '.join(names)}"
    radio, turns = found.radio[:1], found.turns[:1]
    tables: list[tuple[str, tuple[str, ...], list[FieldFigures]]] = [
        (f"Robots and video channels: {where}", ("robots", "channels"), found.grid),
        (f"The radio, {_means(radio)}: {where}", ("baud", "command_rate"), found.radio),
        (f"Turns, {_means(turns)}: {where}", ("slot",), found.turns),
    ]
    tables = [table for table in tables if table[2]]
    for number, (title, keys, figures) in enumerate(tables):
        if number:
            common.print_line("")
        common.print_table(
            [*(key.replace("command_rate", "commands/s") for key in keys), *COLUMNS],
            [[*(f"{getattr(one, key):g}" for key in keys), *_cells(one)] for one in figures],
            title=title,
        )
    if found.starts:
        common.print_table(
            ["building", "starts", "truly dark", "and facing the light", "seconds (10-90 %)", "bumps"],
            [
                [
                    one.building,
                    str(one.starts),
                    f"{one.dark} ({one.dark / one.starts:.0%})",
                    f"{one.good} ({one.good / one.starts:.0%})",
                    spread_text(one.seconds),
                    f"{one.bumped:.1f} s",
                ]
                for one in found.starts
            ],
            title="One robot, random starts: hidden within 120 s",
        )


def _means(figures: Sequence[FieldFigures]) -> str:
    """`4 robots, 1 channel`; nothing for none."""
    return "".join(
        f"{one.robots} robots, {one.channels} channel{'s' * (one.channels != 1)}" for one in figures
    )


def _cells(one: FieldFigures) -> list[str]:
    return [
        spread_text(one.all_placed),
        percent(one.placed),
        percent(one.dark),
        f"{percent(one.noticed)} of {one.walks}",
        f"{percent(one.alerted)} of {one.crossings}",
        "-" if math.isnan(one.false_alarms) else f"{one.false_alarms:.1f}",
        f"{one.preemptions:.1f}",
        f"{one.turned_unheld:.1f} s",
        f"{one.longest_stop:.1f} s",
    ]


def percent(share: float) -> str:
    """`95 %`, or a dash where there was nothing to have a share of."""
    return "-" if math.isnan(share) else f"{share:.0%}"


def spread_text(spread: Quantiles) -> str:
    """`41 s (30-77)`; what never came to an end is `never`."""
    if math.isnan(spread.median):
        return "-"
    low, median, high = (
        f"{value:.0f}" if math.isfinite(value) else "never"
        for value in (spread.low, spread.median, spread.high)
    )
    return f"{median}{' s' * (median != 'never')} ({low}-{high})"
