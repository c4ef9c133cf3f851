"""`zscout component migrate`, `drain` and `uncordon`: have components go on elsewhere, empty a host, use it again."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import click

from zscout import terminal
from zscout.behaviors.client.placer_client import PlacerClient, PlacerSilent
from zscout.behaviors.client.request import RequestRefused
from zscout.cli import common
from zscout.cli.components import placing
from zscout.cli.ownership import yes_option
from zscout.cli.requests.options import timeout_option
from zscout.config.strict import BadInput
from zscout.messages import DrainHost, MigrateComponent, Placement, Placements, UncordonHost


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
        interrupted = f"{name} is moved all the same; zscout component list tells how that goes"
        async with shown.within(None, str, interrupted):
            after = await _moved(placer, shown, before, to)
    moved = after.moves > before.moves
    if as_json:
        dead = after.dead if moved else None
        terminal.print_json(placing.placement_object(after) | {"from": before.host, "dead": dead})
    if after.host == before.host:
        shown.say(f"{name} is on {after.host} already")
    else:
        shown.say(f"{name} went from {before.host} to {after.host}{placing.out_of_work(after) if moved else ''}")


async def _moved(placer: PlacerClient, shown: placing.Progress, before: Placement, to: str | None) -> Placement:
    """Moves it, and shows how it goes. Raises Failed where it did not come to that."""
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
            why = f"it {placing.standing(now)}; {placing.remedy(now)}"
        raise common.Failed(f"{name} was not moved: {why}") from None
    if begun(record):
        while record.state not in ("running", *placing.OVER):
            shown.update(f"{name} {placing.standing(record)}")
            await placer.wait_changed()
            record = placer.placements.get(name, record)
        if record.state == "running":
            if record.host != before.host:
                return record
            raise common.Failed(f"{name} was not moved, it keeps running on {record.host}: {record.reason}")
    elif to == record.host:
        return record
    raise common.Failed(f"{name} was not moved: it {placing.standing(record)}; {placing.remedy(record)}")


@click.command()
@placing.host_argument
@timeout_option("Wait this long until it is empty, then exit with 1.")
@common.json_option("Print one JSON object.")
@common.runs
async def drain(host: str, timeout: float | None, as_json: bool) -> None:
    """Place nothing on a host any more, and move away every component that can be moved.

    Ends when no movable component is left; exit code 1 names those that stay, and why. The host stays cordoned, also
    after Ctrl-C or --timeout, until zscout uncordon.

    \b
    Examples:
      zscout drain anvil && ssh anvil sudo reboot
      zscout drain anvil --timeout 2m
    """
    cordoned = f"{host} stays cordoned; to use it again: zscout uncordon {host}"
    async with placing.connected("drain", as_json=as_json) as (_, shown, placer):
        at_first = {one.component for one in _there(placer, host)}

        def late() -> str:
            left = terminal.span(timeout or 0)
            return f"{host} is not empty after {left}: {_words(_there(placer, host))}; {cordoned}"

        async with shown.within(timeout, late, cordoned):
            try:
                drained = await placer.request(DrainHost(host), Placements)
            except RequestRefused as refused:
                lines = await placing.absent(placer.mesh, [host]) if refused.code == "unknown_host" else ()
                raise next(map(common.Failed, lines), refused) from None
            placer.take(*drained.components)
            # What is not running yet is moved when it does.
            while leaving := [one for one in _there(placer, host) if one.movable or one.state != "running"]:
                shown.update(f"{host}: {_words(leaving)}")
                await placer.wait_changed()
        stay = _there(placer, host)
        records = [one for name in sorted(at_first) if (one := placer.placements.get(name)) is not None]
        moved = [one for one in records if one.host not in (host, None) and one.state == "running"]
    if as_json:
        went, stays = ([placing.placement_object(one) for one in some] for some in (moved, stay))
        terminal.print_json({"host": host, "moved": went, "stay": stays})
    for one in moved:
        shown.say(f"{one.component} went to {one.host}{placing.out_of_work(one)}")
    if stay:
        raise common.Failed(f"{host} is not empty: {_words(stay)}; end them with zscout component stop; {cordoned}")
    shown.say(f"{host} is empty; {cordoned}")


@click.command()
@placing.host_argument
@common.json_option("Print one JSON object.")
@common.runs
async def uncordon(host: str, as_json: bool) -> None:
    """Use a drained host again. Components that left it do not move back by themselves.

    \b
    Example:
      zscout uncordon anvil
    """
    async with placing.connected("uncordon", as_json=as_json) as (_, _, placer):
        if host not in placer.cordoned:
            for line in await placing.absent(placer.mesh, [host]):
                terminal.print_line(f"zscout: {line}", sys.stderr)
        uncordoned = await placer.request(UncordonHost(host), Placements)
    if as_json:
        terminal.print_json({"host": host, "components": list(map(placing.placement_object, uncordoned.components))})
    else:
        terminal.print_line(f"{host} is used again")


def _there(placer: PlacerClient, host: str) -> list[Placement]:
    found = (one for _, one in sorted(placer.placements.items()))
    return [one for one in found if host in (one.host, one.to) and one.state not in placing.OVER]


def _words(some: Sequence[Placement]) -> str:
    words = []
    for one in some:
        why = one.reason or ("" if one.movable else "it can't be moved")
        stays = "stays" + (f" ({why})" if why else "")
        words.append(f"{one.component} {stays if one.state == 'running' else placing.standing(one)}")
    return ", ".join(words)
