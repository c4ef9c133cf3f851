"""Bookings: all of some RCs at once, from a date on. How they are kept is `claims.py`."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from msgspec import Struct

from zscout.messages import Who
from zscout.scheduling.needs import check_request
from zscout.types import ArcId, Need, Ns, Params, RcName


class Booking(Struct, frozen=True):
    """All of `needs` at once, from `start` on for `runtime` ns: a claim with a date. Its owner's request takes it
    up, or it lapses when nobody has within `patience` ns from the date.

    Raises ValueError as `needs.check_request` does."""

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

    def __post_init__(self) -> None:
        check_request(f"booking {self.id}", self.needs, self.runtime)

    @property
    def end(self) -> Ns:
        return self.start + self.runtime

    @property
    def lapses(self) -> Ns:
        """When it is over if nobody takes it up."""
        return min(self.start + self.patience, self.end)


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
    """A booking that was made, by this RCM or an earlier one."""

    booking: Booking


class Unbooked(Struct, frozen=True):
    """A booking is given up. Who has taken it up goes on as if it had asked without."""

    booking: str


# Effects


class BookingChanged(Struct, frozen=True):
    """A booking is in another state; `arc` has taken it up, or had."""

    booking: str
    state: BookingState
    arc: ArcId | None = None
