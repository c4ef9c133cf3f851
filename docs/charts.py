"""The charts of docs/evaluation, drawn from the tables of its pages: `python docs/charts.py` writes all of them.

`tests/docs/test_charts.py` fails when a table has changed since its chart was drawn.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple
from xml.sax.saxutils import escape

FOLDER: Final = Path(__file__).parent / "evaluation"
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
WIDTH: Final = 640
LABELS: Final = 250
"""Pixels for the names of the bars, at the left."""
VALUES: Final = 70
"""Pixels for the numbers, at the right."""
BAR: Final = 14
GAP: Final = 8
TOP: Final = 46


class Chart(NamedTuple):
    """Bars for some columns of one table.

    `table` is the beginning of its first line; the first such table counts. Columns count from 0. `bars` maps a name in
    the legend to its column and to the number of the cell that counts. `label` has the columns that name a row. Rows
    without a number, and rows that match `without`, are left out.
    """

    page: str
    table: str
    title: str
    bars: dict[str, tuple[int, int]]
    label: tuple[int, ...] = (0,)
    without: str = r"^$"


CHARTS: Final[dict[str, Chart]] = {
    "latency.svg": Chart("latency.md", "| figure", "Latency, in bare queries", {"adaptive": (2, 0), "priority": (3, 0)},
                         without="crowd|zscout --help"),
    "scaling.svg": Chart("scaling.md", "| `adaptive`", "Event under adaptive, us (median), by requests in the queue",
                         {"10": (1, 0), "100": (2, 0), "1,000": (3, 0), "10,000": (4, 0)}, without="end of a hold"),
    "hosts.svg": Chart("hosts.md", "| hosts", "Balancer's answer, in bare queries", {"ratio": (3, 0)}),
    "viewer.svg": Chart("cost.md", "| written", "Seconds until a recording is shown", {"seconds": (3, 0)}),
    "strategies.svg": Chart("strategies.md", "| family", "Mean wait, s",
                            {"priority": (1, 1), "optimal": (2, 1), "adaptive": (3, 1)}),
    "heuristic.svg": Chart("heuristic.md", "| family", "Situations in which the heuristic is behind, %",
                           {"%": (2, 0)}),
    "trace.svg": Chart("trace.md", "| | one class", "Mean wait of one class, as a ratio to EASY backfill",
                       {"ratio": (1, 0)}, without="EASY"),
    "bookings.svg": Chart("bookings.md", "| family", "RC-time lost to bookings, %", {"lost": (2, 0)}),
    "estimates.svg": Chart("estimates.md", "| family", "Median error of the estimated start, s",
                           {"asked": (5, 0), "learned": (6, 0), "true": (7, 0)}),
    "fair-shares.svg": Chart("fair-shares.md", "| seed", "RC-seconds while the other group waited",
                             {"steady": (2, 0), "bursty": (3, 0)}, label=(0, 1)),
    "placement.svg": Chart("placement.md", "| policy | (a)", "Highest less lowest load average", {"all at once": (3, 0),
                           "one net a minute": (6, 0)}),
    "robots-live.svg": Chart("robots-live.md", "| robots", "From a picture to the wheels, ms",
                             {"p50": (1, 0), "p99": (2, 0)}),
    "watching.svg": Chart("watching.md", "| in each picture", "Seconds with false alarms, with rain detection",
                          {"seconds": (2, 0)}),
    "cdnet.svg": Chart("watching.md", "| | recall", "CDnet 2014, highway: F measure", {"F": (3, 0)}),
    "faults.svg": Chart("faults.md", "| fault | n", "Seconds to the next grant", {"median": (2, 0), "worst": (2, 1)}),
    "peers.svg": Chart("peers.md", "| in bare queries", "One grant of 1 RC, in bare queries", {"grant": (1, 0)}),
}  # fmt: skip
"""By file name."""


def rows(chart: Chart) -> list[tuple[str, list[float]]]:
    """The names of a chart's rows and their numbers, as its table has them."""
    lines = (FOLDER / chart.page).read_text().splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith(chart.table))
    found: list[tuple[str, list[float]]] = []
    before = [""] * 20
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        cells = [re.sub(r"[*`]", "", cell).strip() for cell in line.strip("|").split("|")]
        # An empty first cell stands for the cell above it.
        cells = [cell or before[at] if at in chart.label else cell for at, cell in enumerate(cells)]
        before = cells
        name = ", ".join(cells[at] for at in chart.label)
        numbers = [_number(cells[column], which) for column, which in chart.bars.values()]
        if not re.search(chart.without, name) and all(number is not None for number in numbers):
            found.append((name, [number for number in numbers if number is not None]))
    return found


def _number(cell: str, which: int) -> float | None:
    numbers = re.findall(r"-?\d[\d,]*(?:\.\d+)?", re.sub(r"(?<=\d), (?=\d)", " ; ", cell))
    return float(numbers[which].replace(",", "")) if len(numbers) > which else None


def svg(chart: Chart) -> str:
    """Draw one chart."""
    table = rows(chart)
    most = max(number for _, numbers in table for number in numbers) or 1
    room = WIDTH - LABELS - VALUES
    parts = [f'<text x="8" y="18" font-weight="bold">{escape(chart.title)}</text>']
    if len(chart.bars) > 1:
        across = LABELS
        for colour, name in zip(COLOURS, chart.bars, strict=False):
            parts.append(f'<rect x="{across}" y="26" width="10" height="10" fill="{colour}"/>')
            parts.append(f'<text x="{across + 14}" y="35">{escape(name)}</text>')
            across += 30 + 8 * len(name)
    down = TOP
    for name, numbers in table:
        middle = down + BAR * len(numbers) / 2 + 4
        parts.append(f'<text x="{LABELS - 8}" y="{middle:g}" text-anchor="end">{escape(_short(name))}</text>')
        for colour, number in zip(COLOURS, numbers, strict=False):
            width = room * number / most
            parts.append(f'<rect x="{LABELS}" y="{down}" width="{width:.1f}" height="{BAR - 2}" fill="{colour}"/>')
            parts.append(f'<text x="{LABELS + width + 4:.1f}" y="{down + 10}">{number:,.10g}</text>')
            down += BAR
        down += GAP
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {down}" role="img"'
    return "\n".join(
        [
            f'{head} font-family="sans-serif" font-size="11">',
            f'<rect width="{WIDTH}" height="{down}" fill="white"/>',
            *parts,
            "</svg>",
            "",
        ]
    )


def _short(name: str) -> str:
    return name if len(name) <= 44 else f"{name[:42]}..."


def main(names: Sequence[str] = tuple(CHARTS)) -> None:
    for name in names:
        (FOLDER / name).write_text(svg(CHARTS[name]))


if __name__ == "__main__":
    main()
