"""`zscout simulate`: a building with robots, served so that drivers cannot tell it from a real one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

import click
from click.shell_completion import CompletionItem

from zscout.cli import common
from zscout.cli.requests.options import SECONDS
from zscout.config.strict import BadInput, quoted
from zscout.simulation.building.plan_file import MAX_SEED, RANDOM, known_buildings, plan_named, shipped_plans

BUILDING: Final = common.Parsed("building", lambda text, _: text)
MAX_FRAMEGRABBERS: Final = 16
_ADDRESS: Final = re.compile(r"(?:(?P<host>\[[0-9a-fA-F:.]+\]|[^:\[\]]+):)?(?P<port>[0-9]{1,5})")


def buildings(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete a building: names of the shipped buildings, and files."""
    names = [name for name in (*shipped_plans(), f"{RANDOM}:1") if name.startswith(incomplete)]
    return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


def parse_address(text: str, option: str) -> tuple[str, int]:
    """Parse `HOST:PORT` or `PORT`. Raises BadInput."""
    found = _ADDRESS.fullmatch(text)
    if found is None or int(found["port"]) > 65_535:
        raise BadInput(f"{option}: {quoted(text)} is not an address; write HOST:PORT, as in 127.0.0.1:8080")
    return (found["host"] or "127.0.0.1").strip("[]"), int(found["port"])


@click.command()
@click.argument("building", type=BUILDING, required=False, shell_complete=buildings)
@click.option("--list", "listing", is_flag=True, help="List the shipped buildings, and end.")
@click.option(
    "--seed",
    type=click.IntRange(0, MAX_SEED),
    default=0,
    help="Seed of everything random: the same seed gives the same building and noise.",
)
@click.option(
    "--speed",
    type=click.FloatRange(0, 100, min_open=True),
    default=1.0,
    help="Seconds of the building in one real second.",
)
@click.option(
    "--frames",
    "frame_rate",
    type=click.FloatRange(0.1, 60),
    default=10.0,
    help="Pictures of each channel per second of the building.",
)
@click.option(
    "--http",
    metavar="HOST:PORT",
    type=common.Parsed("text", parse_address),
    default="127.0.0.1:0",
    help="Serve the cameras at this address; port 0 is any free port.",
)
@click.option("--channels", type=click.IntRange(1, 15), default=4, help="Number of video channels.")
@click.option(
    "--baud",
    type=click.IntRange(300, 1_000_000),
    default=9600,
    help="Rate of the radio's line; --speed makes the line faster as well.",
)
@click.option("--loss", type=click.FloatRange(0, 1), default=0.0, help="Share of the radio's packets that are lost.")
@click.option(
    "--radio",
    "radio_link",
    metavar="LINK",
    type=click.Path(path_type=Path),
    help="Create this symlink to the radio's port; it is removed at the end.",
)
@click.option(
    "--node",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write a node file with all the devices: zscout node FILE serves them.",
)
@click.option(
    "--framegrabbers",
    type=click.IntRange(1, MAX_FRAMEGRABBERS),
    default=2,
    help="Number of framegrabbers in the node file.",
)
@click.option("--mesh", is_flag=True, help="Publish positions on the mesh, for recorders and operators.")
@click.option("--for", "seconds", type=SECONDS, help="End after this time in the building: 90s. Default: at Ctrl-C.")
@common.json_option("Print how to reach everything as one JSON object.")
def simulate(building: str | None, listing: bool, mesh: bool, as_json: bool, **options: Any) -> None:
    """Serve a simulated building: a radio on a serial port, cameras as MJPEG over HTTP, in real time.

    BUILDING is the name of a shipped building (--list), a TOML file, or random:SEED for a random one. Packets over
    the radio control the robots; docs/simulation.md describes how realistic the simulation is, and how to write a
    building.

    \b
    Examples:
      zscout simulate --list
      zscout simulate living_room --node lab.toml --radio radio0 --mesh
      zscout simulate random:7 --speed 2 --http 127.0.0.1:8080 --loss 0.05
    """
    if listing:
        from zscout.simulation.building.simulate import print_shipped

        print_shipped(as_json=as_json)
        return
    if building is None:
        raise BadInput(f"no building is given; name one of {known_buildings()}, or a file")
    plan = plan_named(building)
    from zscout.simulation.building.simulate import simulate as serve

    fleet = common.the_fleet() if mesh else None
    common.run(serve(plan, mesh_of=fleet, fleet_file=common.fleet_file(), as_json=as_json, **options))
