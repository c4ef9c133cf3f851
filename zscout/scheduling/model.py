"""What the scheduling core takes, keeps and gives: requests and resource controllers (RCs); events that
it is given, its effects, in the order in which they must be done, and the present state.

Times are whole nanoseconds on one clock of the caller's choice; nothing here reads a clock. Bandwidth
parameters are `Fraction`, so that sums are exact (0.1 + 0.2 is 0.3).
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, TypeAlias

from msgspec import Struct

from zscout.keyexpr import is_pattern, matcher
from zscout.messages import Who
from zscout.scheduling.booking import Booked, Booking, BookingChanged, BookingThreatened, Redated, Unbooked
from zscout.scheduling.needs import check_request
from zscout.scheduling.reason import ITS_CLIENT, SHOWN, Party, Reason
from zscout.types import SECOND, ArcId, ClientId, Grant, Need, Ns, Params, Place, RcName, Term

QUANTUM: Ns = SECOND
"""The paper's quantum: while anything waits, a pass runs at least this often."""
HOLD_BACK: Final[Ns] = SECOND
"""From a hold that was not confirmed to the next one of its ARC: twice as long each time in a row,"""
MAX_HOLD_BACK: Final[Ns] = 30 * SECOND
"""and at most."""

Rank: TypeAlias = tuple[int, int, Ns, Place, ArcId]
"""Sorts contenders, best first: priority (negated), position of the group (`fair_shares.py`), minimum runtime, place,
id."""


class ArcRequest(Struct, frozen=True):
    """One ARC as its client asked for it: all of `needs` at once, for at least `min_runtime` ns (> 0).

    A need names an RC, or is a pattern that any one RC meets (`keyexpr.check_need`).

    Raises ValueError as `needs.check_request` does."""

    arc: ArcId
    client: ClientId
    needs: Mapping[Need, Params]
    priority: int
    min_runtime: Ns
    keep: bool = False
    label: str = ""
    """What people call it; the core only prints it."""
    direct: bool = False
    """Whether its program touches devices past their RCs; the core only keeps it."""
    continues: str = ""
    """The name of the ARC of the same client's that it goes on from, where it can with what that has."""
    booking: str = ""
    """The booking that it takes up; its needs and its priority are that booking's."""
    not_before: Ns = 0
    """Of a booking that is not there yet, or can't be at present: the date that is waited for all the same."""
    who: Who | None = None
    """Who asked, as people are told; the core only prints it."""

    def __post_init__(self) -> None:
        check_request(f"ARC {self.arc}", self.needs, self.min_runtime)

    @property
    def name(self) -> str:
        return self.label or self.arc

    def goes_on_from(self, other: ArcRequest) -> bool:
        return self.continues == other.name and self.client == other.client


class Hold(Struct, frozen=True):
    """A grant in force. `end` is when the minimum runtime is over; with `keep` the hold goes on past it."""

    grant: Grant
    start: Ns
    end: Ns
    protected_below: int | None = None
    """Below this priority nobody preempts it before `end`; None: any higher priority does."""
    last: Ns | None = None
    """When it ends though it is kept; None: nothing ends it but others and its client."""


class ArcState(StrEnum):
    """The state of an ARC. All between NEW and RUNNING are queued; `QueueIndex` says what follows."""

    NEW = "new"
    READY = "ready"
    """The next pass checks it, whatever happens."""
    VOTING = "voting"
    """Its last check waits for votes."""
    DEFERRED = "deferred"
    """Its last check was stopped by that of a higher rank, which waits for votes."""
    WATCHING = "watching"
    """One RC alone keeps it out."""
    PARKED = "parked"
    """An RC that does not answer proposals keeps it out."""
    HELD_BACK = "held_back"
    """An RC did not confirm its last hold: it is not considered for a while. Or another ARC has its place."""
    RUNNING = "running"
    ENDED = "ended"


