"""Bookings as the RCM lists them: their owners, the search by name or id, and their words."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple
from zoneinfo import ZoneInfo

import click
from msgspec import structs

from zscout.behaviors.client.bookings import BookingsClient
from zscout.behaviors.client.client import QUERY_TIMEOUT, Client
from zscout.behaviors.client.request import RequestRefused
from zscout.cli import common, completion, ownership
from zscout.cli.common import F, Failed, Parsed
from zscout.cli.dates import date_words, parse_zone, span_words
from zscout.cli.ownership import User
from zscout.config.strict import BadInput, quoted
from zscout.keyexpr import host_in, matcher, of_host
from zscout.messages import BookedDate, BookingsAsk, BookingsTold, BookingView, Correction
from zscout.terminal import clean, clock, span

SHOWN_ID: Final = 8
"""Characters of an id that are shown."""
MIN_PREFIX: Final = 4
"""Shortest beginning of an id that names its booking, in characters."""
SOON_S: Final = 86_400
MAX_LISTED: Final = 8
MAX_TEXT: Final = 64
MAX_CLOCK_DIFFERENCE_S: Final = 2.0
BAD_INPUT_CODES: Final = frozenset({"bad_date", "bad_zone", "bad_request"})
"""Codes of refusals that another input would avoid."""


def parse_booking(text: str, option: str) -> str:
    """Check a booking's name or id. Raises BadInput."""
    if not 1 <= len(text) <= MAX_TEXT or not text.isprintable():
        raise BadInput(f"{option}: {quoted(text)} can't be the name of a booking; see zscout booking list")
    return text


BOOKING: Final = Parsed("text", parse_booking)
ZONE: Final = Parsed("zone", parse_zone)
booking_argument = click.argument("booking", type=BOOKING, metavar="NAME|ID", shell_complete=completion.bookings)


def zone_option(command: F) -> F:
    """`--zone`; None: this host's."""
    text = "Time zone of the dates, as in Europe/Berlin. Default: this host's."
    return click.option("--zone", type=ZONE, help=text)(command)


async def ask_bookings(client: Client, rc: str | None = None) -> BookingsTold:
    """Warns on stderr if this host's clock differs from fleet time. Raises RequestRefused."""
    answer = await BookingsClient(client).list(rc=rc)
    differs = time.time() - answer.time
    if abs(differs) > MAX_CLOCK_DIFFERENCE_S:
        click.secho(f"this host's clock is {differs_words(differs)}; dates are by the fleet's", fg="yellow", err=True)
    return answer


async def look(client: Client) -> BookingsTold | None:
    """After one query; None: no answer."""
    reply = await client.mesh.ask_one(
        client.mesh.keys.ask_bookings(client.mesh.me), BookingsAsk(), BookingsTold, timeout=QUERY_TIMEOUT
    )
    return reply.message if reply is not None else None


def soon(answer: BookingsTold | None) -> int:
    return (
        0
        if answer is None
        else sum(
            date.state in ("open", "taken") and answer.time <= date.start < answer.time + SOON_S
            for booking in answer.bookings
            for date in booking.dates
        )
    )


def in_maintenance(answer: BookingsTold | None) -> dict[str, str]:
    """Return the current maintenance by RC: `greased (ada@desk) until 14:30`."""
    return {
        rc: clean(f"{booking.name} ({whose(booking)}) until {_end(booking, date, answer)}")
        for booking in (answer.bookings if answer is not None else ())
        for date in booking.dates
        if answer is not None and booking.maintenance and not booking.broken and date.start <= answer.time < date.end
        for rc in booking.maintained or booking.needs
    }


def broken(answer: BookingsTold | None) -> dict[str, str]:
    """Return the reason and the reporter by broken RC: `its gripper is bent (ada@desk)`."""
    return {rc: _why_broken(booking) for booking in reports(answer) for rc in booking.maintained or booking.needs}


