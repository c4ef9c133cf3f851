"""`zscout demo`: what zscout does, on a live mesh on this machine."""

from __future__ import annotations

import click

from zscout.cli.demo.placement import placement
from zscout.cli.demo.robots import robots
from zscout.cli.demo.table1 import table1
from zscout.cli.groups import DefaultGroup


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