_CHECKED: Final = (ArcState.READY, ArcState.VOTING, ArcState.DEFERRED, ArcState.WATCHING, ArcState.PARKED)
_LEAVES: Final = (ArcState.HELD_BACK, ArcState.RUNNING, ArcState.ENDED)
_WAITS: Final = (ArcState.READY, ArcState.HELD_BACK)
TRANSITIONS: Final[Mapping[ArcState, tuple[ArcState, ...]]] = {
    ArcState.NEW: (*_WAITS, ArcState.RUNNING),
    ArcState.READY: (*_CHECKED, *_LEAVES),
    ArcState.VOTING: (*_CHECKED, *_LEAVES),
    ArcState.DEFERRED: (*_CHECKED, *_LEAVES),
    ArcState.WATCHING: (*_CHECKED, *_LEAVES),
    # It is made ready before it is checked.
    ArcState.PARKED: (ArcState.READY, *_LEAVES),
    ArcState.HELD_BACK: (*_WAITS, ArcState.ENDED),
    # Preempted, or an RC was lost: queued again.
    ArcState.RUNNING: (ArcState.READY, ArcState.ENDED),
    ArcState.ENDED: (),
}


@dataclass(slots=True, eq=False)
class Arc:
    """A request the core follows, queued or running."""

    request: ArcRequest
    place: Place
    mask: int
    """Bits of the needed RCs (`SchedulerState.rc`); of a pattern, the bit of the RC that it is bound to."""
    patterns: tuple[Need, ...] = ()
    """Those of its needs that are patterns."""
    named_mask: int = 0
    """Bits of the others."""
    state: ArcState = ArcState.NEW
    hold: Hold | None = None
    """What it holds, exactly while it runs."""
    reason: Reason | None = None
    """Why it waits, as last reported; None while it runs. `Core.arc` has the reason of now."""
    since: Ns = 0
    """When it was last queued or granted."""
    preemptions: int = 0
    entry: int = 0
    """Grows with each entry into the queue or among the running: who came there first."""
    rcs: tuple[Rc, ...] = ()
    """Those of `mask`, in the order of the bits; set when the ARC is first queued."""
    footprint: int | None = None
    """While it is VOTING, DEFERRED or PARKED: bits of the RCs that it would take or free."""
    masked_obstacles: int = 0
    """While VOTING or DEFERRED: bits of the RCs whose obstacle was off limits, so that it did not count."""
    watched: Rc | None = None
    """The RC that it is WATCHING."""
    unconfirmed: int = 0
    """How many of its holds in a row were not confirmed."""
    held_back: tuple[Ns, tuple[RcName, ...]] | None = None
    """While it is HELD_BACK: until when, and for which RCs; None where another ARC has its place."""
    starving: bool = False
    """Whether it has waited for too long (`reservations.py`)."""
    bound: Mapping[Need, RcName] = field(default_factory=dict)
    """The RC that each pattern is bound to (`patterns.py`): while it runs, and for the time of a check. Empty
    if there is none for some pattern."""
    claim: Claim | None = None
    """The booking that it has taken up, until that is over."""
    position: int = 0
    """That of its group (`fair_shares.py`); while it runs, that which it started with."""
    late: Ns = 0
    """While it waits: so much later it counts as queued when it comes to who is due (`reservations.py`)."""
    owner: str = field(init=False)
    """Whose quota it counts against: its client's host."""
    id: ArcId = field(init=False)
    priority: int = field(init=False)
    rank: Rank = field(init=False)
    """Higher priority, then the group that had less, then shorter minimum runtime, then earlier place goes first.

    Clients give their places after a takeover, so two may claim one: the id keeps the order total."""
    party: Party = field(init=False)
    """The ARC as reasons name it."""
    needs: Mapping[RcName, Params] = field(init=False)
    """By RC: what it holds, or would as it is bound."""

    def __post_init__(self) -> None:
        self.needs = self.request.needs
        self.take(self.request)

    def take(self, request: ArcRequest) -> None:
        """Takes this for its request: its own one, or that of another client with the same needs."""
        self.request, self.id, self.priority = request, request.arc, request.priority
        self.owner = request.client.partition("/")[0]
        self.party = Party(self.id, request.label or self.id, self.priority, request.who)
        self.put_at(self.position)

    def put_at(self, position: int) -> None:
        """Its group has this position."""
        self.position = position
        self.rank = (-self.priority, position, self.request.min_runtime, self.place, self.id)

    def ends(self, start: Ns) -> Ns:
        """When its minimum runtime is over if it starts then: with a booking, when that is over."""
        end = start + self.request.min_runtime
        return end if self.claim is None or start >= self.claim.booking.end else self.claim.booking.end

    def move_to(self, state: ArcState) -> None:
        """Raises ValueError for a move that is not in `TRANSITIONS`."""
        if state not in TRANSITIONS[self.state]:
            raise ValueError(f"ARC {self.id} is {self.state} and can't become {state}")
        self.state = state

    def known_end(self, other: Arc | None = None) -> float:
        """When its hold ends, or `other` may preempt it, by what is known now; infinite for what it keeps."""
        if self.hold is None:
            return math.inf
        kept = self.request.keep and (other is None or self.priority > other.priority)
        last = math.inf if self.hold.last is None else self.hold.last
        return last if kept else min(self.hold.end, last)

    def blocks(self, other: Arc) -> Party:
        """How the reason names it for which `other` waits, that may not preempt it yet."""
        end = self.known_end(other)
        one = self.party
        return Party(one.arc, one.name, one.priority, one.who, None if math.isinf(end) else int(end))

    def past_min_runtime(self, now: Ns) -> bool:
        """True when a kept hold has had its minimum runtime: equal priority may preempt it then."""
        return self.hold is not None and self.request.keep and now >= self.hold.end

    def preemptible_by(self, other: Arc, now: Ns) -> bool:
        """Whether `other` may take what this running ARC holds."""
        if self.priority >= other.priority:
            return self.priority == other.priority and self.past_min_runtime(now)
        below = self.protected_below(now)
        return below is None or other.priority >= below

    def protected_below(self, now: Ns) -> int | None:
        """The priority below which nobody preempts its hold now; None: any higher priority does."""
        return self.hold.protected_below if self.hold is not None and now < self.hold.end else None


