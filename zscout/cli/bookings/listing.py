"""`zscout booking list`, `show` and `cancel`."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any
from zoneinfo import ZoneInfo

import click
from msgspec.structs import replace

from zscout import terminal
from zscout.behaviors.client.bookings import BookingsClient
from zscout.behaviors.client.client import RequestRefused
from zscout.cli import common, completion, journals
from zscout.cli.booked import (
    ask_bookings,
    booking_argument,
    booking_json,
    choose,
    clock_words,
    corrected_words,
    explained,
    is_own,
    label,
    rcs_words,
    short,
    state_words,
    utc,
    when_words,
    whose,
    zone_option,
)
from zscout.cli.bookings.book import DATE
from zscout.cli.common import Failed
from zscout.cli.dates import WrittenDate, date_words, every_words, host_zone, in_zone
from zscout.cli.ownership import User, ask_for_others, yes_option
from zscout.config.strict import BadInput
from zscout.keyexpr import is_pattern, matcher
from zscout.messages import MAX_AHEAD, WINDOW, BookedDate, BookingRecord, BookingView
from zscout.services.bookings.dates import dates, zone_of
from zscout.terminal import Table, clean


@click.command()
@click.option("--mine", is_flag=True, help="Only your own bookings.")
@click.option(
    "--rc",
    type=journals.RC,
    shell_complete=completion.needs,
    help="Only bookings that may have this device, or a device of a pattern: robot/*.",
)
@click.option("--date", "at", type=DATE, help="Only the dates of this day, of the next 60: tue, tomorrow, 2026-12-01.")
@zone_option
@common.json_option("Print one JSON object.")
@common.runs
async def bookings(mine: bool, rc: str | None, at: WrittenDate | None, zone: ZoneInfo | None, as_json: bool) -> None:
    """List bookings, the next date first: owner, devices, times, and what endangers them.

    A repeated booking shows its next date, and those of the next 60 days that are in danger; --json has all of them.
    A date is `open` until a request uses it, then `taken`; in `conflict` another booking takes precedence:
    maintenance, or a booking made in the other half of a split fleet.

    \b
    Examples:
      zscout booking list --mine
      zscout booking list --date tuesday
      zscout booking list --rc robot/arm1 --zone UTC
      zscout booking list --json | jq -r '.bookings[] | .name + " " + .dates[0].start'
    """
    async with common.connected("bookings") as client:
        me = User.of(client)
        try:
            answer = await ask_bookings(client, None if rc is not None and is_pattern(rc) else rc)
        except RequestRefused as refused:
            raise explained(refused) from None
        found = [booking for booking in answer.bookings if not mine or is_own(booking, me)]
        if rc is not None and is_pattern(rc):
            found = [booking for booking in found if _may_have(booking, matcher(rc), rc)]
        day = None if at is None else _day(at, answer.time, zone)
        if day is not None:
            found = [there for booking in found if (there := _on_day(booking, day, zone)).dates]
        if as_json:
            terminal.print_json(
                {
                    "fleet": client.fleet.name,
                    "time": utc(answer.time),
                    "clocks": answer.clocks,
                    "bookings": [booking_json(booking, me) for booking in found],
                }
            )
            return
        for host, differs in sorted(answer.clocks.items()):
            click.secho(clean(clock_words(host, differs)), fg="yellow", err=True)
        if answer.corrected is not None:
            click.secho(clean(corrected_words(answer.corrected)), fg="yellow", err=True)
        if not found:
            terminal.print_line("nothing is booked" + (f" on {day:%a %Y-%m-%d}" if day is not None else ""))
        else:
            _table(found, me, zone, every_date=day is not None).print()


@click.command()
@booking_argument
@zone_option
@common.json_option("Print one JSON object.")
@common.runs
async def show(booking: str, zone: ZoneInfo | None, as_json: bool) -> None:
    """Show one booking with all its dates of the next 60 days. Name it by its name, its id, or the first four or more
    characters of its id.

    \b
    Examples:
      zscout booking show survey
      zscout booking show 3f2a91c0 --json | jq -r .dates[0].start
    """
    async with common.connected("booking") as client:
        answer, me = await ask_bookings(client), User.of(client)
        found = choose(answer.bookings, booking, me)
    if as_json:
        terminal.print_json(booking_json(found, me))
        return
    repeated = f", {_repeated(found, zone)}" if found.every else ""
    head = f"{found.name} ({found.id}) of {whose(found)}: {rcs_words(found)}, priority {found.priority}{repeated}"
    terminal.print_line(clean(head))
    for date in found.dates:
        bound = f", {rcs_words(found, date)}" if date.bound else ""
        terminal.print_line(clean(f"  {when_words(found, date, zone)}: {state_words(found, date)}{bound}"))
    if not found.dates:
        terminal.print_line(clean(f"  first on {date_words(found.start, zone)}"))


def _day(at: WrittenDate, now: float, zone: ZoneInfo | None) -> datetime.date:
    """Raises BadInput."""
    if (day := at.whole_day(now, zone or host_zone())) is None:
        raise BadInput("--date: write a day without a time, as in tue, tomorrow or 2026-12-01")
    return day


def _on_day(booking: BookingView, day: datetime.date, zone: ZoneInfo | None) -> BookingView:
    return replace(
        booking,
        dates=[
            part
            for part in booking.dates
            if in_zone(part.start, zone).date() <= day <= in_zone(part.end - 1, zone).date()
        ],
    )


def _may_have(booking: BookingView, matches: Callable[[str], bool], pattern: str) -> bool:
    bound = {rc for date in booking.dates for rc in date.bound.values()}
    return any(matches(need) or need.partition("#")[0] == pattern for need in (*booking.needs, *bound))


def _table(found: Sequence[BookingView], me: User, zone: ZoneInfo | None, *, every_date: bool) -> Table:
    lines: list[tuple[float, Sequence[str], str]] = []
    for booking in found:
        shown = [
            date
            for number, date in enumerate(booking.dates)
            if every_date or number == 0 or date.danger or date.state == "conflict"
        ]
        lines += [(date.start, _row(booking, date, zone), _style(booking, date, me)) for date in shown]
        if not shown:
            row = (
                booking.name,
                short(booking),
                whose(booking),
                date_words(booking.start, zone),
                "later",
                str(booking.priority),
            )
            lines.append((booking.start, (*row, _repeated(booking, zone), rcs_words(booking)), ""))
    lines.sort(key=lambda line: line[0])
    columns = ("NAME", "ID", "WHO", "WHEN", "STATE", "PRIORITY", "REPEATED", "DEVICES")
    rows, styles = [line[1] for line in lines], [line[2] for line in lines]
    return Table("", columns, rows, styles, spare=("REPEATED", "PRIORITY"))


def _row(booking: BookingView, date: BookedDate, zone: ZoneInfo | None) -> Sequence[str]:
    when = when_words(booking, date, zone)
    names = (booking.name, short(booking), whose(booking), when, state_words(booking, date), str(booking.priority))
    return (*names, _repeated(booking, zone), rcs_words(booking, date))


def _repeated(booking: BookingView, zone: ZoneInfo | None) -> str:
    if not booking.every:
        return "-"
    with suppress(ValueError):  # not known here
        zone = zone_of(booking.zone)  # the last day is a day of the booking's zone
    until = f" until {in_zone(booking.until, zone):%Y-%m-%d}" if booking.until is not None else ""
    return every_words(booking.every) + until


def _style(booking: BookingView, date: BookedDate, me: User) -> str:
    if date.danger or date.state == "conflict":
        return "red"
    return "bold" if is_own(booking, me) else ""


@click.command()
@booking_argument
@click.option("--date", "at", type=DATE, help="Only this date of a repeated booking: a day, or a day and a time.")
@zone_option
@yes_option
@common.json_option("Print one JSON object.")
@common.runs
async def unbook(booking: str, at: WrittenDate | None, zone: ZoneInfo | None, yes: bool, as_json: bool) -> None:
    """Cancel a booking, or one date of it. Name it by its name, its id, or the first four or more characters of its id.

    A name means your own booking, if you have one of that name. Before the command cancels another user's booking it
    asks; if stdin is not a terminal, add --yes. In a secured fleet only operators may cancel others' bookings. A
    request that already uses the booking keeps running. If several bookings have the name, the command lists them and
    cancels none.

    \b
    Examples:
      zscout booking cancel survey
      zscout booking cancel survey --date 2026-12-08
      zscout booking cancel 3f2a91c0
    """
    if at is not None:
        zone = zone or host_zone()
    async with common.connected("unbook") as client:
        answer, me = await ask_bookings(client), User.of(client)
        found = choose(answer.bookings, booking, me)
        start = None if at is None or zone is None else _date_of(found, at, zone, answer.time)
        await ask_for_others(client, [] if is_own(found, me) else [label(found)], "cancel", yes=yes)
        try:
            left = await BookingsClient(client).unbook(found.id, start)
        except RequestRefused as refused:
            raise explained(refused) from None
        if as_json:
            terminal.print_json(booking_json(left, me))
            return
    what = "is cancelled" if start is None else f"no longer has {date_words(start, zone)}"
    whole = ", with all its dates" if found.every and start is None else ""
    terminal.print_line(clean(f"{label(found)} {what}{whole}"))


def _date_of(booking: BookingView, at: WrittenDate, zone: ZoneInfo, now: float) -> int:
    """Raises Failed if there is none, BadInput for several."""
    listed = [date.start for date in booking.dates]
    coming = listed + [start for start in dates(_record(booking), now + WINDOW, now + MAX_AHEAD) if start not in listed]
    day = at.whole_day(now, zone)
    if day is not None:
        meant = [start for start in coming if in_zone(start, zone).date() == day]
    else:
        exactly = at.found(now, zone).at.timestamp()
        meant = [start for start in coming if start == exactly]
    if not meant:
        known = ", ".join(date_words(start, zone) for start in coming[:3])
        raise Failed(f"{booking.name} has no such date; it has {known or 'none'}{', ...' * (len(coming) > 3)}")
    if len(meant) > 1:
        raise BadInput(f"--date: {booking.name} begins more than once on that day; write the time as well")
    return meant[0]


def _record(booking: BookingView) -> BookingRecord:
    fields: dict[str, Any] = {name: getattr(booking, name) for name in ("id", "name", "needs", "priority", "start")}
    fields |= {name: getattr(booking, name) for name in ("runtime", "patience", "zone", "every", "until")}
    return BookingRecord(**fields)
