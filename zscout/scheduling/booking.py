"""Bookings: all of some RCs at once, from a date on. How they are kept is `claims.py`."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from msgspec import Struct

from zscout.keyexpr import is_pattern
from zscout.messages import Who
from zscout.scheduling.needs import check_request
from zscout.scheduling.reason import Party, Reason
from zscout.types import ArcId, Need, Ns, Params, RcName


class Booking(Struct, frozen=True):
    """All of `needs` at once, from `start` on for `runtime` ns: a claim with a date. Its owner's request takes it
    up, or it lapses when nobody has within `patience` ns from the date.

    Raises ValueError as `needs.check_request` does, and for a maintenance of patterns."""

    id: str
    """Unlike any ARC's."""
    needs: Mapping[Need, Params]
    priority: int
    start: Ns
    runtime: Ns
    patience: Ns
    since: Ns
    """When it was made: of promises to equals the older stands."""
    bound: Mapping[Need, RcName] = {}
    """The RC that is kept for each pattern of its needs."""
    owner: str = ""
    """The host or person whose quotas count."""
    label: str = ""
    who: Who | None = None
    maintenance: bool = False
    """Whether its RCs, each for itself, are granted to nobody while it lasts; nobody takes it up, and it has no
    patience."""

    def __post_init__(self) -> None:
        check_request(f"booking {self.id}", self.needs, self.runtime)
        if self.maintenance and (patterns := sorted(filter(is_pattern, self.needs))):
            raise ValueError(f"booking {self.id}: maintenance needs devices by name, not {patterns[0]}")

    @property
    def end(self) -> Ns:
        return self.start + self.runtime

    @property
    def lapses(self) -> Ns:
        """When it is over if nobody takes it up."""
        return self.end if self.maintenance else min(self.start + self.patience, self.end)

    @property
    def party(self) -> Party:
        """It as reasons name it."""
        return Party(self.id, self.label or self.id, self.priority, self.who)


class BookingState(StrEnum):
    OPEN = "open"
    """Nobody has taken it up, or who had is gone before its patience was over."""
    TAKEN = "taken"
    USED = "used"
    """Its ARC is over, or its time."""
    LAPSED = "lapsed"
    """Nobody took it up in time."""
    UNBOOKED = "unbooked"


# Events


class Booked(Struct, frozen=True):
    """A booking that was made, by this RCM or an earlier one. `tentative`: whether it can be is still to be seen; who
    would take it up waits until it is booked again, for certain."""

    booking: Booking
    tentative: bool = False


class Unbooked(Struct, frozen=True):
    """A booking is given up: who has taken it up goes on as if it had asked without. Or it can't be `at_present`: who
    has taken it up waits for its date, and has it again if it is booked once more."""

    booking: str
    at_present: bool = False


class Redated(Struct, frozen=True):
    """The date of a booking that is not held is `start` from now on: the fleet's clock was slewed."""

    booking: str
    start: Ns


# Effects


class BookingChanged(Struct, frozen=True):
    """A booking is in another state; `arc` has taken it up, or had."""

    booking: str
    state: BookingState
    arc: ArcId | None = None


class BookingThreatened(Struct, frozen=True):
    """As far as is known now, this keeps a booking from its start at its date; None: nothing does any more."""

    booking: str
    reason: Reason | None


# The state after the last batch of events


class BookingStatus(Struct, frozen=True):
    """A booking that is not over, the ARC that has taken it up, and the RCs that it has for its patterns."""

    booking: Booking
    arc: ArcId | None
    bound: Mapping[Need, RcName]
