"""`zscout demo`: what zscout does, on a live mesh on this machine."""

from __future__ import annotations

import click

from zscout.cli.groups import DefaultGroup
from zscout.cli.lab.demo_placement import placement
from zscout.cli.lab.demo_robots import robots
from zscout.cli.lab.demo_table1 import table1


@click.group(cls=DefaultGroup, default="robots")
def demo() -> None:
    """Show what zscout does on a live mesh on this machine; `robots` unless another one is named.

    \b
    Examples:
      zscout demo
      zscout demo table1 --out demo.rrd
      zscout demo placement
    """


demo.add_command(robots)
demo.add_command(table1)
demo.add_command(placement)
