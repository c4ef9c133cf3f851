"""Bookings: several RCs at once, from a date on. `calendar.py` keeps them, and gives them to requests (`take_up`)."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from msgspec import Struct

from zscout.keyexpr import host_in, is_pattern, matcher
from zscout.messages import Who
from zscout.scheduling.needs import check_request
from zscout.scheduling.reason import Party, Reason
from zscout.types import ArcId, HostName, Need, Ns, Params, RcName


class Booking(Struct, frozen=True):
    """All of `needs` at once, for `runtime` ns from `start`. Its owner's request takes it up, or it lapses `patience`
    ns after the date.

    The needs of maintenance are RCs, hosts (`keyexpr.of_host`), and patterns, each for all matching RCs.

    Raises ValueError as `needs.check_request` does."""

    id: str
    needs: Mapping[Need, Params]
    priority: int
    start: Ns
    runtime: Ns
    patience: Ns
    since: Ns
    """When it was made: among equals the older booking wins."""
    bound: Mapping[Need, RcName] = {}
    owner: str = ""
    """The host or person whose quotas count."""
    label: str = ""
    who: Who | None = None
    maintenance: bool = False
    """Keeps each RC free of all other holders meanwhile; it is never taken up and has no patience."""
    urgent: bool = False
    """Maintenance also preempts holds within their minimum runtimes, whatever their priority."""
    lasting: bool = False
    """Maintenance without a fixed end: it is extended until it is given up."""

    broken: bool = False
    """Maintenance that ends no hold and keeps no operator away."""

    def __post_init__(self) -> None:
        check_request(f"booking {self.id}", self.needs, self.runtime)

    @property
    def until(self) -> Ns | None:
        """Its end; None: it lasts until it is given up."""
        return None if self.lasting else self.end

    @property
    def hosts(self) -> set[HostName]:
        return {host for host in map(host_in, self.needs) if host is not None} if self.maintenance else set()

    def maintains(self, rc: RcName, host: HostName) -> bool:
        return any(
            need == rc or (matcher(need)(rc) if is_pattern(need) else host_in(need) == host != "")
            for need in self.needs
        )

    @property
    def end(self) -> Ns:
        return self.start + self.runtime

    @property
    def lapses(self) -> Ns:
        return self.end if self.maintenance else min(self.start + self.patience, self.end)

    @property
    def party(self) -> Party:
        return Party(self.id, self.label or self.id, self.priority, self.who)


class BookingState(StrEnum):
    OPEN = "open"
    """Not taken up, or its program ended within the patience."""
    TAKEN = "taken"
    USED = "used"
    LAPSED = "lapsed"
    UNBOOKED = "unbooked"


class Dates(Struct, frozen=True):
    """All bookings, best-ranked first: of bookings that exclude each other the first is kept, and the others are in
    conflict. A missing booking is unbooked or, if it is `forgotten`, absent for now. `more`: this is a part, and dates
    are judged after the last part only. `moved`: the step in ns by which all dates moved since the last of these
    events; it also moves the dates of ARCs without their bookings."""

    ranked: tuple[Booking, ...]
    forgotten: frozenset[str] = frozenset()
    more: bool = False
    moved: Ns = 0


class Booked(Struct, frozen=True):
    """A booking made by this RCM or an earlier one. `tentative`: conflicts are not known yet, so its ARC waits."""

    booking: Booking
    tentative: bool = False


class Unbooked(Struct, frozen=True):
    """A booking is given up and its ARC continues without it; or it is impossible `at_present`, and its ARC waits
    for the date, and takes it up if it is booked again."""

    booking: str
    at_present: bool = False


class Redated(Struct, frozen=True):
    """A booking that is not held moves to `start`: the fleet's clock was corrected."""

    booking: str
    start: Ns


class BookingChanged(Struct, frozen=True):
    booking: str
    state: BookingState
    arc: ArcId | None = None


class BookingThreatened(Struct, frozen=True):
    booking: str
    reason: Reason | None


class BookingBound(Struct, frozen=True):
    """Other RCs are kept for the patterns of a booking, to resolve a conflict."""

    booking: str
    bound: Mapping[Need, RcName]


class BookingConflict(Struct, frozen=True):
    """Excluded by booking `by` or, if `by` is empty, as no RC for its patterns is free. None: it is kept again."""

    booking: str
    by: str | None


class BookingStatus(Struct, frozen=True):
    """An active booking, its ARC, and the RCs bound to its patterns. `maintained`: all RCs of maintenance."""

    booking: Booking
    arc: ArcId | None
    bound: Mapping[Need, RcName]
    maintained: tuple[RcName, ...] = ()

    @property
    def is_unbound(self) -> bool:
        return not self.booking.maintenance and not self.bound and any(map(is_pattern, self.booking.needs))