@dataclass(slots=True, eq=False)
class Claim:
    """A booking that is not over."""

    booking: Booking
    arc: Arc
    """Who has taken it up; before, an ARC that stands for it in reservations and votes, and never waits nor runs."""
    kept: int
    """Bits of the RCs that are kept for it; who has taken it up may choose others for its patterns."""
    tentative: bool = False
    """Whether it is still to be seen if it can be: nobody takes it up."""
    danger: Reason | None = None
    """What keeps it from its start, as last told."""

    @property
    def is_taken(self) -> bool:
        return self.arc.claim is self

    @property
    def mask(self) -> int:
        """Bits of the RCs that it holds, or that are kept for it."""
        return self.kept if self.arc.hold is None else self.arc.mask


@dataclass(slots=True, eq=False)
class Rc:
    """One resource controller. `bit` is its bit in every mask, kept for as long as the core lives."""

    name: RcName
    bit: int
    present: bool = False
    sharable: bool = False
    absence: str = ""
    """While it is absent: why, if that is known."""
    holders: dict[ArcId, Arc] = field(default_factory=dict)
    demand: int = 0
    """How many of the queued ARCs name it."""
    watchers: list[Rank] = field(default_factory=list)
    """Ranks of the queued ARCs that watch this RC (`QueueIndex`), best first."""

    def non_preemptible_holders(self, arc: Arc, now: Ns) -> list[Arc]:
        """Its holders that are not preempted for `arc`."""
        return [holder for holder in self.holders.values() if not holder.preemptible_by(arc, now)]


def absences(rcs: Iterable[Rc]) -> str:
    """Why these RCs are absent, as far as that is known, in words."""
    known = [f"{rc.name}: {rc.absence}" for rc in rcs if rc.absence]
    more = f"; {len(known) - SHOWN} more" if len(known) > SHOWN else ""
    return "; ".join(known[:SHOWN]) + more


def union(masks: Iterable[int]) -> int:
    """The bits of all masks."""
    return functools.reduce(operator.or_, masks, 0)


