"""`zscout book` and `zscout maintain`: reserve devices together from a date on."""

from __future__ import annotations

import time as clocks
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, datetime, time
from decimal import Decimal
from functools import partial
from typing import Any, Final
from zoneinfo import ZoneInfo

import click
from msgspec.structs import replace

from zscout import terminal
from zscout.behaviors.client.bookings import MAX_NAMED, PATIENCE, BookingsClient
from zscout.behaviors.client.client import Client, RequestRefused
from zscout.behaviors.client.identity import bounded
from zscout.cli import common, completion
from zscout.cli.booked import (
    ask_bookings,
    booking_json,
    explained,
    free_name,
    in_words,
    is_own,
    rcs_words,
    reports,
    short,
    state_words,
    when_words,
    zone_option,
)
from zscout.cli.bookings.displaced import Displaced
from zscout.cli.common import F, Failed, Parsed
from zscout.cli.components import placing
from zscout.cli.dates import (
    DATE_FORMS,
    EVERY_FORMS,
    Found,
    WrittenDate,
    date_words,
    every_words,
    host_zone,
    in_zone,
    local,
    parse_date,
    parse_every,
    remarks,
    span_words,
)
from zscout.cli.ownership import User, yes_option
from zscout.cli.requests.options import MAX_PRIORITY, Needs, gather_needs, parse_comment, parse_duration, parse_need
from zscout.config.strict import BadInput, quoted
from zscout.keyexpr import check_name, check_need, check_new_name, host_in, is_pattern, of_host, valid_name
from zscout.messages import MAX_AHEAD, WINDOW, BookingRecord, BookingsTold, BookingView, Who
from zscout.services.bookings.dates import dates
from zscout.terminal import clean, many, span

DAY: Final = 86_400
LAST_DAY_AHEAD_S: Final = MAX_AHEAD - 25 * 3600
"""A day that begins this far ahead ends within MAX_AHEAD: with a change of clocks a day has 25 hours."""
LOOK_AHEAD_S: Final = 7 * DAY
"""Search this far ahead for other times if the date is not free."""
MAX_SUGGESTIONS: Final = 3
MAX_REMARKS: Final = 4
DATE: Final = Parsed("date", parse_date)
DURATION: Final = Parsed("duration", parse_duration)


def _parse_maintained(text: str, _option: str) -> str:
    """Parse a device, a pattern, or a host, which has no kind before its name."""
    return check_need(text) if "/" in text else of_host(check_name(text, "host"))


def date_options(command: F, *, required: bool = True) -> F:
    """Add the options that `book` and `maintain` share."""
    for option in (
        common.json_option("Print one JSON object."),
        click.option("--comment", type=Parsed("text", parse_comment), default="", help="A comment shown to others."),
        click.option(
            "--name", help="Name of the booking. Default: its first device, as in gpu-1; for maintenance: maintenance."
        ),
        zone_option,
        click.option("--until", type=DATE, help="Last day or date of the repetition. Default: a year ahead."),
        click.option("--every", type=Parsed("days", parse_every), help=f"Repeat it at the same hour: {EVERY_FORMS}."),
        click.option("--for", "runtime", type=DURATION, required=required, help="Length: 90s, 5m, 2h, 1d12h."),
        click.option("--at", type=DATE, required=required, help=f"Begin: {DATE_FORMS}."),
    ):
        command = option(command)
    return command


needs_argument = click.argument(
    "needs",
    nargs=-1,
    required=True,
    type=Parsed("need", parse_need),
    metavar="DEVICE...",
    shell_complete=completion.needs,
)


@click.command()
@needs_argument
@click.option(
    "--priority",
    type=click.IntRange(-MAX_PRIORITY, MAX_PRIORITY),
    default=0,
    help="Priority of the request that uses it.",
)
@click.option(
    "--patience",
    type=DURATION,
    help="The booking lapses if no request uses it this long after its date. Default: 15 min, or its whole time.",
)
@date_options
@common.runs
async def book(needs: Any, priority: int, patience: Decimal | None, **rest: Any) -> None:
    """Book devices together for a date.

    A DEVICE is written as for `zscout request`. Before the booking no request of equal or lower priority starts on the
    devices unless it will end by the date, or will yield. `zscout request --booking NAME -- COMMAND` uses the
    booking: run it at the date, or earlier and it waits; it then holds the devices until the booking ends. A
    booking that no request uses lapses.

    A date without a zone is in the zone of this host; a repeated booking keeps its hour over summer time. A local
    time that occurs twice is the first; a local time that does not exist moves an hour later, with a note.

    If the devices are not free, the command prints the reason and free times (exit code 1).

    \b
    Examples:
      zscout book robot/arm1 'framegrabber/*' radio/rf0:command_rate=5 --for 2h --at "tue 14:00"
      zscout book robot/arm1 --for 45m --at "tomorrow 9:00" --name demo --priority 3 --comment 'visitors'
      zscout book robot/arm1 --for 2h --at "tue 14:00" --every week --until 2027-03-31 --zone Europe/Berlin
    """
    await _make(gather_needs(needs), priority=priority, patience=patience, maintenance=False, yes=True, **rest)


