"""The measured figures, and their table."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

WORKS = {
    "one": "grant of 1 RC, without contention (us)",
    "five": "grant of 5 RCs, without contention (us)",
    "next": "from a release to the next waiter's grant, 5 RCs (us)",
    "crowd": "20 behaviors, 10 RCs, 1 to 5 each (grants a second: more is better)",
    "least": "the same: the least served behavior (share of the mean: more is better)",
    "killed": "holder killed, to the waiter's grant (s)",
}


@dataclass(frozen=True, slots=True)
class Figure:
    """One contender at one kind of work. The ratios compare medians of the same rounds."""

    work: str
    who: str
    value: float | None
    """A median in the unit of `WORKS`; None if it took longer than the limit in `note`."""
    p99: float | None = None
    to_zscout: float | None = None
    to_bare: float | None = None
    rounds: int = 1
    note: str = ""


@dataclass(slots=True)
class Report:
    figures: list[Figure] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    lacks: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    """Peers that were not available or failed, and why."""
    machine: dict[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"works": WORKS}

    def text(self) -> str:
        width = max((len(figure.who) for figure in self.figures), default=0)
        lines = []
        for work, meaning in WORKS.items():
            rows = [figure for figure in self.figures if figure.work == work]
            if not rows:
                continue
            lines.append(f"{meaning}\n  {'':{width}}  {'median':>9}  {'p99':>9}  {'x zscout':>8}  {'x bare':>7}")
            for row in rows:
                cells = f"{_number(row.value):>9}  {_number(row.p99):>9}  {_number(row.to_zscout):>8}"
                line = f"  {row.who:{width}}  {cells}  {_number(row.to_bare):>7}  {row.note}"
                lines.append(line.rstrip())
            lines.append("")
        lines += [f"{who}: {version}" for who, version in self.versions.items()]
        lines += [f"{who} does not do: {lacks}" for who, lacks in self.lacks.items() if lacks]
        lines += [f"{who} is not in the table: {why}" for who, why in self.missing.items()]
        return "\n".join(lines)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
