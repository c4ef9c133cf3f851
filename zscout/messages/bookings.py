"""Bookings: claims with a date, as they are made, kept and shared.

Beside journals they are the other exception to durations: a date is an instant, in whole seconds since 1970 (UTC), in
*fleet time*, which publications of the RCM tell. The zone is its owner's: by it a weekly booking keeps its hour."""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated, Final, Literal, TypeAlias

import msgspec

from zscout.messages.base import (
    MAX_NEEDS,
    NAMES_ONCE,
    Amounts,
    Elapsed,
    Message,
    Seconds,
    ShortText,
    VersionText,
    WallTime,
)
from zscout.messages.scheduling import RequestId, RequestOperation, Who
from zscout.types import NO_TERM, Grant, Term

MAX_BOOKINGS: Final = 1_000
"""In one fleet."""
MAX_MERGED: Final = 4 * MAX_BOOKINGS
"""Where several halves of a fleet have booked."""
MAX_KEPT: Final = 4_000_000
"""Bytes of all bookings of a fleet."""
MAX_AHEAD: Final = 366 * 86_400
"""Seconds: nothing is booked later than that."""
WINDOW: Final = 60 * 86_400
"""Seconds ahead for which the dates of bookings that are repeated are worked out, and kept free."""
MAX_DATES: Final = 400
"""Dates of one booking that are given up or over: it ends within a year."""
MAX_SLOTS: Final = 50
DAYS: Final = 366
"""From one date to the next, at most."""

Instant: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=10**11)]
"""Whole seconds since 1970, UTC."""
Dates: TypeAlias = Annotated[list[Instant], msgspec.Meta(max_length=MAX_DATES)]
ZoneName: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
"""As in the IANA database: Europe/Berlin."""
BookingName: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
BookedNeeds: TypeAlias = Annotated[dict[str, Amounts], msgspec.Meta(min_length=1, max_length=MAX_NEEDS)]
Days: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=DAYS)]


class _Booking(Message, frozen=True):
    """All of `needs` at once, from `start` on for `runtime` seconds. Who takes it up has to within `patience` seconds
    of the date. `every` so many days it comes again, at the same hour in `zone`, until `until`; 0: it is once."""

    id: RequestId
    name: BookingName
    needs: BookedNeeds
    priority: int
    start: Instant
    runtime: Decimal
    patience: Decimal
    zone: ZoneName = "UTC"
    every: Days = 0
    until: Instant | None = None
    maintenance: bool = False
    """Nobody is to hold any of them then: a drain with a date, which nobody takes up. `needs` may have patterns, which
    mean all RCs that match, and `@<host>` for all RCs of a host, on which no component is placed meanwhile."""
    urgent: bool = False
    """Maintenance preempts holds within their minimum runtimes as well."""
    lasting: bool = False
    """Maintenance until it is given up: the leader puts its end off. So what is left of it is forgotten soon."""
    broken: bool = False
    """Lasting maintenance of broken devices: holds go on, and operators' requests are granted them."""
    who: Who | None = None


class Book(_Booking, frozen=True, tag_field="op", tag="book"):
    """Makes a booking. Its `id` is its client's choice, unlike any other, and makes the operation idempotent. Answered
    with a BookingView once another candidate, or where there is none this one's disk, has it."""


class Unbook(Message, frozen=True, tag_field="op", tag="unbook"):
    """Gives up the booking `id`, or of one that is repeated the date `start`. Who has taken it up goes on as if it had
    asked without. Answered with a BookingView."""

    id: RequestId
    start: Instant | None = None
    who: Who | None = None


class FindSlots(Message, frozen=True, tag_field="op", tag="slots"):
    """Asks for the first `limit` stretches of time, within so many seconds from `start` (absent: from now) on, in which
    all of `needs` could be booked for `runtime` seconds. Answered with SlotsTold."""

    id: RequestId
    needs: BookedNeeds
    priority: int
    runtime: Decimal
    within: Elapsed
    start: Instant | None = None
    limit: Annotated[int, msgspec.Meta(ge=1, le=MAX_SLOTS)] = 5
    who: Who | None = None


class SlotView(Message, frozen=True):
    """From `start` to `latest` a booking may begin at any time; `bound` has the RC for each pattern."""

    start: Instant
    latest: Instant
    bound: dict[str, str] = {}


