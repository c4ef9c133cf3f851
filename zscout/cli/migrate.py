"""`zscout migrate`: have a running component go on on another host."""

from __future__ import annotations

import click

from zscout.cli import common, offers
from zscout.cli.placing import (
    OVER,
    Placed,
    PlacerRefused,
    Progress,
    component_named,
    placement_object,
    standing,
    unknown,
)
from zscout.keyexpr import check_name
from zscout.messages import MigrateComponent, Placement


@click.command()
@click.argument("name", shell_complete=offers.components)
@click.option(
    "--to", metavar="HOST", shell_complete=offers.hosts, help="Where to. Default: the best other host."
)
@common.json_option("Print one JSON object.")
def migrate(name: str, to: str | None, as_json: bool) -> int:
    """Move a running component to another host, with its state and all that it holds.

    Only what can give and take a checkpoint can be moved. Says where it went, and for how long it was out of
    work. If it fails, the component goes on where it was.

    \b
    Examples:
      zscout migrate counter
      zscout migrate counter --to bellows --json | jq .dead
    """
    component_named(name)
    if to is not None:
        check_name(to, "--to")
    return common.run(_migrate(name, to, as_json=as_json))


async def _migrate(name: str, to: str | None, *, as_json: bool) -> int:
    async with common.connected("migrate") as client:
        with Progress(quiet=as_json) as shown, Placed(client) as placed:
            await placed.look()
            before = placed.records.get(name)
            if before is None:
                raise unknown(name, placed.records)
            interrupted = f"{name} is moved all the same; zscout components tells how that goes"
            async with shown.within(None, str, interrupted):
                after = await _moved(placed, shown, before, to)
    dead = after.dead if after.moves > before.moves else None
    if as_json:
        common.print_json(placement_object(after) | {"from": before.host, "dead": dead})
    if after.host == before.host:
        shown.say(f"{name} is on {after.host} already")
    else:
        took = "" if dead is None else f", out of work for {dead * 1000:.0f} ms"
        shown.say(f"{name} went from {before.host} to {after.host}{took}")
    return 0


async def _moved(placed: Placed, shown: Progress, before: Placement, to: str | None) -> Placement:
    """Moves it, and tells how it goes. Raises Failed where it did not come to that."""
    name = before.component

    def begun(record: Placement) -> bool:
        return record.state == "moving" or record.host != before.host

    try:
        record = await placed.once(MigrateComponent(name, to, wait=0.0), begun)
    except PlacerRefused as refused:
        raise common.Failed(f"{name} was not moved: {refused}") from None
    if not begun(record):
        if to == record.host:
            return record
        raise common.Failed(common.clean(f"{name} was not moved: it {standing(record)}"))
    while True:
        if record.state == "running":
            if record.host != before.host:
                return record
            raise common.Failed(
                common.clean(f"{name} was not moved, it goes on on {record.host}: {record.reason}")
            )
        if record.state in OVER:
            raise common.Failed(common.clean(f"{name} was not moved: it {standing(record)}"))
        shown.tell(f"{name} {standing(record)}")
        await placed.news()
        record = placed.records.get(name, record)
