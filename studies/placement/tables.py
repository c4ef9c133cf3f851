"""Tables of `python -m studies placement`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from studies.placement.study import PlacementReport
from zscout import terminal

SPLITS: Final = 3
"""Splits of components that are printed for each policy; --json has all."""
TITLES: Final = {"simultaneous": "(a) all at once", "staggered": "(b) one net a minute"}


def print_report(report: PlacementReport) -> None:
    for scenario, title in TITLES.items():
        terminal.print_table(
            ["policy", "all hosts used", "within one", "load apart", "components on each (seeds)"],
            [
                [
                    spread.policy,
                    f"{spread.used_all} of {report.seeds}",
                    f"{spread.even} of {report.seeds}",
                    f"{spread.apart:.2f}",
                    _splits(spread.splits),
                ]
                for spread in report.spreads
                if spread.scenario == scenario
            ],
            title=f"{title}: 12 components of three Place Sensor Nets on three workstations, by load_average",
        )
        terminal.print_line("")
    terminal.print_table(
        ["metric", "policy", "last end", "sooner", "mean completion", "sooner"],
        [
            [
                batch.metric,
                batch.policy,
                f"{batch.makespan:.0f} s",
                f"{batch.makespan_gain:+.0%}",
                f"{batch.completion:.1f} s",
                f"{batch.completion_gain:+.0%}",
            ]
            for batch in report.batches
        ],
        title="30 components, some heavy, some large, some light, on speeds 1, 2, 4 with 1, 4, 2 GB",
    )
    terminal.print_line("")
    terminal.print_table(
        ["deciding figure", "auto used (seeds)", "its explanation in the first"],
        [
            [fleet.decides, ", ".join(f"{metric} ({seeds})" for metric, seeds in fleet.used.items()), fleet.why]
            for fleet in report.learnt
        ],
        title="Metric auto where a single figure decides: its last 20 of 60 placements",
    )


def _splits(splits: Mapping[str, int]) -> str:
    shown = [f"{split} ({seeds})" for split, seeds in list(splits.items())[:SPLITS]]
    return ", ".join(shown + ["..."] * (len(splits) > SPLITS))
