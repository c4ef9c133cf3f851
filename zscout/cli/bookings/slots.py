"""`zscout slots`: list times at which devices are free together."""

from __future__ import annotations

from decimal import Decimal
from typing import Any
from zoneinfo import ZoneInfo

import click

from zscout import terminal
from zscout.behaviors.client.bookings import BookingsClient
from zscout.behaviors.client.client import RequestRefused
from zscout.cli import common
from zscout.cli.booked import ask_bookings, explained, in_words, utc, zone_option
from zscout.cli.bookings.book import DATE, DURATION, needs_argument
from zscout.cli.dates import WrittenDate, date_words, host_zone
from zscout.cli.requests.options import MAX_PRIORITY, gather_needs, seconds_within
from zscout.messages import MAX_AHEAD, MAX_SLOTS, SlotsTold
from zscout.terminal import Table, span


@click.command()
@needs_argument
@click.option("--for", "runtime", type=DURATION, required=True, help="Length of the booking: 90s, 5m, 2h, 1d12h.")
@click.option("--within", type=seconds_within(1, MAX_AHEAD), default="7d", help="Search this far ahead.")
@click.option("--from", "since", type=DATE, help="Search from this date on. Default: from now on.")
@click.option("--limit", type=click.IntRange(1, MAX_SLOTS), default=5, help="List at most this many times.")
@click.option("--priority", type=click.IntRange(-MAX_PRIORITY, MAX_PRIORITY), default=0, help="The booking's priority.")
@zone_option
@common.json_option("Print one JSON object.")
@common.runs
async def slots(
    needs: Any,
    runtime: Decimal,
    within: float,
    since: WrittenDate | None,
    limit: int,
    priority: int,
    zone: ZoneInfo | None,
    as_json: bool,
) -> None:
    """List the first times at which all of the devices can be booked together.

    Each line is a range of times at which the booking may begin. Other bookings, and holds that would not yield, are
    taken into account. Exit code 1: there is no such time.

    \b
    Examples:
      zscout slots robot/arm1 'framegrabber/*' radio/rf0:command_rate=5 --for 2h --within 3d
      zscout slots robot/arm1 --for 30m --from "mon 8:00" --within 8h --limit 1 --json | jq -r '.slots[0].start'
    """
    wanted = gather_needs(needs)
    if since is not None:
        zone = zone or host_zone()
    async with common.connected("slots") as client:
        start = None
        if since is not None and zone is not None:
            start = since.found((await ask_bookings(client)).time, zone).at
        try:
            how: dict[str, Any] = {"start": start, "priority": priority, "limit": limit}
            answer = await BookingsClient(client).slots(wanted, runtime, within, **how)
        except RequestRefused as refused:
            raise explained(refused) from None
        fleet = client.fleet.name
    if as_json:
        found = [{"start": utc(slot.start), "latest": utc(slot.latest), "bound": slot.bound} for slot in answer.slots]
        terminal.print_json({"fleet": fleet, "time": utc(answer.time), "slots": found, "complete": answer.complete})
    elif answer.slots:
        _table(answer, zone).print()
    if not answer.slots:
        more = "" if answer.complete else " in the part searched"
        raise common.Failed(f"the devices are not free together{more} within {span(within)}; raise --within")


def _table(answer: SlotsTold, zone: ZoneInfo | None) -> Table:
    rows = []
    for slot in answer.slots:
        bound = ", ".join(f"{rc} for {need}" for need, rc in sorted(slot.bound.items()))
        latest = date_words(slot.latest, zone) if slot.latest > slot.start else "then only"
        rows.append((date_words(slot.start, zone), latest, in_words(slot.start - answer.time), bound))
    columns = ("BEGIN FROM", "AT THE LATEST", "FIRST", "WITH")[: 4 if any(row[3] for row in rows) else 3]
    return Table("", columns, [row[: len(columns)] for row in rows])
