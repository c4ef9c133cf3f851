"""A study as a Rerun recording: a tab for each family, with curves over time and bars side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from studies.recording import COLOURS, VIRTUAL_TIME, draw_curve, recording, tabs_and_summary, whole_time
from studies.scheduling.measures import Curve
from studies.scheduling.summary import FamilyReport, SchedulingReport
from zscout.types import SECOND

if TYPE_CHECKING:
    import rerun.blueprint as rrb

APPLICATION: Final = "zscout-study"
BARS: Final = (
    ("in_use", "RCs in use (%)", 100.0),
    ("wait_mean", "Mean wait (s)", 1.0),
    ("wait_p99", "p99 wait (s)", 1.0),
    ("wait_longest_mean", "Longest wait (s)", 1.0),
)
"""Field of `StrategyReport`, title, factor: each is a pane of bars, one for each strategy."""


def record(path: Path, report: SchedulingReport, curves: Mapping[tuple[str, str], Curve]) -> None:
    """Replaces an existing file. `curves` are by family and strategy. Raises BadInput if the file can't be written."""
    import rerun as rr

    with recording(path, APPLICATION, _blueprint(report, curves), _words(report)) as stream:
        for family in report.families:
            for number, strategy in enumerate(family.strategies):
                colour = COLOURS[number % len(COLOURS)]
                for field, _, factor in BARS:
                    bar = rr.BarChart([getattr(strategy, field) * factor], abscissa=[number], color=colour)
                    stream.log(f"{family.family}/{field}/{strategy.strategy}", bar, static=True)
                drawn = curves.get((family.family, strategy.strategy))
                if drawn is None:
                    continue
                look = rr.SeriesLines(
                    colors=[colour],
                    names=[strategy.strategy],
                    widths=[1.5],
                    interpolation_mode=rr.components.InterpolationMode.StepAfter,
                )
                for name, values in (("used", drawn.used), ("waiting", drawn.waiting)):
                    points = [(at, float(value)) for at, value in zip(drawn.times, values, strict=True)]
                    draw_curve(stream, f"{family.family}/{name}/{strategy.strategy}", look, points)


def _blueprint(report: SchedulingReport, curves: Mapping[tuple[str, str], Curve]) -> rrb.Blueprint:
    import rerun.blueprint as rrb

    seed = report.seeds[0]

    def tab(family: FamilyReport) -> rrb.Container:
        drawn = [curve for (name, _), curve in curves.items() if name == family.family]
        # From the first request to the last end.
        axis = whole_time(max((curve.times[-1] for curve in drawn if curve.times), default=0) or SECOND)
        plots = [
            rrb.TimeSeriesView(
                origin=f"/{family.family}/{name}",
                name=f"{title}, seed {seed}",
                axis_x=axis,
                plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
            )
            for name, title in (("used", "RCs in use"), ("waiting", "ARCs that wait"))
        ]
        # The legend of the curves also explains the bars, which a legend of their own would cover.
        bars = [
            rrb.BarChartView(origin=f"/{family.family}/{field}", name=title, plot_legend=rrb.PlotLegend(visible=False))
            for field, title, _ in BARS
        ]
        return rrb.Vertical(*plots, rrb.Horizontal(*bars), row_shares=[3, 3, 2], name=family.family)

    return tabs_and_summary([tab(family) for family in report.families], VIRTUAL_TIME)


def _words(report: SchedulingReport) -> str:
    lines = ["# Strategies side by side", f"{len(report.seeds)} workloads of each family."]
    for family in report.families:
        lines += ["", f"## {family.family}", family.summary, ""]
        lines += ["| strategy | in use | mean wait | longest | thrown away |", "|---|---|---|---|---|"]
        lines += [
            f"| {row.strategy} | {row.in_use:.1%} | {row.wait_mean:.1f} s | {row.wait_longest:.0f} s "
            f"| {row.thrown_away:.1%} |"
            for row in family.strategies
        ]
        if (found := family.degenerate) is not None:
            lines += ["", f"`priority` is behind in {found.behind / found.situations:.1%} of situations."]
    if report.rule is not None:
        rule = report.rule
        lines += ["", "## Prediction", f"`{rule}`: right in {rule.hit_rate:.1%} of other seeds' cases."]
    return "\n".join(lines)
