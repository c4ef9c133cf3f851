"""`zscout demo`: what zscout does, on a live mesh on this machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from zscout.cli import common
from zscout.cli.lab.options import DefaultGroup
from zscout.cli.lab.simulate import BUILDING, buildings
from zscout.config.strict import BadInput
from zscout.types import POLICIES, Policy

SCENARIOS: Final = ("at-once", "staggered")

F = TypeVar("F", bound=Callable[..., Any])


@click.group(cls=DefaultGroup, default="robots")
def demo() -> None:
    """Show what zscout does on a live mesh on this machine; `robots` unless another one is named.

    \b
    Examples:
      zscout demo
      zscout demo table1 --out demo.rrd
      zscout demo placement
    """


def recording_option(command: F) -> F:
    """`--out FILE`."""
    return click.option(
        "--out", metavar="FILE", type=click.Path(path_type=Path), help="The recording. Default: runs/demo-….rrd"
    )(command)


@demo.command()
@click.option(
    "--building",
    type=BUILDING,
    shell_complete=buildings,
    metavar="BUILDING",
    default="living_room",
    help="As in zscout simulate: a name, a TOML file, or random:SEED.",
)
@click.option("--seed", type=click.IntRange(0), default=1, help="Of noise, slip and people.")
@click.option(
    "--speed",
    type=click.FloatRange(0.2, 4.0),
    default=1.5,
    help="How many of the building's seconds pass in one of ours.",
)
@recording_option
@common.json_option("Print the summary as one JSON object.")
def robots(building: str, seed: int, speed: float, out: Path | None, as_json: bool) -> int:
    """Hide the robots of a building in the dark, and have them watch.

    There are four of them, two framegrabbers and one radio. It serves a simulated building, starts three
    nodes with its devices on this machine, apart from every other fleet, and has the component placer place
    a sensor net. In the middle an operator takes one robot, drives it and gives it back. It ends when all
    robots are hidden and somebody has walked by, or a minute of the building later, at the latest after two
    and a half minutes of ours. It leaves nothing but a recording; so does Ctrl-C.

    Exit code: 0 all robots came to be hidden; 1 not all of them did.

    \b
    Examples:
      zscout demo robots
      zscout demo robots --building office --speed 1 --out office.rrd
    """
    common.check_recording("--out", out)
    # Zenoh is loaded here: the help needs none of it.
    from zscout.lab.demo.robots_screen import play

    return common.run(play(building, seed, speed, out, as_json=as_json))


@demo.command()
@recording_option
@common.json_option("Print the tables as JSON.")
def table1(out: Path | None, as_json: bool) -> int:
    """Play Table 1 of the paper on a live mesh, and compare what happens with Table 2.

    It starts three nodes with four devices and five programs on this machine, apart from every other fleet,
    for about 25 seconds, and records them. Nothing is left but the recording. Exit code 1: not all came in
    the order of Table 2; cells that are only late, on a busy machine, are named.

    \b
    Examples:
      zscout demo table1
      zscout demo table1 --out demo.rrd --json
    """
    common.check_recording("--out", out)
    from zscout.lab.demo.table1_screen import play

    return common.run(play(out, as_json=as_json))


@demo.command()
@click.option(
    "--policy",
    "policies",
    multiple=True,
    type=click.Choice(POLICIES),
    help="A policy; repeat it for several. Default: all.",
)
@click.option(
    "--when",
    "scenarios",
    multiple=True,
    type=click.Choice(SCENARIOS),
    help="All components at once, or net by net. Default: both.",
)
@click.option(
    "--out",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="Keep a Rerun recording of each trial there.",
)
@common.json_option("Print one JSON object.")
def placement(policies: tuple[Policy, ...], scenarios: tuple[str, ...], out: Path | None, as_json: bool) -> int:
    """Place three Place Sensor Nets on three live nodes under each policy (Figure 3 of the paper).

    Each trial starts three nodes on this machine, apart from every other fleet; each reports the load of what
    it started itself. Twelve components, which really use the processor, are started all at once or net by
    net. A trial takes about 12 seconds. Exit code 1: `pending` did not come within one component of even, or
    a policy that was given time did not use all hosts.

    \b
    Examples:
      zscout demo placement
      zscout demo placement --policy least_loaded --policy pending --when at-once
      zscout demo placement --out runs/figure3 --json
    """
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(f"--out {out}: can't be made ({error.strerror}); give another folder") from None
    from zscout.lab.demo.placement_run import play

    # In the order in which the options list them.
    chosen = [
        (scenario, policy)
        for scenario in SCENARIOS
        if scenario in (scenarios or SCENARIOS)
        for policy in POLICIES
        if policy in (policies or POLICIES)
    ]
    return common.run(play(chosen, out, as_json=as_json))
