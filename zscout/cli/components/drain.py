"""`zscout drain` and `zscout uncordon`: empty a host of components, and use it again."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

import click

from zscout import terminal
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.cli import common, completions
from zscout.cli.components.placing import (
    OVER,
    Progress,
    placement_object,
    placer_of,
    standing,
)
from zscout.cli.requests.arguments import Duration
from zscout.keyexpr import check_name
from zscout.messages import DrainHost, Placement, Placements, UncordonHost


@click.command()
@click.argument("host", shell_complete=completions.hosts)
@click.option("--timeout", type=Duration(), help="Wait at most so long until it is empty, then exit with 1.")
@common.json_option("Print one JSON object.")
def drain(host: str, timeout: Decimal | None, as_json: bool) -> int:
    """Place nothing on a host any more, and move away what can be moved.

    Ends when no movable component is left; exit code 1 names what stays, and why. The host stays cordoned,
    also after Ctrl-C or --timeout, until zscout uncordon.

    \b
    Examples:
      zscout drain anvil && ssh anvil sudo reboot
      zscout drain anvil --timeout 2m
    """
    check_name(host, "host")
    return common.run(_drain(host, None if timeout is None else float(timeout), as_json=as_json))


@click.command()
@click.argument("host", shell_complete=completions.hosts)
@common.json_option("Print one JSON object.")
def uncordon(host: str, as_json: bool) -> int:
    """Use a host again that was drained. Nothing moves back by itself.

    \b
    Example:
      zscout uncordon anvil
    """
    check_name(host, "host")
    return common.run(_uncordon(host, as_json=as_json))


async def _drain(host: str, timeout: float | None, *, as_json: bool) -> int:
    cordoned = f"{host} stays cordoned; to use it again: zscout uncordon {host}"
    async with common.connected("drain") as client:
        with Progress(quiet=as_json) as shown, placer_of(client) as placer:
            await placer.refresh()
            at_first = {one.component for one in _there(placer, host)}

            def late() -> str:
                left = terminal.span(timeout or 0)
                return f"{host} is not empty after {left}: {_words(_there(placer, host))}; {cordoned}"

            async with shown.within(timeout, late, cordoned):
                placer.take(*(await placer.request(DrainHost(host), Placements)).components)
                while leaving := [one for one in _there(placer, host) if _leaves(one)]:
                    shown.update(f"{host}: {_words(leaving)}")
                    await placer.wait_changed()
            stay = _there(placer, host)
            moved = [placer.placements[name] for name in sorted(at_first) if _elsewhere(placer, name, host)]
    if as_json:
        terminal.print_json(
            {
                "host": host,
                "moved": [placement_object(one) for one in moved],
                "stay": [placement_object(one) for one in stay],
            }
        )
    for one in moved:
        took = "" if one.dead is None else f", out of work for {one.dead * 1000:.0f} ms"
        shown.say(f"{one.component} went to {one.host}{took}")
    if stay:
        raise common.Failed(
            terminal.clean(f"{host} is not empty: {_words(stay)}; end them with zscout stop; {cordoned}")
        )
    shown.say(f"{host} is empty; {cordoned}")
    return 0


async def _uncordon(host: str, *, as_json: bool) -> int:
    async with common.connected("uncordon") as client:
        uncordoned = await placer_of(client).request(UncordonHost(host), Placements)
    if as_json:
        terminal.print_json({"host": host, "components": list(map(placement_object, uncordoned.components))})
    else:
        terminal.print_line(f"{host} is used again")
    return 0


def _there(placer: PlacerClient, host: str) -> list[Placement]:
    """What is on a host, or coming to it."""
    found = (one for _, one in sorted(placer.placements.items()))
    return [one for one in found if host in (one.host, one.to) and one.state not in OVER]


def _leaves(one: Placement) -> bool:
    """Whether it is to be waited for: what is not running yet is moved when it does."""
    return one.movable or one.state != "running"


def _elsewhere(placer: PlacerClient, name: str, host: str) -> bool:
    record = placer.placements.get(name)
    return record is not None and record.host not in (host, None) and record.state == "running"


def _words(some: Sequence[Placement]) -> str:
    return ", ".join(_word(one) for one in some)


def _word(one: Placement) -> str:
    if one.state != "running":
        return f"{one.component} {standing(one)}"
    why = one.reason or ("" if one.movable else "it can't be moved")
    return f"{one.component} stays" + (f" ({why})" if why else "")
