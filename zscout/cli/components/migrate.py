"""`zscout migrate`: have a running component go on on another host."""

from __future__ import annotations

import click

from zscout import terminal
from zscout.behaviors.client.placer_client import PlacerClient, PlacerSilent
from zscout.behaviors.client.request import RequestRefused
from zscout.cli import common, completions
from zscout.cli.components.placing import (
    OVER,
    Progress,
    component_named,
    placement_object,
    placer_of,
    standing,
    unknown,
)
from zscout.keyexpr import check_name
from zscout.messages import MigrateComponent, Placement


@click.command()
@click.argument("name", shell_complete=completions.components)
@click.option(
    "--to", metavar="HOST", shell_complete=completions.hosts, help="Where to. Default: the best other host."
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
        with Progress(quiet=as_json) as shown, placer_of(client) as placer:
            await placer.refresh()
            before = placer.placements.get(name)
            if before is None:
                raise unknown(name, placer.placements)
            interrupted = f"{name} is moved all the same; zscout components tells how that goes"
            async with shown.within(None, str, interrupted):
                after = await _moved(placer, shown, before, to)
    dead = after.dead if after.moves > before.moves else None
    if as_json:
        terminal.print_json(placement_object(after) | {"from": before.host, "dead": dead})
    if after.host == before.host:
        shown.say(f"{name} is on {after.host} already")
    else:
        took = "" if dead is None else f", out of work for {dead * 1000:.0f} ms"
        shown.say(f"{name} went from {before.host} to {after.host}{took}")
    return 0


async def _moved(placer: PlacerClient, shown: Progress, before: Placement, to: str | None) -> Placement:
    """Moves it, and shows how it goes. Raises Failed where it did not come to that."""
    name = before.component

    def begun(record: Placement) -> bool:
        return record.state == "moving" or record.host != before.host

    try:
        record = await placer.request_once(MigrateComponent(name, to, wait=0.0), begun)
    except PlacerSilent:
        raise
    except RequestRefused as refused:
        raise common.Failed(f"{name} was not moved: {refused}") from None
    if not begun(record):
        if to == record.host:
            return record
        raise common.Failed(terminal.clean(f"{name} was not moved: it {standing(record)}"))
    while True:
        if record.state == "running":
            if record.host != before.host:
                return record
            raise common.Failed(
                terminal.clean(f"{name} was not moved, it goes on on {record.host}: {record.reason}")
            )
        if record.state in OVER:
            raise common.Failed(terminal.clean(f"{name} was not moved: it {standing(record)}"))
        shown.update(f"{name} {standing(record)}")
        await placer.wait_changed()
        record = placer.placements.get(name, record)