class SlotsTold(Message, frozen=True):
    """`complete` is False where there was more to look at than one question may. `time`: the fleet's. `likely`: all is
    likely to be there then, before it can be booked."""

    id: str
    time: WallTime
    slots: list[SlotView] = []
    complete: bool = True
    likely: Instant | None = None


DateState: TypeAlias = Literal["open", "taken", "used", "lapsed", "unbooked", "conflict"]


class BookedDate(Message, frozen=True):
    """One date of a booking. `open`: nobody has taken it up yet. `used`: who took it up is done. `lapsed`: nobody did.
    `conflict`: another booking, made where this one was not known, has what it needs, and stands."""

    start: Instant
    end: Instant
    state: DateState
    bound: dict[str, str] = {}
    """The RC that is kept for each pattern."""
    arc: str | None = None
    """`<host>/<client>/<id>` of who has taken it up."""
    danger: str = ""
    """Why it may not start at its date, in words; with `conflict`, which booking stands."""


class BookingView(_Booking, frozen=True):
    """A booking as the leader knows it. `owner` is the host, or the name of the certificate, that made it; `since`
    when. `dates` are those that are not over, of what is repeated within the next 60 days; `dropped` all that were
    given up."""

    owner: str = ""
    since: Instant = 0
    unbooked: bool = False
    dates: list[BookedDate] = []
    dropped: Dates = []
    maintained: list[ShortText] = []
    """The RCs that maintenance of patterns and hosts has now."""


class BookingsAsk(Message, frozen=True):
    """Asks the leader for bookings: of one `owner`, of those that may have one `rc`, or for all."""

    owner: ShortText | None = None
    rc: ShortText | None = None


class Correction(Message, frozen=True):
    """Fleet time was put forward by so many seconds, or back (negative), to what most hosts' clocks say."""

    by: Seconds
    ago: Elapsed


class BookingsTold(Message, frozen=True):
    """Bookings that are not over. `time` is the fleet's; `clocks` has, by host, by how many seconds its clock is ahead
    of that, where they differ by more than 2."""

    time: WallTime
    bookings: list[BookingView] = []
    clocks: dict[str, Seconds] = {}
    corrected: Correction | None = None
    """The last correction, for a day in the reign of its leader."""


class BookingRecord(_Booking, frozen=True):
    """A booking as it is kept. Records of one id are merged: `unbooked` is final, and so is each date in `dropped`
    (given up) and `over` (used, or lapsed). `made` and `changed` are (term, seq) of its making and its last change."""

    owner: str = ""
    since: Instant = 0
    """When it was made."""
    made: Grant = Grant(NO_TERM, 0)
    changed: Grant = Grant(NO_TERM, 0)
    unbooked: bool = False
    dropped: Dates = []
    over: Dates = []
    kept: Annotated[dict[int, dict[str, str]], msgspec.Meta(max_length=MAX_DATES)] = {}
    """By date: the RC that is kept for each pattern of its needs."""


class ShareBookings(Message, frozen=True):
    """The leader's question to all who keep bookings: keep these as well. Who has others than the leader, by `digest`
    (of all that it has), answers with all of its own."""

    term: Term
    digest: str
    records: Annotated[list[BookingRecord], msgspec.Meta(max_length=MAX_MERGED)] = []
    time: WallTime | None = None
    """Fleet time: what was over a day before is forgotten. Absent: nothing is, as it was set lately."""


class BookingsKept(Message, frozen=True):
    """What a host keeps, once it is on its disk if it has one. `wall` is its clock's time, `time` that of the fleet as
    it was last heard, which has gone on for `time_age` seconds; `candidate`: it may lead."""

    host: str
    candidate: bool
    wall: WallTime
    digest: str
    time: WallTime | None = None
    time_age: Elapsed = 0.0
    durable: bool = False
    records: Annotated[list[BookingRecord], msgspec.Meta(max_length=MAX_MERGED)] = []
    version: VersionText = ""
    synchronised: bool = False
    """Whether a time service keeps its clock."""


Operation: TypeAlias = RequestOperation | Book | Unbook | FindSlots
NAMES_ONCE.add(Operation)
