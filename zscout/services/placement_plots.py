"""The study of placement as a Rerun recording: a tab for each scenario, in it the hosts' load by policy.

Rerun is large and is loaded by `record` alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from zscout.balancing.model import POLICIES, SECOND, Ns, Policy
from zscout.balancing.simulation import Outcome
from zscout.balancing.study import SCENARIOS, Report
from zscout.services.study_plots import page
from zscout.strict import BadInput

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION: Final = "zscout-study-placement"
TIME: Final = "virtual_time"
"""The timeline of the curves: a duration in seconds."""
COLOURS: Final = (0x56C1FFFF, 0xFFB454FF, 0xB5E07BFF)
"""RGBA by host."""
WRITE_SECONDS: Final = 10.0


def record(path: Path, report: Report, outcomes: Mapping[tuple[str, Policy], Outcome]) -> None:
    """Writes the recording, replacing what was there. `outcomes` are by scenario and policy.

    Raises BadInput where the file can't be written."""
    import rerun as rr

    recording = rr.RecordingStream(APPLICATION)
    try:
        recording.save(path, default_blueprint=_blueprint())
        for (scenario, policy), outcome in outcomes.items():
            for number, host in enumerate(outcome.curves):
                colour = COLOURS[number % len(COLOURS)]
                _host(recording, f"{scenario}/{policy}", host, colour, outcome)
        recording.log("summary", rr.TextDocument(_words(report), media_type="text/markdown"), static=True)
        recording.flush(timeout_sec=WRITE_SECONDS)
    except (RuntimeError, OSError, ValueError) as error:
        raise BadInput(f"--rrd {path}: it can't be written ({error}); give another file") from None
    finally:
        recording.disconnect()


def _host(recording: rr.RecordingStream, view: str, host: str, colour: int, outcome: Outcome) -> None:
    """A host's load curve, and on it a mark for each component at the moment it was placed there."""
    import rerun as rr

    curve = outcome.curves[host]
    path = f"{view}/load/{host}"
    recording.log(path, rr.SeriesLines(colors=[colour], names=[host], widths=[1.5]), static=True)
    _send(recording, path, curve)

    came = sorted(outcome.placed_at[name] for name, where in outcome.placed.items() if where == host)
    if not came:
        return
    path = f"{view}/placed/{host}"
    look = rr.SeriesPoints(colors=[colour], names=[f"placed on {host}"], markers="up", marker_sizes=[6.0])
    recording.log(path, look, static=True)
    # Marks of one instant stand above each other, so that they can be counted.
    marks = [(at, _load_at(curve, at) + 0.1 * came[:number].count(at)) for number, at in enumerate(came)]
    _send(recording, path, marks)


def _load_at(curve: list[tuple[Ns, float]], at: Ns) -> float:
    return next((load for time, load in reversed(curve) if time <= at), 0.0)


def _send(recording: rr.RecordingStream, path: str, points: list[tuple[Ns, float]]) -> None:
    import rerun as rr

    times = rr.TimeColumn(TIME, duration=[at / SECOND for at, _ in points])
    recording.send_columns(
        path, indexes=[times], columns=rr.Scalars.columns(scalars=[value for _, value in points])
    )


def _blueprint() -> rrb.Blueprint:
    import rerun.blueprint as rrb

    def tab(scenario: str) -> rrb.Container:
        views = [
            rrb.TimeSeriesView(
                origin=f"/{scenario}/{policy}",
                name=f"{policy}: load average",
                plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
            )
            for policy in POLICIES
        ]
        return rrb.Grid(*views, grid_columns=2, name=scenario)

    return page([tab(scenario) for scenario in SCENARIOS], TIME)


def _words(report: Report) -> str:
    lines = ["# Where components go", f"{report.seeds} seeds; the curves are of the first."]
    for scenario in SCENARIOS:
        lines += ["", f"## {scenario}", "| policy | usual split | load apart |", "|---|---|---|"]
        lines += [
            f"| {one.policy} | {next(iter(one.splits))} | {one.apart:.2f} |"
            for one in report.spreads
            if one.scenario == scenario
        ]
    lines += ["", "## A mixed batch", "| metric, policy | last end | mean |", "|---|---|---|"]
    lines += [
        f"| {one.metric}, {one.policy} | {one.makespan:.0f} s | {one.completion:.0f} s |"
        for one in report.batches
    ]
    return "\n".join(lines)
