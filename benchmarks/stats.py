"""Samples, the rows of the table, and the table."""

from __future__ import annotations

import statistics
from dataclasses import asdict, dataclass
from typing import Any


class Samples:
    """Durations in seconds."""

    def __init__(self) -> None:
        self.values: list[float] = []

    def add(self, seconds: float) -> None:
        self.values.append(seconds)

    @property
    def median(self) -> float:
        return statistics.median(self.values)

    @property
    def p99(self) -> float:
        ordered = sorted(self.values)
        return ordered[min(len(ordered) - 1, round(0.99 * len(ordered)))]


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. `ratio` compares it with `against`; `aim` applies to the ratio if there is one, else to the value."""

    name: str
    value: float
    unit: str
    p99: float | None = None
    ratio: float | None = None
    against: str = ""
    aim: float | None = None
    at_least: bool = False
    """The aim is a floor, not a ceiling."""
    rounds: int = 1

    @property
    def met(self) -> bool | None:
        """True if the aim is met; None without an aim."""
        if self.aim is None:
            return None
        measured = self.ratio if self.ratio is not None else self.value
        return measured >= self.aim if self.at_least else measured <= self.aim

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"met": self.met}


def of_latency(
    name: str, samples: Samples, bare: Samples, *, aim: float | None = None, against: str = "bare query"
) -> Row:
    """Return the row of a latency; its ratio compares medians."""
    return Row(
        name,
        samples.median * 1e6,
        "us",
        samples.p99 * 1e6,
        samples.median / bare.median,
        against,
        aim,
        rounds=len(samples.values),
    )


def table(rows: list[Row]) -> str:
    """Return the rows as aligned text."""
    cells = [("figure", "value", "p99", "ratio", "to", "aim", "met", "rounds")]
    for row in rows:
        aim = "" if row.aim is None else f"{'>=' if row.at_least else '<='} {row.aim:g}"
        cells.append(
            (
                row.name,
                f"{_number(row.value)} {row.unit}",
                "" if row.p99 is None else f"{_number(row.p99)} {row.unit}",
                "" if row.ratio is None else f"{row.ratio:.2f}",
                row.against,
                aim,
                {None: "", True: "yes", False: "NO"}[row.met],
                str(row.rounds),
            )
        )
    widths = [max(len(line[column]) for line in cells) for column in range(len(cells[0]))]
    right = {1, 2, 3, 5, 7}
    lines = []
    for line in cells:
        parts = [
            cell.rjust(width) if column in right else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        lines.append("  ".join(parts).rstrip())
    lines.insert(1, "-" * max(len(line) for line in lines))
    return "\n".join(lines)


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
