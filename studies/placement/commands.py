"""The study of placement as a command."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import click

from studies.options import MAX_SEEDS, seeds_option, show
from zscout import terminal
from zscout.cli import common
from zscout.cli.simulation.options import check_rrd, rrd_option


@click.command()
@seeds_option("5", "Runs of each kind: a number, or a range of seeds A-B.", MAX_SEEDS)
@common.json_option("Print one JSON object instead of tables.")
@rrd_option(what=" of the load curves")
def placement(seeds: range, as_json: bool, rrd: Path | None) -> None:
    """Compare how the load balancer's policies and metrics place components, on simulated hosts.

    Three Place Sensor Nets on three workstations, started at once and a minute apart (Figure 3 of the paper),
    under every policy; a mixed batch on machines of unlike speed and memory under every metric; and the metric
    that `auto` learns if a single figure decides. A seed gives the same result on every machine. The results are
    in docs/evaluation.

    \b
    Examples:
      python -m studies placement
      python -m studies placement --seeds 50 --json
      python -m studies placement --rrd placement.rrd && zscout view placement.rrd
    """
    check_rrd(rrd)
    from studies.placement.study import parts
    from studies.placement.study import study as compare
    from studies.placement.tables import print_report

    with terminal.progress(len(seeds) * parts()) as advance:
        report, outcomes = compare(seeds, advance)
    if rrd is not None:
        from studies.placement.plots import record

        record(rrd, report, outcomes)
    show(dataclasses.asdict(report), rrd, partial(print_report, report), as_json=as_json)
