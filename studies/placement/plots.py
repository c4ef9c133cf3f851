"""The study of placement as a Rerun recording: a tab for each scenario with the hosts' load by policy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from studies.placement.simulation import PlacementOutcome
from studies.placement.study import SCENARIOS, PlacementReport
from studies.recording import COLOURS, MARGIN, VIRTUAL_TIME, draw_curve, recording, tabs_and_summary, whole_time
from zscout.types import POLICIES, SECOND, Ns, Policy

if TYPE_CHECKING:
    import rerun.blueprint as rrb

APPLICATION: Final = "zscout-study-placement"
WIDTHS: Final = (6.0, 3.5, 1.5)
"""Line width of the curves, by host, so that equal curves all remain visible."""
TITLES: Final = {"simultaneous": "(a) all at once", "staggered": "(b) one net a minute"}
MARKS: Final = 30
"""Number of marks from the bottom to the top of a plot. Marks of the same moment are stacked."""

Outcomes: TypeAlias = Mapping[tuple[str, Policy], PlacementOutcome]
Points: TypeAlias = list[tuple[Ns, float]]


def record(path: Path, report: PlacementReport, outcomes: Outcomes) -> None:
    """Replaces an existing file. `outcomes` are by scenario and policy. Raises BadInput if it can't be written."""
    import rerun as rr

    with recording(path, APPLICATION, _blueprint(outcomes), _words(report)) as stream:
        for (scenario, policy), outcome in outcomes.items():
            marks = _marks(outcome, _top(outcomes, scenario) / MARKS)
            for number, (host, curve) in enumerate(outcome.curves.items()):
                colour, width = COLOURS[number % len(WIDTHS)], WIDTHS[number % len(WIDTHS)]
                line = rr.SeriesLines(colors=[colour], names=[host], widths=[width])
                draw_curve(stream, f"{scenario}/{policy}/load/{host}", line, curve)
                if marks[host]:
                    points = rr.SeriesPoints(colors=[colour], names=[f"▲ {host}"], markers="up", marker_sizes=[5.0])
                    draw_curve(stream, f"{scenario}/{policy}/placed/{host}", points, marks[host])


def _marks(outcome: PlacementOutcome, apart: float) -> dict[str, Points]:
    """Marks by host: above its curve, for each component, when it was placed. Marks of one moment are stacked `apart`
    in load average, in the order of placement, so that all can be counted."""
    marks: dict[str, Points] = {host: [] for host in outcome.curves}
    taken: dict[Ns, list[float]] = {}
    for component, host in outcome.placed.items():
        at = outcome.placed_at[component]
        others = taken.setdefault(at, [])
        mark = apart + next((load for time, load in reversed(outcome.curves[host]) if time <= at), 0.0)
        for other in sorted(others):
            if abs(mark - other) < apart * 0.99:
                mark = other + apart
        others.append(mark)
        marks[host].append((at, mark))
    return marks


def _top(outcomes: Outcomes, scenario: str) -> float:
    """The highest load average of a scenario under any policy, as the common scale of its plots."""
    curves = [curve for (name, _), outcome in outcomes.items() for curve in outcome.curves.values() if name == scenario]
    return max((load for curve in curves for _, load in curve), default=1.0) or 1.0


def _blueprint(outcomes: Outcomes) -> rrb.Blueprint:
    """Plots with fixed axes, so that the plots of a scenario are complete and comparable."""
    import rerun.blueprint as rrb

    def plot(scenario: str, policy: Policy, outcome: PlacementOutcome) -> rrb.TimeSeriesView:
        end = max((curve[-1][0] for curve in outcome.curves.values() if curve), default=SECOND)
        top, counts = _top(outcomes, scenario), outcome.counts()
        given = ", ".join(map(str, counts[:-1])) + f" and {counts[-1]}" if counts[1:] else str(counts[0])
        return rrb.TimeSeriesView(
            origin=f"/{scenario}/{policy}",
            name=f"{policy}: {given} components; load average of each host",
            axis_x=whole_time(end),
            axis_y=rrb.archetypes.ScalarAxis(range=(-MARGIN * top, (1 + 2 * MARGIN) * top)),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        )

    tabs = [
        rrb.Grid(
            *(plot(scenario, policy, outcomes[scenario, policy]) for policy in POLICIES),
            grid_columns=2,
            name=TITLES[scenario],
        )
        for scenario in SCENARIOS
    ]
    return tabs_and_summary(tabs, VIRTUAL_TIME, (74, 26))


def _words(report: PlacementReport) -> str:
    seeds = "1 seed" if report.seeds == 1 else f"{report.seeds} seeds; the curves are of the first"
    lines = [
        "# Where components go",
        f"{seeds}.",
        "",
        "A triangle marks the placement of a component; it has the colour of its host.",
        "The curves of hosts with the same load cover each other.",
        "",
        "*Load apart*: highest minus lowest load average, mean over the run.",
    ]
    for scenario in SCENARIOS:
        lines += ["", f"## {TITLES[scenario]}", "| policy | usual split | load apart |", "|---|---|---|"]
        lines += [
            f"| {spread.policy} | {next(iter(spread.splits))} | {spread.apart:.2f} |"
            for spread in report.spreads
            if spread.scenario == scenario
        ]
    lines += ["", "## A mixed batch on unlike hosts", "| metric, policy | last end | mean |", "|---|---|---|"]
    lines += [
        f"| {batch.metric}, {batch.policy} | {batch.makespan:.0f} s | {batch.completion:.0f} s |"
        for batch in report.batches
    ]
    return "\n".join(lines)