# Events: each carries everything the core may know about it


class Requested(Struct, frozen=True):
    """A program requests an ARC. `place` is set when it had one under an earlier RCM; `since` is then when it
    was last queued, on the core's clock, if that is known."""

    request: ArcRequest
    place: Place | None = None
    since: Ns | None = None


class Cancelled(Struct, frozen=True):
    """The ARC is not wanted any more, whether it waits or runs."""

    arc: ArcId
    by: str = ITS_CLIENT


class Released(Struct, frozen=True):
    """A running ARC gives back what it holds; a waiting one leaves the queue."""

    arc: ArcId
    by: str = ITS_CLIENT


class Vote(Struct, frozen=True):
    """A sharable RC's answer to a proposal."""

    proposal: int
    accept: bool
    reason: str = ""


class VoteOverdue(Struct, frozen=True):
    """No answer to a proposal in time, or it could not be delivered."""

    proposal: int


class RcJoined(Struct, frozen=True):
    """An RC is there and can be granted."""

    rc: RcName
    sharable: bool


class RcReported(Struct, frozen=True):
    """An RC reports that holds ended there, or that the rules it votes by have changed."""

    rc: RcName
    ended: tuple[ArcId, ...] = ()
    rules_changed: bool = False


class RcLost(Struct, frozen=True):
    """An RC is gone, or can't carry its holders any longer; `why`, if that is known, stands in the reason of whoever
    waits for it."""

    rc: RcName
    reason: str = "it left the mesh"
    why: str = ""


class ClientLost(Struct, frozen=True):
    """A program is gone: what it holds is free and what it asked for is forgotten."""

    client: ClientId
    reason: str = "its client left the mesh"


class PlaceShown(Struct, frozen=True):
    """A client shows the place that its ARC was given before; it has entered without."""

    arc: ArcId
    place: Place


class Unconfirmed(Struct, frozen=True):
    """A client could not confirm a grant: these RCs know nothing of it, or do not answer."""

    arc: ArcId
    grant: Grant
    rcs: tuple[RcName, ...]


class Reachable(Struct, frozen=True):
    """One of the RCs that a client could not confirm a grant with has shown itself to it anew."""

    arc: ArcId


class HandedOver(Struct, frozen=True):
    """An ARC goes on in another client (migration), by the name `renamed`: same place; if it runs, same RCs,
    same end, new grant."""

    arc: ArcId
    to: ClientId
    renamed: ArcId


class RecoveredHold(Struct, frozen=True):
    """A hold that was in force when an RCM took the lead: its grant is kept, `end` is on the core's clock."""

    request: ArcRequest
    place: Place
    grant: Grant
    start: Ns
    end: Ns
    bound: Mapping[Need, RcName] = {}
    """By each pattern of its needs: the RC that it holds."""

    def __post_init__(self) -> None:
        patterns = {need for need in self.request.needs if is_pattern(need)}
        if patterns != self.bound.keys() or not all(matcher(need)(rc) for need, rc in self.bound.items()):
            raise ValueError(f"what ARC {self.request.arc} holds for its patterns is not told, or told wrong")

    @property
    def rcs(self) -> list[RcName]:
        return [self.bound.get(need, need) for need in self.request.needs]


class LeadTaken(Struct, frozen=True):
    """This RCM leads from now on, in `term`, over the holds and the queue that it recovered."""

    term: Term
    recovered_holds: tuple[RecoveredHold, ...] = ()
    waiting: tuple[Requested, ...] = ()
    charged: Mapping[str, float] = {}
    """By group: RC-seconds that it had and others waited for, decayed as of now (`fair_shares.py`)."""
    dates_from: Ns = 0
    """Until then dates are not certain: who waits for one does not begin."""


class Adopted(Struct, frozen=True):
    """RCs have joined with a hold of an earlier term, which goes on if all of its gang have, unless this RCM has ended
    it, or its ARC holds something newer."""

    held: RecoveredHold


class Tick(Struct, frozen=True):
    """Time has passed: holds may be over, the quantum may be."""


