"""The chart of bookings: a row for each RC, with an outline for each future date. Pure.

The chart is a picture of its own, redrawn as time passes: a viewer that follows a fleet jumps to the newest time
logged, so nothing may be logged at future times. One unit is about a pixel."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple

import rerun as rr

from zscout.services.recorder.blueprint import AHEAD, CHART_HEAD, CHART_WIDTH, MAX_CHART_ROWS, Ahead, chart_row
from zscout.services.recorder.colours import GRID, NOW, PALE, bright, faded
from zscout.services.recorder.drawing import clean_text

MAX_BARS: Final = 300
"""Outlines in one chart, the earliest."""
LEFT: Final = 170.0
"""Position of the present; names are to its left."""
MARGIN: Final = 4.0
"""Distance of an outline from the lines of its row."""
LETTER: Final = 6.8
"""Approximate width of a letter; the viewer does not report it."""
PADDING: Final = 14.0
"""Space beside a label, both sides together."""
HATCH: Final = 9.0
"""Distance of the lines of a hatching."""
LABEL: Final = -12.0
"""Offset of a label's point from the middle of a row; the text is drawn below the point."""
CLEAR: Final = 62.0, 40.0
"""Least distance of a time's label from the label of the present, and from the edge."""
MAX_NAME: Final = 30
"""Characters of an RC's name."""
DAY: Final = 86_400

Point = tuple[float, float]


class Bar(NamedTuple):
    """A date in the row of an RC. Times are in seconds since 1970; the text is not cleaned yet."""

    row: str
    start: float
    end: float
    text: str
    colour: int
    """RGBA."""
    thick: bool = False
    hatched: bool = False


class ChartLayer(NamedTuple):
    """The shape of an entity below the chart's; empty if its first field is."""

    shape: type[rr.AsComponents]
    fields: dict[str, Any]


class _Placed(NamedTuple):
    bar: Bar
    left: float
    right: float
    top: float
    bottom: float
    room: float
    """Left edge of the next bar in its row."""


def rows_of(bars: Iterable[Bar], now: float) -> int:
    """Rows of the tallest chart."""
    known = [*bars]
    return max(len(_seated(_within(known, now, ahead.seconds))[0]) for ahead in AHEAD)


def chart(bars: Iterable[Bar], now: float, ahead: Ahead, rows: int, *, stale: bool = False) -> dict[str, ChartLayer]:
    """Layers by name. `rows`: of the tallest chart. `stale`: no bookings are received; `now`: the last answer."""
    within = _within(bars, now, ahead.seconds)
    names, seats = _seated(within)
    scale, high = (CHART_WIDTH - LEFT) / ahead.seconds, chart_row(rows)
    placed = [*_placed(within, seats, now, scale, high)]
    bottom = CHART_HEAD + high * len(names)
    times = [(LEFT + (at - now) * scale, text) for at, text in _ticks(now, ahead) if names]
    edges = [CHART_HEAD + high * row for row in range(len(names) + 1)]
    grid = [[(0.0, y), (CHART_WIDTH, y)] for y in edges if names] + [[(x, CHART_HEAD), (x, bottom)] for x, _ in times]
    heads = [(LEFT, f"{'as of' if stale else 'now'} {_at(now):%H:%M}")] if names else []
    heads += [(x, text) for x, text in times if LEFT + CLEAR[0] < x < CHART_WIDTH - CLEAR[1]]
    shade = 0.4 if stale else 1.0
    labels = [(*spot, bright(box.bar.colour)) for box in placed if (spot := _label(box)) is not None]
    hatches = [(line, box.bar.colour) for box in placed if box.bar.hatched for line in _hatched(box)]
    return {
        "grid": _lines([(line, GRID) for line in grid], 0.5, 0.0),
        "now": _lines([([(LEFT, CHART_HEAD - 4), (LEFT, bottom)], NOW)] if names else [], 1.5, 40.0),
        "times": _texts([(x, 2.0, text, PALE) for x, text in heads]),
        "names": _texts(
            [
                (LEFT / 2, edges[row] + high / 2 + LABEL, clean_text(name, MAX_NAME), PALE)
                for row, name in enumerate(names)
                if name
            ]
        ),
        "hatch": _lines([(line, faded(colour, 0.45 * shade)) for line, colour in hatches], 0.5, 10.0),
        "dates": ChartLayer(
            rr.Boxes2D,
            {
                "mins": [(box.left, box.top) for box in placed],
                "sizes": [(box.right - box.left, box.bottom - box.top) for box in placed],
                "colors": [faded(box.bar.colour, shade) for box in placed],
                "radii": [-2.5 if box.bar.thick else -1.0 for box in placed],
                "labels": [box.bar.text for box in placed],
                "show_labels": False,  # shown on hover: they may be wider than the box
                "draw_order": 20.0,
            },
        ),
        "labels": _texts(labels),
    }