@click.command()
@click.argument(
    "needs",
    nargs=-1,
    required=True,
    type=Parsed("need", _parse_maintained),
    metavar="DEVICE|HOST...",
    shell_complete=completion.maintained,
)
@click.option(
    "--broken",
    type=Parsed("text", parse_comment),
    metavar="REASON",
    help="Report broken devices, without a date: only operators get them until --well.",
)
@click.option("--well", is_flag=True, help="Report that broken devices work again.")
@yes_option
@partial(date_options, required=False)
@common.runs
async def maintain(needs: Sequence[str], yes: bool, broken: str | None, well: bool, **rest: Any) -> None:
    """Reserve devices for maintenance, as an operator: a drain with a date.

    A pattern means all devices that match it, a HOST all its devices; the host gets no components meanwhile.
    Maintenance is a booking at the fleet's operator priority that no request can use. Requests that would not end
    by its date do not start on the devices; waiting requests show its end. `zscout booking cancel` ends it early.

    --broken REASON reports devices broken from now on: holds continue, and the devices are granted to operators only
    until --well. In a secured fleet an operator may report any device, other users the devices that they hold.

    The command lists the holds and bookings that maintenance displaces, and asks on stderr; if stdin is not a
    terminal, add --yes (exit code 2).

    \b
    Examples:
      zscout maintain robot/arm1 --at now --for 1h && zscout booking cancel maintenance
      zscout maintain robot/arm1 --at "sat 8:00" --for 4h --comment 'new gripper'
      zscout maintain 'robot/*' anvil --at "mon 7:00" --for 30m --every week --until 2027-03-31
      zscout maintain dut/board --broken 'its power supply smokes'
      zscout maintain dut/board --well
    """
    if twice := [need for need in needs if needs.count(need) > 1]:
        raise BadInput(f"{twice[0].removeprefix('@')} is named twice; name each device and host once")
    if broken is not None or well:
        await _report(needs, broken, well=well, **rest)
        return
    for option, given in (("--at", rest["at"]), ("--for", rest["runtime"])):
        if given is None:
            raise click.UsageError(f"{option} is missing")
    priority = common.the_fleet().operator_priority
    await _make({need: {} for need in needs}, priority=priority, patience=None, maintenance=True, yes=yes, **rest)


async def _report(needs: Sequence[str], broken: str | None, *, well: bool, as_json: bool, **dates: Any) -> None:
    """Raises BadInput, Failed, RequestRefused."""
    if broken is not None and well:
        raise BadInput("--broken and --well exclude each other; use only one of them")
    if broken == "":
        raise BadInput("--broken: the reason is empty; write what is wrong")
    mode = "--well" if well else "--broken"
    if given := [name for name, value in dates.items() if value]:
        option = {"runtime": "for"}.get(given[0], given[0])
        raise BadInput(f"--{option} can't be used with {mode}, which has no date; leave it out")
    if hosts := [host for host in map(host_in, needs) if host is not None]:
        raise BadInput(f"{hosts[0]} is not a device; name devices, or use zscout drain {hosts[0]}")
    async with common.connected("maintain") as client:
        client.who = replace(client.who or Who(), command="")
        bookings, me = BookingsClient(client), User.of(client)
        try:
            if broken:
                reported = [await bookings.report_broken(needs, broken)]
            else:
                answer = await ask_bookings(client)
                wanted = {*needs}
                reported = [report for report in reports(answer) if wanted & {*report.needs, *report.maintained}]
                if not reported:
                    raise Failed(f"no report that {', '.join(needs)} is broken; see zscout booking list")
                reported = [await bookings.unbook(report.id) for report in reported]
        except RequestRefused as refused:
            raise explained(refused) from None
    if as_json:
        terminal.print_json({"broken" if broken else "well": [booking_json(report, me) for report in reported]})
        return
    for report in reported:
        rcs = rcs_words(report)
        then = f"until zscout maintain {' '.join(sorted(report.needs))} --well"
        terminal.print_line(clean(f"{rcs}: broken, {then}" if broken else f"{rcs}: granted again"))


