"""What a leader asks of its bookings, and what they answer. Pure values.

Dates follow rules and time zones: who reads these is outside (`zscout/services/rcm/bookings.py`)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Protocol, Self, TypeAlias

from msgspec import Struct

from zscout.keyexpr import Sender
from zscout.messages import Ask, BookingRecord, Instant, Operation, ProposedHolder
from zscout.scheduling.model import ArcRequest, Effect, Event, Propose
from zscout.types import ArcId, Ns, Params

Ticket: TypeAlias = int
"""The number of a query that waits for its answer."""
Answer: TypeAlias = tuple[Ticket, Struct]


class BookedDanger(NamedTuple):
    """A date of a booking may not be kept, and why; empty: it is safe again."""

    record: BookingRecord
    start: Instant
    why: str
    later: int = 0
    """Dates after that of which the same is to be reported."""


class Keep(NamedTuple):
    """Answer once a record is kept; `withdraw`: forget it where it can't be."""

    ticket: Ticket
    booking: str
    withdraw: bool


class Again(NamedTuple):
    """An operation whose votes were not all known is tried once more."""

    undecided: Any


@dataclass(slots=True)
class BookingWork:
    """What follows for bookings."""

    events: list[Event] = field(default_factory=list)
    """Of the core, of one instant."""
    answers: list[Answer] = field(default_factory=list)
    proposals: list[Propose] = field(default_factory=list)
    keep: list[Keep] = field(default_factory=list)
    changed: list[BookingRecord] = field(default_factory=list)
    """To be shared with all keepers soon."""
    dangers: list[BookedDanger] = field(default_factory=list)
    log: list[str] = field(default_factory=list)
    strange: list[tuple[str, str]] = field(default_factory=list)
    again: list[Again] = field(default_factory=list)
    """Each in an instant of its own, after this."""


NO_WORK: Final = BookingWork()
"""Nothing follows."""


class FleetBookings(Protocol):
    """The bookings of one term."""

    @property
    def settled(self) -> bool: ...
    @property
    def settles_at(self) -> Ns: ...
    @property
    def time(self) -> float | None: ...
    @property
    def age(self) -> float: ...
    @property
    def next(self) -> Ns | None: ...
    def at(self, now: Ns) -> Self:
        """The present time is `now`."""
        ...

    # What is known
    def take_up(self, ask: Ask, sender: Sender) -> str: ...
    def dated(self, request: ArcRequest) -> ArcRequest: ...
    def record(self, booking: str) -> BookingRecord | None: ...
    def recovered(self, taken: Collection[str]) -> Sequence[Event]: ...
    def proposed(self, name: ArcId, params: Params) -> ProposedHolder: ...

    # What happens
    def operation(self, ticket: Ticket, sender: Sender, operation: Operation) -> BookingWork: ...
    def again(self, again: Again) -> BookingWork: ...
    def kept(self, keep: Keep, why: str) -> BookingWork: ...
    def shared(self, *, news: bool) -> BookingWork: ...
    def note(self, events: Collection[Event], effects: Iterable[Effect]) -> BookingWork: ...
    def tick(self) -> BookingWork: ...
