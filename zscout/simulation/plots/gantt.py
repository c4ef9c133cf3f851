"""The cells of a Gantt chart in characters."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from zscout.simulation.replay import HoldRecord
from zscout.simulation.workload import Workload
from zscout.types import SECOND, ArcId, Ns, RcName

MAX_SECONDS: Final = 60  # of a chart with a column per second
MAX_COLUMNS: Final = 500
MAX_CELL: Final = 12  # characters; longer ARC names are cut


@dataclass(frozen=True, slots=True)
class Columns:
    """Start of each column, end of the last, and how many more (`cut`) are left out."""

    starts: tuple[Ns, ...]
    end: Ns
    by_second: bool
    cut: int = 0


def columns_of(holds: Sequence[HoldRecord]) -> Columns:
    """A column per second if that is exact and fits, otherwise one per interval between two events."""
    times = sorted({time for hold in holds for time in (hold.start, hold.end)})
    if not times:
        return Columns((), 0, by_second=True)
    end = times[-1]
    if end <= MAX_SECONDS * SECOND and all(time % SECOND == 0 for time in times):
        return Columns(tuple(range(0, end, SECOND)), end, by_second=True)
    cut = max(0, len(times) - 1 - MAX_COLUMNS)
    shown = times[: len(times) - cut]
    return Columns(tuple(shown[:-1]), shown[-1], by_second=False, cut=cut)


def rows_of(
    workload: Workload, holds: Sequence[HoldRecord], columns: Columns
) -> Iterator[tuple[RcName, list[ArcId | None]]]:
    """The holder of each RC in each column, RCs in the file's order, with a row for each simultaneous holder."""
    index = {start: number for number, start in enumerate((*columns.starts, columns.end))}
    width = len(columns.starts)
    lanes: dict[RcName, list[list[ArcId | None]]] = {rc.name: [[None] * width] for rc in workload.rcs}
    for hold in holds:
        first, last = index.get(hold.start, width), index.get(hold.end, width)
        if first >= last:
            continue
        for rc in hold.rcs:
            row = next((row for row in lanes[rc] if not any(row[first:last])), None)
            if row is None:
                row = [None] * width
                lanes[rc].append(row)
            row[first:last] = [hold.arc] * (last - first)
    return ((rc, row) for rc, rows in lanes.items() for row in rows)


def short_names(names: Sequence[ArcId]) -> tuple[dict[ArcId, str], bool]:
    """Cell text of each ARC, and whether that is its number: arc0 and arc1 are 0 and 1, as in the paper."""
    found = [re.fullmatch(r"(.*\D)(\d+)", name) for name in names]
    if len({match[1] if match else None for match in found}) == 1 and found[0] is not None:
        return {match[0]: match[2] for match in found if match}, True
    return {name: name if len(name) <= MAX_CELL else name[: MAX_CELL - 1] + "…" for name in names}, False