@dataclass(frozen=True, slots=True)
class Asked:
    """The dates asked for, by fleet time. `last`: end of the repetition."""

    start: Found
    every: int
    last: datetime | None
    runtime: Decimal
    zone: ZoneInfo

    @classmethod
    def of(
        cls,
        at: WrittenDate,
        runtime: Decimal,
        every: int | None,
        until: WrittenDate | None,
        zone: ZoneInfo,
        now: float,
        late: float = 0.0,
    ) -> Asked:
        """`late`: seconds after its start within which a date can still be booked. Raises BadInput."""
        start, last = at.found(now, zone), None
        begins = start.at.timestamp()
        if begins + late <= now:
            raise BadInput(f"--at: {date_words(begins, zone)} is past; the fleet's clock shows {date_words(now, zone)}")
        if begins > now + MAX_AHEAD:
            raise BadInput(f"--at: {date_words(begins, zone)} is more than a year ahead; write an earlier date")
        if every is None:
            return cls(start, 0, None, runtime, zone)
        if not start.exists:
            raise BadInput(f"--at: {start.note}, also for repetitions; begin with another date")
        latest = last = _end_of(in_zone(now + LAST_DAY_AHEAD_S, zone).date(), zone)
        if until is not None:
            day = until.whole_day(now, zone)
            last = until.found(now, zone).at if day is None else _end_of(day, zone)
            if last < start.at:
                raise BadInput("--until is before the first date; write a later one")
            if last > latest:
                raise BadInput(f"--until is more than a year ahead; write {latest:%Y-%m-%d} or an earlier date")
        return cls(start, every, last, runtime, zone)

    def remarks(self) -> list[str]:
        """Return the notes on hours that do not exist or come twice."""
        if not self.every:
            return [self.start.note] if self.start.note else []
        found = dates(self._record(), 0, self.start.at.timestamp() + MAX_AHEAD)
        notes = remarks(found, self.zone, self.start.at.time())
        more = len(notes) - MAX_REMARKS
        return [*notes[:MAX_REMARKS], f"and {more} more like that"] if more > 0 else notes

    def spans(self, now: float) -> list[tuple[float, float]]:
        """Return (begin, end) of its dates within 60 days."""
        first, length = int(self.start.at.timestamp()), float(self.runtime)
        starts = dates(self._record(), now - length, now + WINDOW) if self.every else [first]
        return [(start, start + length) for start in starts or [first]]

    def _record(self) -> BookingRecord:
        until = None if self.last is None else int(self.last.timestamp())
        at = int(self.start.at.timestamp())
        return BookingRecord("", "", {}, 0, at, self.runtime, self.runtime, self.zone.key, self.every, until)


def _end_of(day: date, zone: ZoneInfo) -> datetime:
    return local(datetime.combine(day, time(23, 59, 59)), zone).at


async def _make(
    needs: Needs,
    *,
    at: WrittenDate,
    runtime: Decimal,
    every: int | None,
    until: WrittenDate | None,
    zone: ZoneInfo | None,
    name: str | None,
    comment: str,
    priority: int,
    patience: Decimal | None,
    maintenance: bool,
    yes: bool,
    as_json: bool,
) -> None:
    zone = zone or host_zone()
    # Report errors that need no fleet before joining the mesh.
    at.found(clocks.time(), zone)
    if until is not None and every is None:
        raise BadInput("--until ends a repeated booking; add --every, or leave --until out")
    if patience is not None and patience > runtime:
        raise BadInput(f"--patience is longer than the booking; write at most {span(float(runtime))}")
    name = check_new_name(name, "--name") if name is not None else None
    async with common.connected("maintain" if maintenance else "book") as client:
        # Other users see the name of the booking, not the command that made it.
        client.who = replace(client.who or Who(), command="")
        answer, me = await ask_bookings(client), User.of(client)
        late = min(runtime, Decimal(PATIENCE) if patience is None else patience)
        asked = Asked.of(at, runtime, every, until, zone, answer.time, float(late))
        own = [booking for booking in answer.bookings if is_own(booking, me)]
        default = "maintenance" if maintenance else _named_after(needs)
        displaced = {}
        if maintenance:
            cost = await _displaced(client, needs, asked, priority, answer)
            await cost.agree(name or default, yes=yes)
            displaced = {"displaced": cost.as_json()}
        terms: dict[str, Any] = {"priority": priority, "comment": comment}
        try:
            booking = await BookingsClient(client).book(
                needs,
                asked.start.at,
                runtime,
                name=name or free_name(default, own),
                patience=None if patience is None else float(patience),
                every=asked.every,
                until=asked.last,
                maintenance=maintenance,
                **terms,
            )
        except RequestRefused as refused:
            if refused.code != "not_free":
                raise explained(refused) from None
            raise Failed(await _not_free(client, refused, needs, asked, priority)) from None
        twice = any(other.name == booking.name and other.id != booking.id for other in own)
        if as_json:
            terminal.print_json(booking_json(booking, me) | {"remarks": asked.remarks()} | displaced)
            return
        _print(booking, asked, answer)
        if twice:
            terminal.print_line(f"you have another booking called {booking.name}: name it by its id, {short(booking)}")


