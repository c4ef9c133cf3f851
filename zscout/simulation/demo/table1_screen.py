"""`zscout demo table1` on the screen: the holders over time, compared with the paper."""

from __future__ import annotations

from collections.abc import Iterator, Set
from pathlib import Path
from typing import TYPE_CHECKING, Final

from zscout import terminal
from zscout.mesh import clock
from zscout.simulation.demo.screen import DemoScreen, LiveView, how_to_view
from zscout.simulation.demo.table1_run import Table1Demo
from zscout.simulation.demo.tables import Difference, Observed, Paper, Table, differences, paper
from zscout.types import SECOND

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

LINES: Final = 7  # events below the growing table
STYLES: Final = {
    "0": "white on #4e79a7",
    "1": "black on #f28e2b",
    "2": "black on #59a14f",
    "3": "black on #b58adb",
    "4": "white on #ff1463",
    "-": "bright_black",
}  # the recording's colours, by ARC
SOURCES: Final = {"RCM": "published by the leader", "ARCs": "seen by request bodies", "paper": "Table 2 of the paper"}
LATE: Final = "all came in the order of the paper's Table 2, but late: this machine is busy"
DIFFERENT: Final = "not in the order of the paper's Table 2"
WIDE: Final = 26  # columns left of the first second


async def play(out: Path | None, *, as_json: bool, live: LiveView | None = None) -> int:
    """Play the demo; returns the exit code. Raises as `Table1Demo` does."""
    expected = paper()
    rcs, seconds = list(expected.table), len(next(iter(expected.table.values())))
    began = clock.now()
    screen = DemoScreen("table1", as_json=as_json, decimals=2, live=live)
    screen.begin("Table 1 of the paper on three nodes of this machine; starting them")
    demo, path = await screen.play(
        lambda folder: Table1Demo(folder, expected.workload, screen.show, screen.on_live),
        lambda demo: _picture(demo, expected, screen),
        out,
    )
    seen, now = demo.seen, clock.now()
    published, bodies = seen.by_rcm(rcs, seconds, now), seen.by_bodies(rcs, seconds, now)
    wrong = differences(expected.table, published, bodies)
    as_paper, took = seen.same_order(expected.table), (now - began) / SECOND
    if as_json:
        terminal.print_json(
            {
                "paper": expected.table,
                "published": published,
                "bodies": bodies,
                "differences": [item._asdict() for item in wrong],
                "loads": seen.loads,
                "recording": str(path),
                "seconds": round(took, 3),
            }
        )
    else:
        _report({"RCM": published, "ARCs": bodies, "paper": expected.table}, wrong, seen, path, took)
        if wrong or not as_paper:
            terminal.print_line(LATE if as_paper else DIFFERENT)
        for words in how_to_view(path):
            terminal.print_line(words)
    await screen.linger(path)
    return 0 if as_paper else 1


def _report(tables: dict[str, Table], wrong: list[Difference], seen: Observed, path: Path, took: float) -> None:
    console = terminal.console()
    terminal.print_line("")
    for source, meaning in SOURCES.items():
        terminal.print_line(f"{source:<6} {meaning}")
    for line in _lines(tables, {(item.rc, item.second) for item in wrong}):
        console.print(line, soft_wrap=True)
    terminal.print_line("")
    rows = [
        [host, *(f"{load:.2f}" for load in report.load_average), f"{report.cpu:.0f} %", str(report.number)]
        for host, report in sorted(seen.loads.items())
    ]
    terminal.print_table(["host", "load 1 min", "5 min", "15 min", "CPU", "reports"], rows)
    terminal.print_line("")
    if wrong:
        for item in wrong:
            words = f"the leader {item.published}, the requests {item.bodies}, the paper {item.paper}"
            terminal.print_line(f"differs: {item.rc} in second {item.second}: {words}")
    else:
        cells = sum(len(row) for row in tables["paper"].values())
        terminal.print_line(f"All {cells} cells agree with the paper's Table 2 ({took:.0f} s).")


def _lines(tables: dict[str, Table], wrong: Set[tuple[str, int]] = frozenset()) -> Iterator[Text]:
    """A Gantt table: a row per RC and source, a column per second."""
    from rich.text import Text

    seconds = max(len(row) for table in tables.values() for row in table.values())
    yield Text(" " * WIDE + "".join(f"{second:<3}" for second in range(seconds)).rstrip(), style="bold")
    for rc in next(iter(tables.values())):
        for number, (source, table) in enumerate(tables.items()):
            line = Text(f"{rc if number == 0 else '':<20}", style="bold")
            line.append(f"{source:<{WIDE - 20}}", style="bright_black")
            for second, cell in enumerate(table[rc]):
                marked = (rc, second) in wrong
                line.append(f"{cell[:2]:<3}", style="bold white on red" if marked else STYLES.get(cell, "bold"))
            line.rstrip()
            yield line


def _picture(demo: Table1Demo, expected: Paper, screen: DemoScreen) -> Group:
    """The growing table of holders, and the latest events."""
    from rich.console import Group
    from rich.text import Text

    rcs, seconds = list(expected.table), len(next(iter(expected.table.values())))
    head = "Table 1 of the paper on three nodes of this machine: starting them"
    if demo.zero is not None:
        head = f"Table 1 of the paper on three nodes: {min(demo.elapsed(), seconds):4.1f} s of {seconds}"
    held = demo.seen.by_rcm(rcs, seconds, clock.now())
    table = {rc: [*row, *[""] * (seconds - len(row))] for rc, row in held.items()}
    return Group(Text(head), Text(""), *_lines({"": table}), Text(""), *screen.latest(LINES))
