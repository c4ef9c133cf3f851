"""`zscout demo robots` on the screen: activities of the robots, and the results."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from zscout import terminal
from zscout.config.strict import BadInput
from zscout.simulation.building.plan_file import plan_named
from zscout.simulation.demo.robots_run import RobotsDemo, RobotsObserved
from zscout.simulation.demo.screen import DemoScreen, LiveView, how_to_view

if TYPE_CHECKING:
    from rich.console import Group

LINES: Final = 12  # most events below the table
ABOVE: Final = 7  # lines of the picture that are neither robots nor events
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
    "present": "bold black on yellow",
    "wait": "bright_black",
    "lost": "bold red",
}  # by activity


async def play(
    building: str, seed: int, speed: float, out: Path | None, *, as_json: bool, live: LiveView | None = None
) -> int:
    """Play the demo; returns the exit code. Raises as `RobotsDemo` does, and BadInput."""
    ids = {f"robot/{robot.name}": robot.id for robot in plan_named(building).robots}
    if not ids:
        raise BadInput(f"--building {building}: there is no robot in it; add a [[robot]]")
    began = time.monotonic()
    screen = DemoScreen("robots", as_json=as_json, decimals=1, live=live)
    screen.begin(f"{_title(building, speed, len(ids))}; {HARDWARE}; starting")
    demo, path = await screen.play(
        lambda folder: RobotsDemo(
            folder, building, ids, seed=seed, speed=speed, show=screen.show, on_live=screen.on_live
        ),
        lambda demo: _picture(demo, screen),
        out,
    )
    took = time.monotonic() - began
    if as_json:
        terminal.print_json(demo.seen.summary() | {"recording": str(path), "seconds": round(took, 1)})
    else:
        _report(demo.seen, took, path)
    await screen.linger(path)
    return 0 if demo.seen.placed_at is not None else 1


def _title(building: str, speed: float, robots: int) -> str:
    pace = "in real time" if speed == 1 else f"{speed:g} times as fast as real time"
    return f"Place Sensor Net, {terminal.many(robots, 'robot')} in {building}, {pace}"


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
    terminal.print_line("")
    terminal.print_table(["", ""], rows, title="Place Sensor Net")
    terminal.print_line("")
    for words in how_to_view(path):
        terminal.print_line(words)


def _takeover(seen: RobotsObserved) -> str:
    if seen.takeover is None:
        return "did not come to pass"
    words = f"{seen.taken} obeyed {1000 * seen.takeover:.0f} ms after the key"
    return words + (f", continued {seen.resumed_after:.1f} s after" if seen.resumed_after is not None else "")


def _picture(demo: RobotsDemo, screen: DemoScreen) -> Group:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    seen = demo.seen
    title = _title(demo.building, demo.speed, len(demo.robots))
    head = Text(title, style="bold", overflow="ellipsis", no_wrap=True)
    # A picture higher than the terminal can't be drawn over.
    shown = max(1, min(LINES, terminal.console().height - ABOVE - len(seen.robots)))
    at = "starting" if demo.zero is None else f"{demo.elapsed():5.1f} s, building {seen.simulated:5.0f} s"
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("robot", "does", "truly dark"):
        table.add_column(column, header_style="bold")
    for robot in seen.robots:
        doing = "operator" if robot == demo.driven else seen.doing.get(robot, "")
        style = "bold magenta" if doing == "operator" else STYLES.get(doing, "")
        table.add_row(robot, Text(doing, style=style), "yes" if robot in seen.truly else "")
    counts = f"{len(seen.hidden)} hidden, {len(seen.watching)} watching, "
    counts += f"{terminal.many(seen.alerts, 'alert')}, {terminal.many(seen.preemptions, 'preemption')}"
    return Group(head, Text(f"{HARDWARE}; {at}"), Text(""), table, Text(counts), Text(""), *screen.latest(shown))