async def _displaced(client: Client, needs: Needs, asked: Asked, priority: int, answer: BookingsTold) -> Displaced:
    """Raises BadInput for an unknown host."""
    state = await common.state_of(client)
    hosts = {view.host for view in state.rcs if view.host}
    for host in filter(None, map(host_in, needs)):
        if host not in hosts and host not in (hosts := hosts | await placing.nodes_of(client.mesh)):
            names = hosts | {view.rc for view in state.rcs}
            raise BadInput(
                f"unknown host {quoted(host)}{common.hint_at(host, names, 'and there are none', 'there are')}"
            )
    return Displaced(needs, asked.spans(answer.time), priority, state, answer)


def _named_after(needs: Needs) -> str:
    """`robot-arm1` for robot/arm1, `framegrabber` for framegrabber/*."""
    kind, _, name = next(iter(needs)).partition("/")
    return "booking" if is_pattern(kind) else valid_name(kind if is_pattern(name) else f"{kind}-{name}")[:MAX_NAMED]


async def _not_free(client: Client, refused: RequestRefused, needs: Needs, asked: Asked, priority: int) -> str:
    start = asked.start.at
    try:
        how: dict[str, Any] = {"start": start, "priority": priority, "limit": MAX_SUGGESTIONS}
        answer = await BookingsClient(client).slots(needs, asked.runtime, LOOK_AHEAD_S, **how)
    except RequestRefused:
        return f"{refused}; zscout slots lists free times"
    free = [date_words(slot.start, asked.zone) for slot in answer.slots if slot.start > start.timestamp()]
    if not free:
        return f"{refused}; in the {span(LOOK_AHEAD_S)} after it they are never free together"
    first = "the first date alone is free" if asked.every else "free together"
    return f"{refused}; {first} from {' or '.join(free)} on ({asked.zone.key}): write another --at"


def _print(booking: BookingView, asked: Asked, answer: BookingsTold) -> None:
    first, zone = next(iter(booking.dates), None), asked.zone
    begins = asked.start.at.timestamp()
    when = f"{span_words(begins, begins + float(asked.runtime), zone)} ({zone.key}), {in_words(begins - answer.time)}"
    done = "" if booking.maintenance else " is booked"
    terminal.print_line(clean(f"{booking.name} ({short(booking)}){done}: {rcs_words(booking, first)}: {when}"))
    if booking.every:
        last = "" if booking.until is None else f" until {in_zone(booking.until, zone):%a %Y-%m-%d}"
        soon = many(len(booking.dates), "date")
        terminal.print_line(f"repeated {every_words(booking.every)}{last}: {soon} within 60 days")
    for note in asked.remarks():
        terminal.print_line(note)
    for booked in booking.dates:
        if booked.danger or booked.state == "conflict":
            text = f"{when_words(booking, booked, zone)}: {state_words(booking, booked)}"
            click.secho(clean(text), fg="yellow")
    if booking.maintenance:
        terminal.print_line(f"to end it early: zscout booking cancel {bounded(booking.name)}")
    else:
        within = span(float(booking.patience))
        take_up = f"zscout request --booking {bounded(booking.name)} -- COMMAND"
        terminal.print_line(f"to use it, start before its date or within {within} after: {take_up}")