def reports(answer: BookingsTold | None) -> list[BookingView]:
    found = answer.bookings if answer is not None else []
    return [booking for booking in found if booking.broken and not booking.unbooked]


def _why_broken(booking: BookingView) -> str:
    comment = booking.who.comment if booking.who is not None else ""
    return clean(f"{comment or booking.name} ({whose(booking)})")


def _end(booking: BookingView, date: BookedDate, answer: BookingsTold) -> str:
    return "cancelled" if booking.lasting else clock(date.end - answer.time)


def maintenance_of(answer: BookingsTold, host: str) -> list[tuple[BookingView, BookedDate]]:
    return [
        (booking, date)
        for booking in answer.bookings
        for date in booking.dates
        if booking.maintenance and of_host(host) in booking.needs and date.start <= answer.time < date.end
    ]


def coming(answer: BookingsTold | None) -> dict[str, str]:
    """Return the next booking within 24 h by RC: `calib (ada@desk) from 14:30`."""
    found = [
        (date.start, rc, clean(f"{booking.name} ({whose(booking)}) from {clock(date.start - answer.time)}"))
        for booking in (answer.bookings if answer is not None else ())
        for date in booking.dates
        if answer is not None and date.state == "open" and 0 < date.start - answer.time < SOON_S
        for rc in (date.bound.get(need, need) for need in booking.needs)
    ]
    return {rc: words for _, rc, words in sorted(found, reverse=True)}


class NextDate(NamedTuple):
    """The next date of a booking, or of maintenance, for which a device is kept; times in seconds from now."""

    rc: str
    booking: str
    owner: str
    maintenance: bool
    begins_in: float
    ends_in: float | None
    """None: maintenance that lasts until it is cancelled."""

    def __str__(self) -> str:
        begins = f"from {clock(self.begins_in)}" if self.begins_in > 0 else "now"
        ends = "until it is cancelled" if self.ends_in is None else f"to {clock(self.ends_in)}"
        what = "in maintenance" if self.maintenance else "booked"
        return clean(f"{self.rc} is {what} by {self.owner} ({self.booking}) {begins} {ends}")


def next_dates(answer: BookingsTold | None, needs: Iterable[str], own: str = "") -> list[NextDate]:
    """The next date of each device that meets `needs`, earliest first, without those that the request `own`
    (`<host>/<client>/<id>`) has taken up."""
    meets, found = [matcher(need) for need in needs], dict[str, NextDate]()
    if answer is None:
        return []
    for booking in answer.bookings:
        for date in booking.dates if not booking.broken else ():
            if date.state not in ("open", "taken") or date.end <= answer.time or (own and date.arc == own):
                continue
            begins, ends = date.start - answer.time, None if booking.lasting else date.end - answer.time
            rcs = booking.maintained or [date.bound.get(need, need) for need in booking.needs]
            for rc in rcs:
                later = rc in found and found[rc].begins_in <= begins
                if not later and any(meet(rc) for meet in meets):
                    found[rc] = NextDate(rc, booking.name, whose(booking), booking.maintenance, begins, ends)
    return sorted(found.values(), key=lambda date: (date.begins_in, date.rc))


def explained(refused: RequestRefused) -> Exception:
    """Return the exception to raise: BadInput, with its own exit code, if another input would avoid the refusal."""
    return BadInput(str(refused)) if refused.code in BAD_INPUT_CODES else refused


def is_own(booking: BookingView, user: User) -> bool:
    return user.owns(booking.owner, booking.who)


def label(booking: BookingView) -> str:
    """`survey (3f2a91c0) of alice@ws1`."""
    return f"{booking.name} ({short(booking)}) of {whose(booking)}"


