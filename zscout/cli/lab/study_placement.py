"""`zscout study placement`: the paper's Figure 3 under every policy, unlike machines under every metric."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from zscout.cli import common
from zscout.cli.lab.study_options import (
    check_recording,
    parse_seeds,
    print_recording,
    progress,
    rrd_option,
    seeds_option,
)
from zscout.config.strict import BadInput

if TYPE_CHECKING:
    from zscout.lab.study.placement.study import PlacementReport

MAX_SEEDS: Final = 1_000
"""More take hours."""
SPLITS: Final = 3
"""Splits of components that are printed for each policy; --json has all."""
TITLES: Final = {"simultaneous": "(a) all at once", "staggered": "(b) one net a minute"}


@click.command()
@seeds_option("5", "Runs of each kind: so many, or those of seeds A to B.")
@common.json_option("Print one JSON object instead of tables.")
@rrd_option(what="of the load curves")
def placement(seeds: str, as_json: bool, rrd: Path | None) -> None:
    """Compares how the load balancer's policies and metrics place components, on simulated hosts.

    Three Place Sensor Nets on three workstations, started at once and a minute apart (Figure 3 of the paper),
    under every policy; a mixed batch on machines of unlike speed and memory under every metric; and what
    metric `auto` learns where one figure decides. A seed gives the same on every machine. docs/placement.md
    says what was found.

    \b
    Examples:
      zscout study placement
      zscout study placement --seeds 50 --json
      zscout study placement --rrd placement.rrd && zscout view placement.rrd
    """
    numbers = parse_seeds(seeds)
    if len(numbers) > MAX_SEEDS:
        raise BadInput(f"--seeds: {len(numbers)} are more than {MAX_SEEDS}; ask for fewer")
    check_recording(rrd)
    from zscout.lab.study.placement.study import parts, study

    with progress(len(numbers) * parts()) as advance:
        report, outcomes = study(numbers, advance)
    if rrd is not None:
        from zscout.lab.plots.placement import record

        record(rrd, report, outcomes)
    if as_json:
        common.print_json(dataclasses.asdict(report))
        return
    _print(report)
    print_recording(rrd)


def _print(report: PlacementReport) -> None:
    for scenario, title in TITLES.items():
        common.print_table(
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
        common.print_line("")
    common.print_table(
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
    common.print_line("")
    common.print_table(
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
