"""What `python -m studies placement` prints for people."""

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
                    one.policy,
                    f"{one.used_all} of {report.seeds}",
                    f"{one.even} of {report.seeds}",
                    f"{one.apart:.2f}",
                    _splits(one.splits),
                ]
                for one in report.spreads
                if one.scenario == scenario
            ],
            title=f"{title}: 12 components of three Place Sensor Nets on three workstations, by load_average",
        )
        terminal.print_line("")
    terminal.print_table(
        ["metric", "policy", "last end", "sooner", "mean completion", "sooner"],
        [
            [
                one.metric,
                one.policy,
                f"{one.makespan:.0f} s",
                f"{one.makespan_gain:+.0%}",
                f"{one.completion:.1f} s",
                f"{one.completion_gain:+.0%}",
            ]
            for one in report.batches
        ],
        title="30 components, some heavy, some large, some light, on speeds 1, 2, 4 with 1, 4, 2 GB",
    )
    terminal.print_line("")
    terminal.print_table(
        ["what decides", "auto used (seeds)", "what it says in the first"],
        [
            [one.decides, ", ".join(f"{metric} ({seeds})" for metric, seeds in one.used.items()), one.why]
            for one in report.learnt
        ],
        title="What metric auto learns where one figure decides: its last 20 of 60 placements",
    )


def _splits(splits: Mapping[str, int]) -> str:
    shown = [f"{split} ({seeds})" for split, seeds in list(splits.items())[:SPLITS]]
    return ", ".join(shown + ["..."] * (len(splits) > SPLITS))
