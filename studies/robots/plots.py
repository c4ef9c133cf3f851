"""The study of robots as a Rerun recording: curves over the number of robots, bars over the radio's rate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from studies.recording import COLOURS, recording, tabs_and_summary
from studies.robots.study import FieldFigures, RobotsReport

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION: Final = "zscout-study-robots"
ROBOTS: Final = "robots"
"""The timeline of the curves: how many robots there are."""
WIDTH: Final = 3.0

Value = Callable[[FieldFigures], float]
CURVES: Final[tuple[tuple[str, str, Value], ...]] = (
    ("all_placed", "Seconds until all are placed (median)", lambda figure: figure.all_placed.median),
    ("placed", "Robots placed (%)", lambda figure: 100 * figure.placed),
    ("noticed", "Walks noticed (%)", lambda figure: 100 * figure.noticed),
    ("alerted", "Crossings alerted within 1 s (%)", lambda figure: 100 * figure.alerted),
)
"""Entity, title, value: each is a pane. Values that are NaN or infinite are left out."""


def record(path: Path, found: RobotsReport) -> None:
    """Write the recording, and replace an existing file. Raises BadInput if the file can't be written."""
    import rerun as rr

    with recording(path, APPLICATION, _blueprint(found), _words(found)) as stream:
        _curves(stream, found.grid)
        radio = [(_radio_name(figure), figure) for figure in found.radio]
        receivers = [(f"{figure.framegrabbers}_framegrabbers", figure) for figure in found.receivers]
        for kind, bars in (("radio", radio), ("receivers", receivers)):
            for name, _, value in CURVES:
                for number, (label, figure) in enumerate(bars):
                    if math.isfinite(value(figure)):
                        bar = rr.BarChart([value(figure)], abscissa=[number], color=COLOURS[number % len(COLOURS)])
                        stream.log(f"{kind}/{name}/{label}", bar, static=True)


def _curves(stream: rr.RecordingStream, grid: Sequence[FieldFigures]) -> None:
    import rerun as rr

    for number, channels in enumerate(sorted({figure.channels for figure in grid})):
        colour, legend = COLOURS[number % len(COLOURS)], f"{channels} channel{'s' * (channels != 1)}"
        for name, _, value in CURVES:
            points = [
                (figure.robots, value(figure))
                for figure in grid
                if figure.channels == channels and math.isfinite(value(figure))
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


def _blueprint(found: RobotsReport) -> rrb.Blueprint:
    import rerun as rr
    import rerun.blueprint as rrb

    boundary = rr.TimeRangeBoundary
    most = max((figure.robots for figure in found.grid), default=1)
    window = rr.TimeRange(start=boundary.absolute(seq=0), end=boundary.absolute(seq=most + 1))
    tabs: list[rrb.Container] = []
    if found.grid:
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
    for kind, tab, measured in (("radio", "The radio", found.radio), ("receivers", "Framegrabbers", found.receivers)):
        if measured:
            bars = [rrb.BarChartView(origin=f"/{kind}/{name}", name=title) for name, title, _ in CURVES]
            tabs.append(rrb.Grid(*bars, grid_columns=2, name=tab))
    return tabs_and_summary(tabs or [rrb.Grid(name="Starts")], ROBOTS)


def _radio_name(figure: FieldFigures) -> str:
    return f"{figure.baud}_baud_{figure.command_rate:g}_per_second".replace(".", "_")


def _words(found: RobotsReport) -> str:
    lines = ["# Robots in buildings"]
    head = "all placed | robots placed | walks noticed |"
    for title, figures, columns in (
        ("Robots and channels", found.grid, ("robots", "channels")),
        ("Framegrabbers", found.receivers, ("framegrabbers", "channels")),
        ("The radio", found.radio, ("baud", "command_rate")),
        ("Turns", found.turns, ("slot", "robots")),
    ):
        if figures:
            lines += ["", f"## {title}", f"| {columns[0]} | {columns[1].replace('_', ' ')} | {head}"]
            lines += ["|---|---|---|---|---|"]
            lines += [
                f"| {getattr(figure, columns[0])} | {getattr(figure, columns[1]):g} "
                f"| {_seconds(figure.all_placed.median)} | {_share(figure.placed)} "
                f"| {_share(figure.noticed)} of {figure.walks} |"
                for figure in figures
            ]
    if found.starts:
        lines += ["", "## One robot, random starts", "| building | hidden in the dark | and facing the light |"]
        lines += ["|---|---|---|"]
        lines += [
            f"| {start.building} | {start.dark} of {start.starts} | {start.good} of {start.starts} |"
            for start in found.starts
        ]
    return "\n".join(lines)


def _seconds(value: float) -> str:
    return f"{value:.0f} s" if math.isfinite(value) else "never"


def _share(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0%}"
