"""Bookings: making, storing and sharing claims with a date.

Like journals, bookings use wall times rather than durations: a date is in whole seconds since 1970 (UTC) in *fleet
time*, which the RCM publishes. The zone is the owner's, so that a weekly booking keeps its hour."""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated, Final, Literal, TypeAlias

import msgspec

from zscout.messages.base import (
    MAX_NEEDS,
    UNIQUE_NAMES,
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
"""Bookings of one fleet."""
MAX_MERGED: Final = 4 * MAX_BOOKINGS
"""Bookings after a merge, if several halves of a fleet made some."""
MAX_KEPT: Final = 4_000_000
"""Bytes of all bookings of a fleet."""
MAX_AHEAD: Final = 366 * 86_400
"""Seconds from now within which a booking may start."""
WINDOW: Final = 60 * 86_400
"""Seconds ahead for which dates of repeated bookings are computed and kept free."""
MAX_DATES: Final = 400
"""Dates of one booking that were given up or are over: a booking ends within a year."""
MAX_SLOTS: Final = 50
DAYS: Final = 366
"""Days from one date to the next, at most."""

Instant: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=10**11)]
"""Whole seconds since 1970, UTC."""
Dates: TypeAlias = Annotated[list[Instant], msgspec.Meta(max_length=MAX_DATES)]
ZoneName: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
"""A name from the IANA database, such as Europe/Berlin."""
BookingName: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
BookedNeeds: TypeAlias = Annotated[dict[str, Amounts], msgspec.Meta(min_length=1, max_length=MAX_NEEDS)]
Days: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=DAYS)]


class _Booking(Message, frozen=True):
    """All of `needs` together, from `start` for `runtime` seconds, if a request takes the booking up within `patience`
    seconds of the date. Repeated after `every` days at the same hour in `zone`, until `until`; 0: not repeated."""

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
    """A drain with a date, which no request takes up: none of `needs` may be held then. A pattern in `needs` means all
    RCs that match, and `@<host>` all RCs of a host, on which no component is placed during the maintenance."""
    urgent: bool = False
    """Maintenance preempts holds within their minimum runtimes as well."""
    lasting: bool = False
    """Maintenance until it is given up: its runtime is WINDOW, and the leader restarts it when half of that is over."""
    broken: bool = False
    """Lasting maintenance of broken devices: holds continue, and requests of operators are granted."""
    who: Who | None = None


class Book(_Booking, frozen=True, tag_field="op", tag="book"):
    """Makes a booking. `id`, which the client chooses, is unique and makes the operation idempotent. Answered with a
    BookingView once another candidate has stored the booking, or, without another candidate, the leader's disk."""


class Unbook(Message, frozen=True, tag_field="op", tag="unbook"):
    """Gives up the booking `id`, or only its date `start` if it is repeated. A request that has taken it up continues
    as if made without a booking. Answered with a BookingView."""

    id: RequestId
    start: Instant | None = None
    who: Who | None = None


class FindSlots(Message, frozen=True, tag_field="op", tag="slots"):
    """Asks for the first `limit` slots, within `within` seconds from `start` (absent: from now), in which all of
    `needs` could be booked for `runtime` seconds. Answered with SlotsTold."""

    id: RequestId
    needs: BookedNeeds
    priority: int
    runtime: Decimal
    within: Elapsed
    start: Instant | None = None
    limit: Annotated[int, msgspec.Meta(ge=1, le=MAX_SLOTS)] = 5
    who: Who | None = None


class SlotView(Message, frozen=True):
    """A slot: a booking may start at any time from `start` to `latest`; `bound` has the RC for each pattern."""

    start: Instant
    latest: Instant
    bound: dict[str, str] = {}


class SlotsTold(Message, frozen=True):
    """Slots. `complete` is False if the search ended at the work limit of one query. `time` is fleet time. `likely`:
    all needs are likely to be free then, earlier than they can be booked."""

    id: str
    time: WallTime
    slots: list[SlotView] = []
    complete: bool = True
    likely: Instant | None = None


DateState: TypeAlias = Literal["open", "taken", "used", "lapsed", "unbooked", "conflict"]


class BookedDate(Message, frozen=True):
    """One date of a booking. `open`: not taken up yet. `used`: taken up, and the request ended. `lapsed`: not taken up
    in time. `conflict`: another booking has its needs and takes precedence, made where this booking was not known."""

    start: Instant
    end: Instant
    state: DateState
    bound: dict[str, str] = {}
    """The RC reserved for each pattern."""
    arc: str | None = None
    """`<host>/<client>/<id>` of the request that has taken it up."""
    danger: str = ""
    """Why it may not start at its date, in words; with `conflict`, the booking that takes precedence."""


class BookingView(_Booking, frozen=True):
    """A booking as the leader knows it. `owner` is the host or certificate name that made it, at time `since`. `dates`
    are its dates that are not over, of a repeated booking within the next 60 days; `dropped` are the dates given up."""

    owner: str = ""
    since: Instant = 0
    unbooked: bool = False
    dates: list[BookedDate] = []
    dropped: Dates = []
    maintained: list[ShortText] = []
    """The RCs that maintenance by pattern or host covers now."""


class BookingsAsk(Message, frozen=True):
    """Asks the leader for bookings: the bookings of `owner`, the bookings that may include `rc`, or all."""

    owner: ShortText | None = None
    rc: ShortText | None = None


class Correction(Message, frozen=True):
    """Fleet time was corrected `by` seconds (negative: put back), `ago` seconds before, to the time of most hosts'
    clocks."""

    by: Seconds
    ago: Elapsed


class BookingsTold(Message, frozen=True):
    """Bookings that are not over. `time` is fleet time; `clocks` has the hosts whose clocks differ from it by more than
    2 s, with the seconds by which they are ahead."""

    time: WallTime
    bookings: list[BookingView] = []
    clocks: dict[str, Seconds] = {}
    corrected: Correction | None = None
    """The last correction by this leader, for a day."""


class BookingRecord(_Booking, frozen=True):
    """A booking as stored. Records of one id are merged: `unbooked` is final, and so is each date in `dropped` (given
    up) and `over` (used or lapsed). `made` and `changed` are the (term, seq) of its creation and last change."""

    owner: str = ""
    since: Instant = 0
    """Time of its creation."""
    made: Grant = Grant(NO_TERM, 0)
    changed: Grant = Grant(NO_TERM, 0)
    unbooked: bool = False
    dropped: Dates = []
    over: Dates = []
    kept: Annotated[dict[int, dict[str, str]], msgspec.Meta(max_length=MAX_DATES)] = {}
    """By date: the RC reserved for each pattern of its needs."""


class ShareBookings(Message, frozen=True):
    """The leader asks all processes that store bookings to store these too. A process whose own digest differs from
    `digest` (of all bookings of the leader) answers with all its bookings."""

    term: Term
    digest: str
    records: Annotated[list[BookingRecord], msgspec.Meta(max_length=MAX_MERGED)] = []
    time: WallTime | None = None
    """Fleet time: bookings that ended a day before are forgotten. Absent if fleet time was set recently: then none
    is."""


class BookingsKept(Message, frozen=True):
    """The bookings that a host has stored, sent once they are on its disk if it has one. `wall` is the time of its
    clock, `time` fleet time as last received and continued, which has run for `time_age` seconds; `candidate`: it may
    lead."""

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
    """A time service synchronises the host's clock."""


Operation: TypeAlias = RequestOperation | Book | Unbook | FindSlots
UNIQUE_NAMES.add(Operation)
