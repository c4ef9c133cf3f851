"""`zscout replay FILE`: schedule a workload by the same code that the RCM runs."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import click

from zscout.cli import common
from zscout.cli.simulation.options import check_rrd, rrd_option
from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling.strategies import STRATEGIES


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--strategy", type=click.Choice(list(STRATEGIES)), default="priority", help="Scheduling strategy.")
@common.json_option("Print one JSON object instead of the table.")
@rrd_option(what="")
def replay(file: Path, strategy: StrategyName, as_json: bool, rrd: Path | None) -> None:
    """Compute the holds that the requests in FILE would get.

    FILE is a workload (TOML): devices, and requests with their times. table1.toml, of the paper, comes with zscout and
    is used if there is no other file of that name. No mesh is needed, and no time passes. Without --json the command
    prints a table with a row for each device (for each holder of a sharable device) and a column for each second, or
    for each interval between two events if seconds are not the right step.

    \b
    Examples:
      zscout replay table1.toml
      zscout replay table1.toml --json | jq '.holds[] | select(.outcome == "preempted")'
      zscout replay table1.toml --rrd table1.rrd && zscout view table1.rrd
    """
    check_rrd(rrd, writable=False)
    from zscout.simulation.plots.replay_report import replay_file

    replay_file(_found(file), strategy, rrd, as_json=as_json)


def _found(file: Path) -> Path:
    """Return the file, or the file of this name that comes with zscout."""
    if file.parent == Path() and not file.exists():
        bundled = Path(str(files("zscout.simulation") / "paper" / file.name))
        if bundled.suffix == ".toml" and bundled.exists():
            return bundled
    return file
