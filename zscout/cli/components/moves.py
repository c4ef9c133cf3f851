"""`zscout component migrate`: a component continues on another host."""

from __future__ import annotations

import click

from zscout import terminal
from zscout.behaviors.client.placer_client import PlacerClient, PlacerSilent
from zscout.behaviors.client.request import RequestRefused
from zscout.cli import common
from zscout.cli.components import placing
from zscout.cli.ownership import yes_option
from zscout.config.strict import BadInput
from zscout.messages import MigrateComponent, Placement


@click.command()
@placing.component_argument
@placing.host_option("--to", "Host to move to. Default: the best other host.")
@yes_option
@common.json_option("Print one JSON object.")
@common.runs
async def migrate(name: str, to: str | None, yes: bool, as_json: bool) -> None:
    """Move a running component to another host, with its state and its holds.

    Only a kind with checkpoint() and restore() can be moved. Prints the new host, and for how long the component was
    out of work. If the move fails, the component keeps running where it was. Exit code 2: there is no host of that
    name.

    \b
    Examples:
      zscout component migrate counter
      zscout component migrate counter --to bellows --json | jq .dead
    """
    async with placing.connected("migrate", as_json=as_json) as (client, shown, placer):
        before = placer.placements.get(name)
        if before is None:
            raise placing.unknown(name, placer.placements)
        await placing.ask_for_others(client, placer, [name], "move", yes=yes)
        interrupted = f"the move of {name} continues; see zscout component list"
        async with shown.within(None, str, interrupted):
            after = await _move(placer, shown, before, to)
    moved = after.moves > before.moves
    if as_json:
        dead = after.dead if moved else None
        terminal.print_json(placing.placement_object(after) | {"from": before.host, "dead": dead})
    if after.host == before.host:
        shown.finish(f"{name} is on {after.host} already")
    else:
        shown.finish(f"{name} went from {before.host} to {after.host}{placing.out_of_work(after) if moved else ''}")


async def _move(placer: PlacerClient, shown: placing.Progress, before: Placement, to: str | None) -> Placement:
    """Raises Failed if it was not moved."""
    name = before.component

    def begun(record: Placement) -> bool:
        return record.state == "moving" or record.host != before.host

    try:
        record = await placer.request_once(MigrateComponent(name, to, wait=0.0), begun)
    except PlacerSilent:
        raise
    except RequestRefused as refused:
        if to is not None and refused.code == "unknown_host":
            for line in await placing.absent(placer.mesh, [to]):
                raise BadInput(f"--to: {line}") from None
        now = placer.placements.get(name, before)
        why = str(refused)
        if refused.code == "not_running" and now.state != "running":
            why = f"it {placing.state_words(now)}; {placing.remedy(now)}"
        raise common.Failed(f"{name} was not moved: {why}") from None
    if begun(record):
        while record.state not in ("running", *placing.OVER):
            shown.update(f"{name} {placing.state_words(record)}")
            await placer.wait_changed()
            record = placer.placements.get(name, record)
        if record.state == "running":
            if record.host != before.host:
                return record
            raise common.Failed(f"{name} was not moved; it is still running on {record.host}: {record.reason}")
    elif to == record.host:
        return record
    raise common.Failed(f"{name} was not moved: it {placing.state_words(record)}; {placing.remedy(record)}")
