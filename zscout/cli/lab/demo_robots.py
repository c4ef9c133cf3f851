"""`zscout demo robots`: Place Sensor Net in a simulated building, with an operator who takes over in it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from zscout.cli import common
from zscout.cli.lab.demo_screen import DemoScreen, how_to_view, recording_option
from zscout.cli.lab.simulate import Building
from zscout.config.strict import BadInput
from zscout.lab.building.plan_file import plan_named

if TYPE_CHECKING:
    from rich.console import Group

    from zscout.lab.demo.robots_run import RobotsDemo, RobotsObserved

LINES: Final = 12
"""Events shown below the table at most."""
ABOVE: Final = 7
"""Lines of the picture that are neither robots nor events."""
HARDWARE: Final = "2 framegrabbers, 1 radio, 3 nodes"
STYLES: Final = {
    "search": "yellow",
    "approach": "bright_yellow",
    "enter": "bright_yellow",
    "unstick": "red",
    "turn": "cyan",
    "hidden": "green",
    "watch": "bold green",
    "alert": "bold white on red",
    "wait": "bright_black",
    "lost": "bold red",
}
"""What a robot does."""


@click.command()
@click.option(
    "--building",
    type=Building(),
    metavar="BUILDING",
    default="living_room",
    show_default=True,
    help="As in zscout simulate: a name, a TOML file, or random:SEED.",
)
@click.option(
    "--seed", type=click.IntRange(0), default=1, show_default=True, help="Of noise, slip and people."
)
@click.option(
    "--speed",
    type=click.FloatRange(0.2, 4.0),
    default=1.5,
    show_default=True,
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
    return common.run(_demo(building, seed, speed, out, as_json=as_json))


async def _demo(building: str, seed: int, speed: float, out: Path | None, *, as_json: bool) -> int:
    # Known to be good before anything is started.
    ids = {f"robot/{robot.name}": robot.id for robot in plan_named(building).robots}
    if not ids:
        raise BadInput(f"--building {building}: there is no robot in it; add a [[robot]]")
    # Zenoh is loaded here: the help needs none of it.
    from zscout.lab.demo.robots_run import RobotsDemo

    began = time.monotonic()
    screen = DemoScreen(as_json=as_json, decimals=1)
    screen.print_line(f"{_title(building, speed, len(ids))}; {HARDWARE}; starting")
    demo, path = await screen.play(
        lambda folder: RobotsDemo(folder, building, ids, seed=seed, speed=speed, show=screen.show),
        lambda demo: _picture(demo, screen),
        out,
    )
    took = time.monotonic() - began
    if as_json:
        common.print_json(demo.seen.summary() | {"recording": str(path), "seconds": round(took, 1)})
    else:
        _report(demo.seen, took, path)
    return 0 if demo.seen.placed_at is not None else 1


def _title(building: str, speed: float, robots: int) -> str:
    pace = "in real time" if speed == 1 else f"{speed:g} times as fast as real time"
    return f"Place Sensor Net, {_many(robots, 'robot')} in {building}, {pace}"


def _many(number: int, what: str) -> str:
    return f"{number} {what}" + ("s" if number != 1 else "")


def _report(seen: RobotsObserved, took: float, path: Path) -> None:
    figures = seen.summary()
    median, longest = figures["median_wait"], figures["longest_wait"]
    rows = [
        ["hidden", f"{len(seen.hidden)} of {len(seen.robots)}, in truly dark places {len(seen.truly)}"],
        ["all hidden after", f"{seen.placed_at:.0f} s" if seen.placed_at is not None else "never"],
        ["alerts", str(seen.alerts)],
        ["holds", f"{seen.grants}, of which {seen.turns} ended by another's turn"],
        ["preemptions", str(seen.preemptions)],
        ["waits", f"{figures['waits']}, median {median:.1f} s, longest {longest:.1f} s"],
        ["operator's takeover", _takeover(seen)],
        ["the building's time", f"{seen.simulated:.0f} s, in {took:.0f} s of ours"],
    ]
    common.print_line("")
    common.print_table(["", ""], rows, title="Place Sensor Net")
    common.print_line("")
    for words in how_to_view(path):
        common.print_line(words)


def _takeover(seen: RobotsObserved) -> str:
    if seen.takeover is None:
        return "did not come to pass"
    words = f"{seen.taken} obeyed {1000 * seen.takeover:.0f} ms after the key"
    return words + (f", went on {seen.resumed_after:.1f} s after" if seen.resumed_after is not None else "")


def _picture(demo: RobotsDemo, screen: DemoScreen) -> Group:
    """What each robot does, and the latest events."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    seen = demo.seen
    title = _title(demo.building, demo.speed, len(demo.robots))
    head = Text(title, style="bold", overflow="ellipsis", no_wrap=True)
    # A picture that is higher than the terminal can't be drawn over.
    shown = max(1, min(LINES, common.console().height - ABOVE - len(seen.robots)))
    at = "starting"
    if demo.zero is not None:
        at = f"{demo.elapsed():5.1f} s, building {seen.simulated:5.0f} s"
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("robot", "does", "truly dark"):
        table.add_column(column, header_style="bold")
    for robot in seen.robots:
        doing = "operator" if robot == demo.driven else seen.doing.get(robot, "")
        style = "bold magenta" if doing == "operator" else STYLES.get(doing, "")
        table.add_row(robot, Text(doing, style=style), "yes" if robot in seen.truly else "")
    counts = f"{len(seen.hidden)} hidden, {len(seen.watching)} watching, "
    counts += f"{_many(seen.alerts, 'alert')}, {_many(seen.preemptions, 'preemption')}"
    return Group(
        head, Text(f"{HARDWARE}; {at}"), Text(""), table, Text(counts), Text(""), *screen.latest(shown)
    )
