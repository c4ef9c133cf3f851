"""The study of robots as a Rerun recording: curves over the number of robots, bars over the radio's rate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from zscout.lab.plots.recording import COLOURS, recording, tabs_and_summary
from zscout.lab.study.robots import FieldFigures, StartFigures

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION: Final = "zscout-study-robots"
ROBOTS: Final = "robots"
"""The timeline of the curves: how many robots there are."""
WIDTH: Final = 3.0

Value = Callable[[FieldFigures], float]
CURVES: Final[tuple[tuple[str, str, Value], ...]] = (
    ("all_placed", "Seconds until all are placed (median)", lambda one: one.all_placed.median),
    ("placed", "Robots placed (%)", lambda one: 100 * one.placed),
    ("noticed", "Walks noticed (%)", lambda one: 100 * one.noticed),
    ("alerted", "Crossings alerted within 1 s (%)", lambda one: 100 * one.alerted),
)
"""Entity, title, value: each is a pane. What is no number, or never came, is left out."""


def record(
    path: Path,
    grid: Sequence[FieldFigures],
    radio: Sequence[FieldFigures],
    turns: Sequence[FieldFigures],
    starts: Sequence[StartFigures],
) -> None:
    """Writes the recording, replacing what was there. Raises BadInput where the file can't be written."""
    import rerun as rr

    words = _words(grid, radio, turns, starts)
    with recording(path, APPLICATION, _blueprint(grid, radio), words) as stream:
        _curves(stream, grid)
        for name, _, value in CURVES:
            for number, one in enumerate(radio):
                if math.isfinite(value(one)):
                    bar = rr.BarChart([value(one)], abscissa=[number], color=COLOURS[number % len(COLOURS)])
                    stream.log(f"radio/{name}/{_radio_name(one)}", bar, static=True)


def _curves(stream: rr.RecordingStream, grid: Sequence[FieldFigures]) -> None:
    import rerun as rr

    for number, channels in enumerate(sorted({one.channels for one in grid})):
        colour, legend = COLOURS[number % len(COLOURS)], f"{channels} channel{'s' * (channels != 1)}"
        for name, _, value in CURVES:
            points = [
                (one.robots, value(one)) for one in grid if one.channels == channels and math.isfinite(value(one))
            ]
            if not points:
                continue
            entity = f"grid/{name}/{channels}"
            line = rr.SeriesLines(colors=[colour], names=[legend], widths=[WIDTH])
            stream.log(entity, line, static=True)
            stream.send_columns(
                entity,
                indexes=[rr.TimeColumn(ROBOTS, sequence=[robots for robots, _ in points])],
                columns=rr.Scalars.columns(scalars=[at for _, at in points]),
            )


def _blueprint(grid: Sequence[FieldFigures], radio: Sequence[FieldFigures]) -> rrb.Blueprint:
    import rerun as rr
    import rerun.blueprint as rrb

    boundary = rr.TimeRangeBoundary
    most = max((one.robots for one in grid), default=1)
    window = rr.TimeRange(start=boundary.absolute(seq=0), end=boundary.absolute(seq=most + 1))
    tabs: list[rrb.Container] = []
    if grid:
        curves = [
            rrb.TimeSeriesView(
                origin=f"/grid/{name}",
                name=f"{title}, by robots",
                axis_x=rrb.archetypes.TimeAxis(view_range=window),
                plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
            )
            for name, title, _ in CURVES
        ]
        tabs.append(rrb.Grid(*curves, grid_columns=2, name="Robots and channels"))
    if radio:
        bars = [rrb.BarChartView(origin=f"/radio/{name}", name=f"{title}, by radio") for name, title, _ in CURVES]
        tabs.append(rrb.Grid(*bars, grid_columns=2, name="The radio"))
    return tabs_and_summary(tabs or [rrb.Grid(name="Starts")], ROBOTS)


def _radio_name(one: FieldFigures) -> str:
    return f"{one.baud}_baud_{one.command_rate:g}_per_second".replace(".", "_")


def _words(
    grid: Sequence[FieldFigures],
    radio: Sequence[FieldFigures],
    turns: Sequence[FieldFigures],
    starts: Sequence[StartFigures],
) -> str:
    lines = ["# Robots in buildings"]
    head = "all placed | robots placed | walks noticed |"
    for title, figures, columns in (
        ("Robots and channels", grid, ("robots", "channels")),
        ("The radio", radio, ("baud", "command_rate")),
        ("Turns", turns, ("slot", "robots")),
    ):
        if figures:
            lines += ["", f"## {title}", f"| {columns[0]} | {columns[1].replace('_', ' ')} | {head}"]
            lines += ["|---|---|---|---|---|"]
            lines += [
                f"| {getattr(one, columns[0])} | {getattr(one, columns[1]):g} "
                f"| {_seconds(one.all_placed.median)} | {_share(one.placed)} "
                f"| {_share(one.noticed)} of {one.walks} |"
                for one in figures
            ]
    if starts:
        lines += ["", "## One robot, random starts", "| building | hidden in the dark | and facing the light |"]
        lines += ["|---|---|---|"]
        lines += [f"| {one.building} | {one.dark} of {one.starts} | {one.good} of {one.starts} |" for one in starts]
    return "\n".join(lines)


def _seconds(value: float) -> str:
    return f"{value:.0f} s" if math.isfinite(value) else "never"


def _share(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0%}"