Event: TypeAlias = (
    Requested
    | Cancelled
    | Released
    | Vote
    | VoteOverdue
    | RcJoined
    | RcReported
    | RcLost
    | ClientLost
    | PlaceShown
    | Unconfirmed
    | Reachable
    | HandedOver
    | LeadTaken
    | Adopted
    | Booked
    | Unbooked
    | Redated
    | Tick
)


# Effects


class Outcome(StrEnum):
    """How a hold, or the wait for one, came to its end."""

    COMPLETED = "completed"
    """It had its minimum runtime."""
    PREEMPTED = "preempted"
    """Taken away by a higher priority; queued again with its place."""
    RELEASED = "released"
    """Given back by its client before the time."""
    CANCELLED = "cancelled"
    LOST = "lost"
    """An RC of the gang went away; queued again with its place."""
    CLIENT_LOST = "client_lost"
    HANDED_OVER = "handed_over"
    """It goes on in another client, under a new grant."""


class Propose(Struct, frozen=True):
    """Ask a sharable RC whether it would carry exactly these holders, by ARC, with their parameters."""

    proposal: int
    rc: RcName
    holders: Mapping[ArcId, Params]


class Granted(Struct, frozen=True):
    """All of `rcs` are the ARC's until `end`; None where it may keep them past its minimum runtime."""

    arc: ArcId
    client: ClientId
    grant: Grant
    rcs: tuple[RcName, ...]
    start: Ns
    end: Ns | None
    waited: Ns | None = None
    """How long its ARC was queued before; None: no hold begins here, one that stood goes on."""


class HoldEnded(Struct, frozen=True):
    """A hold is over. `requeued` says whether its ARC waits again; `by` is the ARC it was taken for."""

    arc: ArcId
    client: ClientId
    grant: Grant
    rcs: tuple[RcName, ...]
    outcome: Outcome
    reason: Reason
    requeued: bool
    by: ArcId | None = None


class Queued(Struct, frozen=True):
    """The ARC waits, for this reason; sent at the first wait and when the reason changes.

    `settled` is False while the RCM itself is still asking votes, so that the answer is near."""

    arc: ArcId
    client: ClientId
    reason: Reason
    settled: bool = True


class Dropped(Struct, frozen=True):
    """A waiting ARC left the queue without having run."""

    arc: ArcId
    client: ClientId
    outcome: Outcome
    reason: Reason


class WakeAt(Struct, frozen=True):
    """Send a `Tick` at this time, or earlier; a later effect replaces it. None: nothing to wait for."""

    at: Ns | None


Effect: TypeAlias = Propose | Granted | HoldEnded | Queued | Dropped | BookingChanged | BookingThreatened | WakeAt


# The state after the last batch of events


class ArcStatus(Struct, frozen=True):
    """One ARC that is queued (`hold is None`) or runs."""

    request: ArcRequest
    place: Place
    hold: Hold | None
    needs: Mapping[RcName, Params]
    """By RC: what it holds, or would hold as its patterns are bound at present."""
    bound: Mapping[Need, RcName]
    """The RC that each pattern of its needs is bound to."""
    since: Ns
    """When it was last queued or granted."""
    preemptions: int
    ahead: int | None
    """How many of the queued rank above it; None while it runs."""
    reason: Reason | None
    """Why it is queued, with all that is in its way; None while it runs."""
    reported: Reason | None
    """The reason of its latest `Queued` effect: not every change of holders far ahead of it is one."""

    @property
    def id(self) -> ArcId:
        return self.request.arc

    @property
    def name(self) -> str:
        return self.request.name


class RcStatus(Struct, frozen=True):
    """One RC; `holders` in the order in which they came to hold it."""

    name: RcName
    present: bool
    sharable: bool
    holders: tuple[ArcId, ...]


class Status(Struct, frozen=True):
    """The whole fleet: who runs, in the order in which they started; who is queued, best rank first and
    perhaps not all of the `waiting`; the RCs by name."""

    running: tuple[ArcStatus, ...]
    queued: tuple[ArcStatus, ...]
    waiting: int
    rcs: tuple[RcStatus, ...]