def _within(bars: Iterable[Bar], now: float, seconds: float) -> list[Bar]:
    found = [bar for bar in bars if bar.end > now and bar.start < now + seconds]
    return sorted(found, key=lambda bar: (bar.start, bar.end, bar.row, bar.text))


def _seated(bars: Sequence[Bar]) -> tuple[list[str], list[int | None]]:
    """Rows for bars in order of their starts; simultaneous bars of an RC get separate rows. Return each row's name
    (empty below an RC's first), and each bar's row (None beyond the limits, which add a last row with the count)."""
    ends: dict[str, list[float]] = {}
    seats: list[tuple[str, int] | None] = []
    free = MAX_CHART_ROWS
    for number, bar in enumerate(bars):
        rows = ends.setdefault(bar.row, [])
        seat = next((row for row, end in enumerate(rows) if end <= bar.start), len(rows))
        if number >= MAX_BARS or (seat == len(rows) and not free):
            seats.append(None)
            continue
        if seat == len(rows):
            free -= 1
            rows.append(bar.end)
        rows[seat] = bar.end
        seats.append((bar.row, seat))
    names: list[str] = []
    first: dict[str, int] = {}
    for name in sorted(name for name, rows in ends.items() if rows):
        first[name] = len(names)
        names += [name, *[""] * (len(ends[name]) - 1)]
    if None in seats:
        names.append(f"and {seats.count(None)} more")
    return names, [None if seat is None else first[seat[0]] + seat[1] for seat in seats]


def _placed(
    bars: Sequence[Bar], seats: Sequence[int | None], now: float, scale: float, high: float
) -> Iterator[_Placed]:
    nexts: dict[int, float] = {}
    found: list[_Placed] = []
    for bar, seat in reversed([*zip(bars, seats, strict=True)]):
        if seat is None:
            continue
        left = max(LEFT, LEFT + (bar.start - now) * scale)
        right = min(CHART_WIDTH, LEFT + (bar.end - now) * scale)
        top = CHART_HEAD + high * seat
        shown = bar._replace(text=clean_text(bar.text))
        found.append(_Placed(shown, left, right, top + MARGIN, top + high - MARGIN, nexts.get(seat, CHART_WIDTH)))
        nexts[seat] = left
    return reversed(found)


def _label(box: _Placed) -> tuple[float, float, str] | None:
    """Position and text of a label: within the box if it fits, else in free space after it, else shortened."""
    y, wide = (box.top + box.bottom) / 2 + LABEL, len(box.bar.text) * LETTER + PADDING
    if wide <= box.right - box.left:
        return (box.left + box.right) / 2, y, box.bar.text
    if wide <= box.room - box.right:
        return box.right + wide / 2, y, box.bar.text
    inside = box.right - box.left >= box.room - box.right
    begin, end = (box.left, box.right) if inside else (box.right, box.room)
    letters = int((end - begin - PADDING) / LETTER)
    return ((begin + end) / 2, y, f"{box.bar.text[: letters - 1]}…") if letters >= 3 else None


def _hatched(box: _Placed) -> Iterator[list[Point]]:
    """Lines of a hatching from lower left to upper right, within the box."""
    height, x = box.bottom - box.top, box.left - (box.bottom - box.top) + HATCH
    while x < box.right:
        begin, end = max(x, box.left), min(x + height, box.right)
        yield [(begin, box.bottom - (begin - x)), (end, box.bottom - (end - x))]
        x += HATCH


def _ticks(now: float, ahead: Ahead) -> Iterator[tuple[float, str]]:
    at = int(now // ahead.tick + 1) * ahead.tick
    while at < now + ahead.seconds:
        midnight = at % DAY == 0
        yield at, f"{_at(at):%a %d %b}" if midnight else f"{_at(at):%H:%M}"
        at += ahead.tick


def _at(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _lines(lines: Sequence[tuple[list[Point], int]], radius: float, order: float) -> ChartLayer:
    strips, colours = [line for line, _ in lines], [colour for _, colour in lines]
    return ChartLayer(rr.LineStrips2D, {"strips": strips, "colors": colours, "radii": [-radius], "draw_order": order})


def _texts(texts: Sequence[tuple[float, float, str, int]]) -> ChartLayer:
    fields = {
        "positions": [(x, y) for x, y, _, _ in texts],
        "colors": [colour for *_, colour in texts],
        "labels": [text for _, _, text, _ in texts],
        "show_labels": True,
        "radii": [0.0],
        "draw_order": 50.0,
    }
    return ChartLayer(rr.Points2D, fields)
