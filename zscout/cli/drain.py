"""`zscout drain` and `zscout uncordon`: empty a host of components, and use it again."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

import click

from zscout.cli import common, offers
from zscout.cli.arguments import Duration
from zscout.cli.placing import OVER, Placed, Progress, ask_placer, placement_object, standing
from zscout.keyexpr import check_name
from zscout.messages import DrainHost, Placement, Placements, UncordonHost


@click.command()
@click.argument("host", shell_complete=offers.hosts)
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
@click.argument("host", shell_complete=offers.hosts)
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
        with Progress(quiet=as_json) as shown, Placed(client) as placed:
            await placed.look()
            at_first = {one.component for one in _there(placed, host)}

            def late() -> str:
                left = common.span(timeout or 0)
                return f"{host} is not empty after {left}: {_words(_there(placed, host))}; {cordoned}"

            async with shown.within(timeout, late, cordoned):
                placed.take(*(await ask_placer(client, DrainHost(host), Placements)).components)
                while leaving := [one for one in _there(placed, host) if _leaves(one)]:
                    shown.tell(f"{host}: {_words(leaving)}")
                    await placed.news()
            stay = _there(placed, host)
            moved = [placed.records[name] for name in sorted(at_first) if _elsewhere(placed, name, host)]
    if as_json:
        common.print_json(
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
            common.clean(f"{host} is not empty: {_words(stay)}; end them with zscout stop; {cordoned}")
        )
    shown.say(f"{host} is empty; {cordoned}")
    return 0


async def _uncordon(host: str, *, as_json: bool) -> int:
    async with common.connected("uncordon") as client:
        told = await ask_placer(client, UncordonHost(host), Placements)
    if as_json:
        common.print_json({"host": host, "components": list(map(placement_object, told.components))})
    else:
        common.print_line(f"{host} is used again")
    return 0


def _there(placed: Placed, host: str) -> list[Placement]:
    """What is on a host, or coming to it."""
    found = (one for _, one in sorted(placed.records.items()))
    return [one for one in found if host in (one.host, one.to) and one.state not in OVER]


def _leaves(one: Placement) -> bool:
    """Whether it is to be waited for: what is not running yet is moved when it does."""
    return one.movable or one.state != "running"


def _elsewhere(placed: Placed, name: str, host: str) -> bool:
    record = placed.records.get(name)
    return record is not None and record.host not in (host, None) and record.state == "running"


def _words(some: Sequence[Placement]) -> str:
    return ", ".join(_word(one) for one in some)


def _word(one: Placement) -> str:
    if one.state != "running":
        return f"{one.component} {standing(one)}"
    why = one.reason or ("" if one.movable else "it can't be moved")
    return f"{one.component} stays" + (f" ({why})" if why else "")
