"""`zscout demo robots`: Place Sensor Net in a simulated building, with an operator who takes over in it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from zscout import clock
from zscout.cli import common
from zscout.cli.demo.recording import keep, look_at, recording, recording_option
from zscout.cli.simulate import Building, named_plan
from zscout.scheduling.model import SECOND
from zscout.strict import BadInput

if TYPE_CHECKING:
    from zscout.cli.demo.robots_run import RobotsDemo, Seen

FRAMES: Final = 4
"""Drawings a second at a terminal."""
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
    ids = {f"robot/{robot.name}": robot.id for robot in named_plan(building).robots}
    if not ids:
        raise BadInput(f"--building {building}: there is no robot in it; add a [[robot]]")
    # Zenoh is loaded here: the help needs none of it.
    from zscout.cli.demo.robots_run import RobotsDemo

    events: list[tuple[float, str]] = []
    plain = not as_json and not common.at_terminal()

    def tell(at: float, text: str) -> None:
        events.append((at, text))
        if plain:
            common.print_line(f"{at:6.1f} s  {common.clean(text)}")

    began = clock.now()
    if plain:
        common.print_line(f"{_title(building, speed, len(ids))}; {HARDWARE}; starting")
    with recording(out) as path, tempfile.TemporaryDirectory(prefix="zscout-demo-") as folder:
        demo = RobotsDemo(Path(folder), building, ids, seed=seed, speed=speed, tell=tell)
        try:
            # The picture stays until all processes have ended: that takes some seconds.
            with _picture(demo, events, hidden=plain or as_json):
                async with demo:
                    await demo.run()
        except BaseException:
            if keep(Path(folder), path):
                click.echo(f"the recording until then: {path}", err=True)
            raise
        keep(Path(folder), path)
    took = (clock.now() - began) / SECOND
    if as_json:
        common.print_json(summary(demo.seen) | {"recording": str(path), "seconds": round(took, 1)})
    else:
        _report(demo.seen, took, path)
    return 0 if demo.seen.placed_at is not None else 1


def _title(building: str, speed: float, robots: int) -> str:
    pace = "in real time" if speed == 1 else f"{speed:g} times as fast as real time"
    return f"Place Sensor Net, {_many(robots, 'robot')} in {building}, {pace}"


def _many(number: int, what: str) -> str:
    return f"{number} {what}" + ("s" if number != 1 else "")


def summary(seen: Seen) -> dict[str, Any]:
    """What came of it, for programs."""
    waits = sorted(seen.waits)
    return {
        "robots": len(seen.robots),
        "hidden": sorted(seen.hidden),
        "truly_dark": sorted(seen.truly),
        "placed_after": seen.placed_at,
        "alerts": seen.alerts,
        "grants": seen.grants,
        "turns": seen.turns,
        "preemptions": seen.preemptions,
        "waits": len(waits),
        "longest_wait": waits[-1] if waits else 0.0,
        "median_wait": waits[len(waits) // 2] if waits else 0.0,
        "takeover": seen.takeover,
        "taken": seen.taken,
        "resumed_after": seen.resumed_after,
        "simulated": seen.simulated,
    }


def _report(seen: Seen, took: float, path: Path) -> None:
    told = summary(seen)
    rows = [
        ["hidden", f"{len(seen.hidden)} of {len(seen.robots)}, in truly dark places {len(seen.truly)}"],
        ["all hidden after", f"{seen.placed_at:.0f} s" if seen.placed_at is not None else "never"],
        ["alerts", str(seen.alerts)],
        ["holds", f"{seen.grants}, of which {seen.turns} ended by another's turn"],
        ["preemptions", str(seen.preemptions)],
        [
            "waits",
            f"{told['waits']}, median {told['median_wait']:.1f} s, longest {told['longest_wait']:.1f} s",
        ],
        ["operator's takeover", _takeover(seen)],
        ["the building's time", f"{seen.simulated:.0f} s, in {took:.0f} s of ours"],
    ]
    common.print_line("")
    common.print_table(["", ""], rows, title="Place Sensor Net")
    common.print_line("")
    for words in look_at(path):
        common.print_line(words)


def _takeover(seen: Seen) -> str:
    if seen.takeover is None:
        return "did not come to pass"
    words = f"{seen.taken} obeyed {1000 * seen.takeover:.0f} ms after the key"
    return words + (f", went on {seen.resumed_after:.1f} s after" if seen.resumed_after is not None else "")


@contextmanager
def _picture(demo: RobotsDemo, events: list[tuple[float, str]], *, hidden: bool) -> Iterator[None]:
    """At a terminal, what each robot does, and the latest events."""
    if hidden:
        yield
        return
    from rich.console import Group
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    def draw() -> Group:
        seen = demo.seen
        elapsed = (clock.now() - demo.zero) / SECOND if demo.zero is not None else None
        console = common.console()
        title = _title(demo.building, demo.speed, len(demo.robots))
        head = Text(title, style="bold", overflow="ellipsis", no_wrap=True)
        # A picture that is higher than the terminal can't be drawn over.
        shown = max(1, min(LINES, console.height - ABOVE - len(seen.robots)))
        at = "starting" if elapsed is None else f"{elapsed:5.1f} s, building {seen.simulated:5.0f} s"
        table = Table(box=None, padding=(0, 2, 0, 0))
        for column in ("robot", "does", "truly dark"):
            table.add_column(column, header_style="bold")
        for robot in seen.robots:
            doing = "operator" if robot == demo.driven else seen.doing.get(robot, "")
            style = "bold magenta" if doing == "operator" else STYLES.get(doing, "")
            table.add_row(robot, Text(doing, style=style), "yes" if robot in seen.truly else "")
        counts = f"{len(seen.hidden)} hidden, {len(seen.watching)} watching, "
        counts += f"{_many(seen.alerts, 'alert')}, {_many(seen.preemptions, 'preemption')}"
        latest = [
            Text(f"{at:6.1f} s  {common.clean(text)}", overflow="ellipsis", no_wrap=True)
            for at, text in events[-shown:]
        ]
        return Group(head, Text(f"{HARDWARE}; {at}"), Text(""), table, Text(counts), Text(""), *latest)

    with Live(get_renderable=draw, console=common.console(), refresh_per_second=FRAMES, transient=True):
        yield
