"""A study as a Rerun recording: a tab for each family, with curves over time and bars side by side.

Rerun is large and is loaded by `record` alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from zscout.scheduling.model import SECOND
from zscout.scheduling.study.measures import Curve
from zscout.scheduling.study.summary import FamilyReport, Report
from zscout.strict import BadInput

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION: Final = "zscout-study"
TIME: Final = "virtual_time"
"""The timeline of the curves: a duration in seconds from the first request."""
COLOURS: Final = (0x56C1FFFF, 0xFFB454FF, 0xB5E07BFF, 0xD6A6FFFF)
"""RGBA by strategy."""
MARGIN: Final = 0.03
"""Part of the whole that is left free at the sides of a plot."""
WRITE_SECONDS: Final = 10.0

BARS: Final = (
    ("in_use", "RCs in use (%)", 100.0),
    ("wait_mean", "Mean wait (s)", 1.0),
    ("wait_p99", "p99 wait (s)", 1.0),
    ("wait_longest_mean", "Longest wait (s)", 1.0),
)
"""Field of `StrategyReport`, title, factor: each is a pane of bars, one for each strategy."""


def record(path: Path, report: Report, curves: Mapping[tuple[str, str], Curve]) -> None:
    """Writes the recording, replacing what was there. `curves` are by family and strategy.

    Raises BadInput where the file can't be written."""
    import rerun as rr

    recording = rr.RecordingStream(APPLICATION)
    try:
        recording.save(path, default_blueprint=_blueprint(report, curves))
        for family in report.families:
            _family(recording, family, curves)
        recording.log("summary", rr.TextDocument(_words(report), media_type="text/markdown"), static=True)
        recording.flush(timeout_sec=WRITE_SECONDS)
    except (RuntimeError, OSError, ValueError) as error:
        raise BadInput(f"--rrd {path}: it can't be written ({error}); give another file") from None
    finally:
        recording.disconnect()


def _family(
    recording: rr.RecordingStream, family: FamilyReport, curves: Mapping[tuple[str, str], Curve]
) -> None:
    import rerun as rr

    for number, one in enumerate(family.strategies):
        colour = COLOURS[number % len(COLOURS)]
        for field, _, factor in BARS:
            bar = rr.BarChart([getattr(one, field) * factor], abscissa=[number], color=colour)
            recording.log(f"{family.family}/{field}/{one.strategy}", bar, static=True)
        drawn = curves.get((family.family, one.strategy))
        if drawn is None:
            continue
        for name, values in (("used", drawn.used), ("waiting", drawn.waiting)):
            _steps(recording, f"{family.family}/{name}/{one.strategy}", one.strategy, colour, drawn, values)


def _steps(
    recording: rr.RecordingStream, path: str, name: str, colour: int, drawn: Curve, values: Sequence[int]
) -> None:
    import rerun as rr

    look = rr.SeriesLines(
        colors=[colour],
        names=[name],
        widths=[1.5],
        interpolation_mode=rr.components.InterpolationMode.StepAfter,
    )
    recording.log(path, look, static=True)
    times = rr.TimeColumn(TIME, duration=[time / SECOND for time in drawn.times])
    columns = rr.Scalars.columns(scalars=[float(value) for value in values])
    recording.send_columns(path, indexes=[times], columns=columns)


def _window(drawn: Sequence[Curve]) -> rr.TimeRange:
    """From the first request to the last end: without it a plot shows what the viewer's cursor is near."""
    import rerun as rr

    end = max((curve.times[-1] for curve in drawn if curve.times), default=0) / SECOND or 1.0
    boundary = rr.TimeRangeBoundary
    return rr.TimeRange(
        start=boundary.absolute(seconds=-MARGIN * end), end=boundary.absolute(seconds=(1 + MARGIN) * end)
    )


def _blueprint(report: Report, curves: Mapping[tuple[str, str], Curve]) -> rrb.Blueprint:
    import rerun.blueprint as rrb

    seed = report.seeds[0]

    def tab(family: FamilyReport) -> rrb.Container:
        window = _window([curve for (name, _), curve in curves.items() if name == family.family])
        plots = [
            rrb.TimeSeriesView(
                origin=f"/{family.family}/{name}",
                name=f"{title}, seed {seed}",
                axis_x=rrb.archetypes.TimeAxis(view_range=window),
                plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
            )
            for name, title in (("used", "RCs in use"), ("waiting", "ARCs that wait"))
        ]
        # The curves' legend says whose colour it is; the bars' would cover them.
        bars = [
            rrb.BarChartView(
                origin=f"/{family.family}/{field}", name=title, plot_legend=rrb.PlotLegend(visible=False)
            )
            for field, title, _ in BARS
        ]
        return rrb.Vertical(*plots, rrb.Horizontal(*bars), row_shares=[3, 3, 2], name=family.family)

    return page([tab(family) for family in report.families], TIME)


def page(tabs: Sequence[rrb.Container], time: str) -> rrb.Blueprint:
    """Plots in tabs, and beside them what was found, in words, from `/summary`."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(*tabs, active_tab=0),
            rrb.TextDocumentView(origin="/summary", name="What was found"),
            column_shares=[68, 32],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        # Else it plays, and the cursor runs over plots that show everything anyway.
        rrb.TimePanel(state="collapsed", timeline=time, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _words(report: Report) -> str:
    lines = ["# Strategies side by side", f"{len(report.seeds)} workloads of each family."]
    for family in report.families:
        lines += ["", f"## {family.family}", family.summary, ""]
        lines += ["| strategy | in use | mean wait | longest | thrown away |", "|---|---|---|---|---|"]
        lines += [
            f"| {one.strategy} | {one.in_use:.1%} | {one.wait_mean:.1f} s | {one.wait_longest:.0f} s "
            f"| {one.thrown_away:.1%} |"
            for one in family.strategies
        ]
        if (found := family.degenerate) is not None:
            lines += [
                "",
                f"`priority` is behind in {found.behind / found.situations:.1%} of situations.",
            ]
    if report.rule is not None:
        rule = report.rule
        lines += [
            "",
            "## What foretells it",
            f"`{rule}`: right in {rule.hit_rate:.1%} of other seeds' cases.",
        ]
    return "\n".join(lines)
