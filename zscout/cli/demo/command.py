"""`zscout demo`: the paper's example on a live mesh on this machine, compared with what the paper reports."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Set
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from zscout import clock
from zscout.cli import common
from zscout.scheduling.model import SECOND
from zscout.strict import BadInput

if TYPE_CHECKING:
    from rich.text import Text

    from zscout.cli.demo.run import Demo
    from zscout.cli.demo.tables import Difference, Observed, Paper, Table

FOLDER = Path("runs")
FRAMES = 4
"""Pictures per second at a terminal."""
LINES = 7
"""Events shown below the growing table."""
STYLES = {
    "0": "white on #4e79a7",
    "1": "black on #f28e2b",
    "2": "black on #59a14f",
    "3": "black on #b58adb",
    "4": "white on #ff1463",
    "-": "bright_black",
}
"""The colours of the recording, by ARC."""
SOURCES = {
    "RCM": "what the RCM published",
    "ARCs": "what the ARCs' bodies saw",
    "paper": "Table 2 of the paper",
}
WIDE = 26
"""Columns left of the first second."""


@click.command()
@click.option(
    "--out", metavar="FILE", type=click.Path(path_type=Path), help="The recording. Default: runs/demo-….rrd"
)
@common.json_option("Print the tables as JSON.")
def demo(out: Path | None, as_json: bool) -> int:
    """Play Table 1 of the paper on a live mesh, and compare what happens with Table 2.

    It starts three nodes with four devices and five programs on this machine, apart from every other fleet,
    for about 25 seconds, and records them. Nothing is left but the recording. Exit code 1: a cell differs.

    \b
    Examples:
      zscout demo
      zscout demo --out demo.rrd --json
    """
    if out is not None and out.suffix != ".rrd":
        raise BadInput(f"--out {out}: viewers know a recording by its name; let it end in .rrd")
    return common.run(_demo(out, as_json=as_json))


async def _demo(out: Path | None, *, as_json: bool) -> int:
    # Zenoh is loaded here: the help needs none of it.
    from zscout.cli.demo.run import Demo
    from zscout.cli.demo.tables import differences, paper

    expected = paper()
    rcs, seconds = list(expected.table), len(next(iter(expected.table.values())))
    events: list[tuple[float, str]] = []
    plain = not as_json and not common.at_terminal()

    def tell(at: float, text: str) -> None:
        events.append((at, text))
        if plain:
            common.print_line(f"{at:6.2f} s  {common.clean(text)}")

    began = clock.now()
    with _recording(out) as path, tempfile.TemporaryDirectory(prefix="zscout-demo-") as folder:
        if plain:
            common.print_line("Table 1 of the paper on three nodes of this machine; starting them")
        try:
            async with Demo(Path(folder), expected.workload, tell) as run:
                with _picture(run, expected, events, hidden=plain or as_json):
                    await run.run()
        except BaseException:
            if _keep(Path(folder), path):
                click.echo(f"the recording until then: {path}", err=True)
            raise
        _keep(Path(folder), path)
    seen, now = run.seen, clock.now()
    published, bodies = seen.by_rcm(rcs, seconds, now), seen.by_bodies(rcs, seconds, now)
    wrong = differences(expected.table, published, bodies)
    took = (now - began) / SECOND
    if as_json:
        common.print_json(_json(expected.table, published, bodies, wrong, seen, path, took))
    else:
        _report({"RCM": published, "ARCs": bodies, "paper": expected.table}, wrong, seen, path, took)
    return 1 if wrong else 0


@contextmanager
def _recording(out: Path | None) -> Iterator[Path]:
    """The recording's file, made beforehand: a bad place is known at once. It goes if it stays empty."""
    from zscout.services.recorder_files import new_recording, prune

    if out is None:
        path = new_recording(FOLDER, "demo")
        prune(FOLDER, "demo")
    else:
        path = out
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("ab").close()
        except OSError as error:
            why = "its folder is a file" if isinstance(error, FileExistsError) else error.strerror
            raise BadInput(f"--out {path}: can't be written ({why}); give another file") from None
    try:
        yield path
    finally:
        if path.is_file() and path.stat().st_size == 0:
            path.unlink()


def _keep(folder: Path, path: Path) -> bool:
    """Moves the recording out of the demo's folder; False if there is none."""
    from zscout.cli.demo.run import RECORDINGS

    recorded = next((folder / RECORDINGS).glob("*.rrd"), None)
    if recorded is not None:
        shutil.move(recorded, path)
    return recorded is not None


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
    _print(console, f"Recording: {path}")
    # A newcomer's shell does not find it yet: it lies in .venv/bin.
    me = "zscout" if shutil.which("zscout") else os.path.relpath(sys.argv[0])
    _print(console, f"Look at it: {me} view {path}, or in a browser: {me} view --web {path}")


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


@contextmanager
def _picture(run: Demo, expected: Paper, events: list[tuple[float, str]], *, hidden: bool) -> Iterator[None]:
    """At a terminal, who holds what, growing with time, and the latest events."""
    if hidden:
        yield
        return
    from rich.console import Group
    from rich.live import Live
    from rich.text import Text

    rcs, seconds = list(expected.table), len(next(iter(expected.table.values())))

    def draw() -> Group:
        now = clock.now()
        if run.seen.zero is None:
            head = "Table 1 of the paper on three nodes of this machine: starting them"
        else:
            head = (
                f"Table 1 of the paper on three nodes: {(now - run.seen.zero) / SECOND:4.1f} s of {seconds}"
            )
        tables = {
            "": {
                rc: [*row, *[""] * (seconds - len(row))]
                for rc, row in run.seen.by_rcm(rcs, seconds, now).items()
            }
        }
        latest = [
            Text(f"{at:6.2f} s  {common.clean(text)}", overflow="ellipsis", no_wrap=True)
            for at, text in events[-LINES:]
        ]
        return Group(Text(head), Text(""), *_lines(tables), Text(""), *latest)

    with Live(get_renderable=draw, console=common.console(), refresh_per_second=FRAMES, transient=True):
        yield


def _json(
    expected: Table,
    published: Table,
    bodies: Table,
    wrong: list[Difference],
    seen: Observed,
    path: Path,
    took: float,
) -> dict[str, Any]:
    return {
        "paper": expected,
        "published": published,
        "bodies": bodies,
        "differences": [item._asdict() for item in wrong],
        "loads": seen.loads,
        "recording": str(path),
        "seconds": round(took, 3),
    }
