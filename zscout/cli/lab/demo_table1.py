"""`zscout demo table1`: the paper's example on a live mesh, compared with what the paper reports."""

from __future__ import annotations

from collections.abc import Iterator, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from zscout.cli import common
from zscout.cli.lab.demo_screen import DemoScreen, how_to_view, recording_option
from zscout.types import SECOND

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

    from zscout.lab.demo.table1_run import Table1Demo
    from zscout.lab.demo.tables import Difference, Observed, Paper, Table

LINES: Final = 7
"""Events shown below the growing table."""
STYLES: Final = {
    "0": "white on #4e79a7",
    "1": "black on #f28e2b",
    "2": "black on #59a14f",
    "3": "black on #b58adb",
    "4": "white on #ff1463",
    "-": "bright_black",
}
"""The colours of the recording, by ARC."""
SOURCES: Final = {
    "RCM": "what the RCM published",
    "ARCs": "what the ARCs' bodies saw",
    "paper": "Table 2 of the paper",
}
WIDE: Final = 26
"""Columns left of the first second."""


@click.command()
@recording_option
@common.json_option("Print the tables as JSON.")
def table1(out: Path | None, as_json: bool) -> int:
    """Play Table 1 of the paper on a live mesh, and compare what happens with Table 2.

    It starts three nodes with four devices and five programs on this machine, apart from every other fleet,
    for about 25 seconds, and records them. Nothing is left but the recording. Exit code 1: a cell differs.

    \b
    Examples:
      zscout demo table1
      zscout demo table1 --out demo.rrd --json
    """
    return common.run(_demo(out, as_json=as_json))


async def _demo(out: Path | None, *, as_json: bool) -> int:
    # Zenoh is loaded here: the help needs none of it.
    from zscout.lab.demo.table1_run import Table1Demo
    from zscout.lab.demo.tables import differences, paper
    from zscout.mesh import clock

    expected = paper()
    rcs, seconds = list(expected.table), len(next(iter(expected.table.values())))
    began = clock.now()
    screen = DemoScreen(as_json=as_json, decimals=2)
    screen.print_line("Table 1 of the paper on three nodes of this machine; starting them")
    demo, path = await screen.play(
        lambda folder: Table1Demo(folder, expected.workload, screen.show),
        lambda demo: _picture(demo, expected, screen),
        out,
    )
    seen, now = demo.seen, clock.now()
    published, bodies = seen.by_rcm(rcs, seconds, now), seen.by_bodies(rcs, seconds, now)
    wrong = differences(expected.table, published, bodies)
    took = (now - began) / SECOND
    if as_json:
        common.print_json(
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
    return 1 if wrong else 0


def _report(
    tables: dict[str, Table], wrong: list[Difference], seen: Observed, path: Path, took: float
) -> None:
    console = common.console()
    _print(console, "")
    for source, meaning in SOURCES.items():
        _print(console, f"{source:<6} {meaning}")
    for line in _lines(tables, {(item.rc, item.second) for item in wrong}):
        console.print(line, soft_wrap=True)
    _print(console, "")
    rows = [
        [host, *(f"{load:.2f}" for load in report.load_average), f"{report.cpu:.0f} %", str(report.number)]
        for host, report in sorted(seen.loads.items())
    ]
    common.print_table(["host", "load 1 min", "5 min", "15 min", "CPU", "reports"], rows)
    _print(console, "")
    if wrong:
        for item in wrong:
            words = f"the RCM {item.published}, the ARCs {item.bodies}, the paper {item.paper}"
            _print(console, f"differs: {item.rc} in second {item.second}: {words}")
        _print(console, "a very busy machine can do that; try again")
    else:
        cells = sum(len(row) for row in tables["paper"].values())
        _print(console, f"All {cells} cells are those of the paper's Table 2 ({took:.0f} s).")
    for words in how_to_view(path):
        _print(console, words)


def _print(console: Any, text: str) -> None:
    console.print(text, soft_wrap=True)


def _lines(tables: dict[str, Table], wrong: Set[tuple[str, int]] = frozenset()) -> Iterator[Text]:
    """A Gantt table: for each RC a row from each source, a column for each second."""
    from rich.text import Text

    seconds = max(len(row) for table in tables.values() for row in table.values())
    yield Text(" " * WIDE + "".join(f"{second:<3}" for second in range(seconds)).rstrip(), style="bold")
    for rc in next(iter(tables.values())):
        for number, (source, table) in enumerate(tables.items()):
            line = Text(f"{rc if number == 0 else '':<20}", style="bold")
            line.append(f"{source:<{WIDE - 20}}", style="bright_black")
            for second, cell in enumerate(table[rc]):
                marked = (rc, second) in wrong
                line.append(
                    f"{cell[:2]:<3}", style="bold white on red" if marked else STYLES.get(cell, "bold")
                )
            line.rstrip()
            yield line


def _picture(demo: Table1Demo, expected: Paper, screen: DemoScreen) -> Group:
    """Who holds what, growing with time, and the latest events."""
    from rich.console import Group
    from rich.text import Text

    from zscout.mesh import clock

    rcs, seconds = list(expected.table), len(next(iter(expected.table.values())))
    head = "Table 1 of the paper on three nodes of this machine: starting them"
    if demo.zero is not None:
        head = f"Table 1 of the paper on three nodes: {min(demo.elapsed(), seconds):4.1f} s of {seconds}"
    held = demo.seen.by_rcm(rcs, seconds, clock.now())
    table = {rc: [*row, *[""] * (seconds - len(row))] for rc, row in held.items()}
    return Group(Text(head), Text(""), *_lines({"": table}), Text(""), *screen.latest(LINES))