def choose(bookings: Sequence[BookingView], name: str, user: User) -> BookingView:
    """Find the booking that `name` means: the user's own of this name, else by id, else another user's of this name,
    else by the id's beginning. Raises Failed for none, or several."""
    there = [booking for booking in bookings if not booking.unbooked]
    alike = [booking for booking in there if booking.name == name]
    found = [booking for booking in alike if is_own(booking, user)]
    found = found or [booking for booking in there if booking.id == name] or alike
    if not found and len(name) >= MIN_PREFIX:
        found = [booking for booking in there if booking.id.startswith(name)]
    if not found:
        raise common.unknown("booking", name, [booking.name for booking in there], "and there are none", "booked")
    if len(found) > 1:
        listed = "; ".join(f"{short(booking)} {_next(booking)} of {whose(booking)}" for booking in found[:MAX_LISTED])
        more = f" and {len(found) - MAX_LISTED} more" if len(found) > MAX_LISTED else ""
        raise Failed(clean(f"{len(found)} bookings are called {quoted(name)}: {listed}{more}; name one by its id"))
    return found[0]


def free_name(wanted: str, own: Sequence[BookingView]) -> str:
    """`arm1`, or if the user has a booking of that name, `arm1-2`."""
    taken = {booking.name for booking in own}
    numbered = (f"{wanted}-{number}" for number in range(2, len(taken) + 3))
    return wanted if wanted not in taken else next(name for name in numbered if name not in taken)


def short(booking: BookingView) -> str:
    return booking.id[:SHOWN_ID]


def whose(booking: BookingView) -> str:
    """`alice@ws1`; if the user is unknown, the host or certificate that made the booking."""
    return ownership.whose(booking.owner, booking.who)


def rcs_words(booking: BookingView, date: BookedDate | None = None) -> str:
    """`robot/arm1, framegrabber/fg1 for framegrabber/*, radio/rf0 (command_rate=5)`."""
    bound = date.bound if date is not None else {}
    names = {need: f"{bound[need]} for {need}" if need in bound else need_words(need) for need in booking.needs}
    return ", ".join(common.with_amounts(names[need], booking.needs[need]) for need in sorted(booking.needs))


def when_words(booking: BookingView, date: BookedDate, zone: ZoneInfo | None) -> str:
    """`Tue 2026-12-01 14:00 to 16:00`, `Tue 2026-12-01 14:00 until cancelled`."""
    if booking.lasting:
        return f"{date_words(date.start, zone)} until cancelled"
    return span_words(date.start, date.end, zone)


def need_words(need: str) -> str:
    """`robot/arm1`, `all devices of anvil` for `@anvil`."""
    host = host_in(need)
    return need if host is None else f"all devices of {host}"


def in_words(seconds: float) -> str:
    return f"in {span(seconds)}" if seconds >= 1 else "now"


def state_words(booking: BookingView, date: BookedDate) -> str:
    words = "maintenance" if booking.maintenance and date.state == "open" else date.state
    return f"{words}: {date.danger}" if date.danger else words


def _next(booking: BookingView) -> str:
    date = next(iter(booking.dates), None)
    return when_words(booking, date, None) if date is not None else "without a date within 60 days"


def clock_words(host: str, differs: float) -> str:
    return f"the clock of {clean(host)} is {differs_words(differs)}"


def corrected_words(corrected: Correction) -> str:
    direction = "forward" if corrected.by > 0 else "back"
    return f"fleet time was put {span(abs(corrected.by))} {direction} at {clock(-corrected.ago)}; see your bookings"


def differs_words(differs: float) -> str:
    return f"{span(abs(differs))} {'ahead of' if differs > 0 else 'behind'} the fleet's"


def utc(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def booking_json(booking: BookingView, user: User) -> dict[str, Any]:
    """Return the object of `--json`: instants in UTC, durations in seconds."""
    dates = [structs.asdict(date) | {"start": utc(date.start), "end": utc(date.end)} for date in booking.dates]
    until = None if booking.until is None else utc(booking.until)
    return structs.asdict(booking) | {
        "own": is_own(booking, user),
        "start": utc(booking.start),
        "until": until,
        "dates": dates,
    }
