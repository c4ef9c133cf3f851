"""Data of the scheduling core: requests, RCs, events, effects and status.

`Arc.rank` is the order of the queue, `Arc.preemptible_by` the rule of preemption.

Times are whole ns on the caller's clock. Bandwidth parameters are `Fraction`, so sums are exact."""

from __future__ import annotations

import functools
import math
import operator
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from operator import itemgetter
from typing import Final, NamedTuple, TypeAlias

from msgspec import Struct, structs

from zscout.keyexpr import is_pattern, matcher
from zscout.messages import Who
from zscout.scheduling.booking import (
    Booked,
    Booking,
    BookingBound,
    BookingChanged,
    BookingConflict,
    BookingThreatened,
    Dates,
    Redated,
    Unbooked,
)
from zscout.scheduling.needs import check_request
from zscout.scheduling.reason import SHOWN, Party, Reason
from zscout.types import SECOND, ArcId, ClientId, Grant, Need, Ns, Params, Place, RcName, Term

QUANTUM: Ns = SECOND
"""The paper's quantum: while an ARC waits, a pass runs at least this often."""
HOLD_BACK: Final[Ns] = SECOND
"""Pause of an ARC after an unconfirmed hold. Each further one in a row doubles it."""
MAX_HOLD_BACK: Final[Ns] = 30 * SECOND
"""The longest such pause."""

WAITS_SLACK: Final[Ns] = SECOND
"""Smaller changes of the time by which devices begin are not reported."""

Rank: TypeAlias = tuple[int, int, Ns, Place, ArcId]
"""Sort key, best first: priority (negated), position of the group (`fair_shares.py`), minimum runtime, place, id."""


class ArcRequest(Struct, frozen=True):
    """A request for all of `needs` at once, for at least `min_runtime` ns (> 0). A need is the name of an RC, or a
    pattern that any matching RC meets.

    Raises ValueError as `needs.check_request` does."""

    arc: ArcId
    client: ClientId
    needs: Mapping[Need, Params]
    priority: int
    min_runtime: Ns
    keep: bool = False
    label: str = ""
    """The name for people; unused by the core."""
    direct: bool = False
    """Its program accesses devices without their RCs; unused by the core."""
    continues: str = ""
    """The name of its client's ARC that it continues, on the same RCs where possible."""
    booking: str = ""
    not_before: Ns = 0
    """The date to wait for while its booking is absent or impossible."""
    who: Who | None = None
    """The requester, for people; unused by the core."""
    charged_to: str = ""
    """The owner for quotas and fair shares, if not its client's host: for a component, the person who started it."""
    until_done: Ns = 0
    """A kept hold is protected this long, if that is more than `min_runtime`, but not beyond the next reserved time of
    its RCs (`Core.start`). Rank, patience and reservations go by `min_runtime`."""

    def at_most(self, longest: Ns) -> ArcRequest:
        if max(self.min_runtime, self.until_done) <= longest:
            return self
        shorter = min(self.min_runtime, longest), min(self.until_done, longest)
        return structs.replace(self, min_runtime=shorter[0], until_done=shorter[1])

    @property
    def owner(self) -> str:
        return self.charged_to or self.client.partition("/")[0]

    def __post_init__(self) -> None:
        check_request(f"ARC {self.arc}", self.needs, self.min_runtime)

    @property
    def name(self) -> str:
        return self.label or self.arc

    def continues_from(self, other: ArcRequest) -> bool:
        return self.continues == other.name and self.client == other.client


class Hold(Struct, frozen=True):
    """A grant in force. `end` is the end of the minimum runtime, or the latest possible end until the devices have
    begun; with `keep` the hold lasts longer."""

    grant: Grant
    start: Ns
    end: Ns
    protected_below: int | None = None
    """From `protected_from` to `end` only this priority or higher preempts it; None: any higher priority."""
    last: Ns | None = None
    """When `max_runtime` ends it; None: never."""
    protected_from: Ns = 0
    waits: Ns | None = None
    """The time by which the last of its devices begins, and its runtime with it. None: all have begun."""
    runtime: Ns | None = None
    """The minimum runtime of this hold, if it is longer than its request's (`until_done`)."""

    def remaining(self, now: Ns) -> Ns:
        """The time left of the minimum runtime: all of it until the devices have begun."""
        return self.end - (now if self.waits is None else max(now, self.waits))

    def starting(self, now: Ns) -> Ns | None:
        """The longest time until its devices have begun; None: they have."""
        return None if self.waits is None else max(0, self.waits - now)


class ArcState(StrEnum):
    """All states between NEW and RUNNING are queued; see `QueueIndex`."""

    NEW = "new"
    READY = "ready"
    """Checked by the next pass in any case."""
    VOTING = "voting"
    DEFERRED = "deferred"
    """Waits for the open votes of a higher rank about common RCs."""
    WATCHING = "watching"
    PARKED = "parked"
    """Waits for an RC that does not answer proposals."""
    HELD_BACK = "held_back"
    """Not considered for now: after an unconfirmed hold, before its booking's date, or while another ARC has its
    place."""
    RUNNING = "running"
    ENDED = "ended"


_CHECKED: Final = (ArcState.READY, ArcState.VOTING, ArcState.DEFERRED, ArcState.WATCHING, ArcState.PARKED)
_LEAVES: Final = (ArcState.HELD_BACK, ArcState.RUNNING, ArcState.ENDED)
_WAITS: Final = (ArcState.READY, ArcState.HELD_BACK)
TRANSITIONS: Final[Mapping[ArcState, tuple[ArcState, ...]]] = {
    ArcState.NEW: (*_WAITS, ArcState.RUNNING),
    **dict.fromkeys(_CHECKED, (*_CHECKED, *_LEAVES)),
    ArcState.PARKED: (ArcState.READY, *_LEAVES),  # made ready before it is checked
    ArcState.HELD_BACK: (*_WAITS, ArcState.ENDED),
    ArcState.RUNNING: (ArcState.READY, ArcState.ENDED),  # preempted, or an RC was lost: queued again
    ArcState.ENDED: (),
}


@dataclass(slots=True, eq=False)
class Arc:
    request: ArcRequest
    place: Place
    mask: int  # bits of the needed RCs (`SchedulerState.rc`); for a pattern, of the bound RC
    patterns: tuple[Need, ...] = ()
    named_mask: int = 0  # bits of the RCs named without patterns
    state: ArcState = ArcState.NEW
    hold: Hold | None = None  # present exactly while it runs
    reason: Reason | None = None
    """The last reported reason to wait; None while it runs. `Core.arc` has the current reason."""
    since: Ns = 0  # when it was last queued or granted
    preemptions: int = 0
    entry: int = 0  # the number of its last entry into the queue or among the running ARCs
    rcs: tuple[Rc, ...] = ()  # the RCs of `mask` in bit order; set when first queued
    footprint: int | None = None  # while VOTING, DEFERRED or PARKED: bits of the RCs that it would take or free
    masked_obstacles: int = 0
    """While VOTING or DEFERRED: bits of the RCs whose obstacles did not count, because they were off limits."""
    watched: Rc | PatternClass | None = None
    like: PatternClass | None = None  # while queued, with patterns
    unconfirmed: int = 0  # unconfirmed holds in a row
    held_back: tuple[Ns, tuple[RcName, ...]] | None = None
    """While HELD_BACK: the end of the pause, and the RCs that end it when they join; None where another ARC has its
    place."""
    starving: bool = False  # waiting for too long (`reservations.py`)
    patience: Ns = 0  # the fleet's patience at the time when the ARC was queued
    lost: Ns = 0  # runtime lost to other owners' ARCs
    waited: Ns = 0  # while it runs: how long it waited before
    unproven_wait: Ns = 0  # the part of its wait that only its client reports: it gives no protection
    bound: Mapping[Need, RcName] = field(default_factory=dict)
    """The RC of each pattern (`patterns.py`), while it runs or is checked. Empty if some pattern has none."""
    claim: Claim | None = None  # the active booking that it has taken up
    waits: dict[RcName, Ns | None] = field(default_factory=dict)
    """While it runs: the RCs that could not begin at its grant, each with the time by which it begins; None: it has
    begun since."""
    position: int = 0  # the position of its group (`fair_shares.py`); while it runs, as of its start
    vouched: bool = True  # False: only RCs have reported it, not yet its client, and it is not charged
    late: Ns = 0  # delay that its group's share adds to its waiting time (`reservations.py`)
    owner: str = field(init=False)
    id: ArcId = field(init=False)
    priority: int = field(init=False)
    rank: Rank = field(init=False)  # after a takeover two clients may claim one place: the id keeps the order total
    party: Party = field(init=False)
    needs: Mapping[RcName, Params] = field(init=False)  # by RC: held, or wanted as bound

    def __post_init__(self) -> None:
        self.needs = self.request.needs
        self.take(self.request)

    def take(self, request: ArcRequest) -> None:
        """Set the request, of this or another client, with the same needs; derive its fields again."""
        self.request, self.id, self.priority = request, request.arc, request.priority
        self.owner = request.owner
        self.party = Party(self.id, request.label or self.id, self.priority, request.who)
        self.put_at(self.position)

    def put_at(self, position: int) -> None:
        """Set its rank: priority first, then its group's position, the shorter runtime, the earlier place."""
        self.position = position
        self.rank = (-self.priority, position, self.request.min_runtime, self.place, self.id)

    @property
    def starves(self) -> Ns:
        """When it begins to starve if it is still queued (`reservations.py`)."""
        return self.since + self.late + self.patience // 2

    @property
    def begin_within(self) -> Ns:
        """The longest `Rc.begin_within` of its RCs; 0 if an RC has none."""
        most: Ns = 0
        for rc in self.rcs:
            if rc.begin_within is None:
                return 0
            most = max(most, rc.begin_within)
        return most

    def ends(self, start: Ns) -> Ns:
        """The latest end of its minimum runtime, or the end of its booking, if it is granted at `start`."""
        return self.ends_after(start, start + self.begin_within)

    def ends_after(self, start: Ns, begun: Ns, runtime: Ns | None = None) -> Ns:
        """As `ends`, if its devices begin at `begun`. `runtime`: the hold's minimum runtime, if not the request's."""
        end = begun + (self.request.min_runtime if runtime is None else runtime)
        return end if self.claim is None or start >= self.claim.booking.end else self.claim.booking.end

    @property
    def waits_until(self) -> Ns | None:
        """The time by which the last of its RCs begins; None: all have begun, or an RC knows no bound."""
        if not self.waits or any(rc.begin_within is None for rc in self.rcs):
            return None
        return max((until for until in self.waits.values() if until is not None), default=None)

    @property
    def runs(self) -> bool:
        """Return True if its hold's runtime has begun: all devices have, or its booking fixes the end."""
        return self.hold is not None and (self.hold.waits is None or self.claim is not None)

    def move_to(self, state: ArcState) -> None:
        if state not in TRANSITIONS[self.state]:
            raise ValueError(f"ARC {self.id} is {self.state} and can't become {state}")
        self.state = state

    def known_end(self, other: Arc | None = None) -> float:
        """When its hold ends or `other` may preempt it, as known now; infinite for a kept hold without such an end."""
        if self.hold is None:
            return math.inf
        kept = self.request.keep and (other is None or self.priority > other.priority)
        last = math.inf if self.hold.last is None else self.hold.last
        return last if kept else min(self.hold.end, last)

    def blocks(self, other: Arc) -> Party:
        """Its party in the reason of `other`, with the time until which it is in the way."""
        end = self.known_end(other)
        return self.party._replace(until=None if math.isinf(end) else int(end))

    def past_min_runtime(self, now: Ns) -> bool:
        """Return True for a kept hold past its minimum runtime: equal priority may preempt it."""
        return self.hold is not None and self.request.keep and now >= self.hold.end and self.runs

    def preemptible_by(self, other: Arc, now: Ns) -> bool:
        if self.priority >= other.priority:
            return self.priority == other.priority and self.past_min_runtime(now)
        below = self.protected_below(now)
        return below is None or other.priority >= below

    def protected_below(self, now: Ns) -> int | None:
        """Priorities below this can't preempt its hold now; None: any higher priority can."""
        hold = self.hold
        if hold is None or now < hold.protected_from or (now >= hold.end and self.runs):
            return None
        return hold.protected_below


@dataclass(slots=True, eq=False)
class Claim:
    booking: Booking
    arc: Arc  # the ARC that took it up; until then a placeholder for reservations and votes, neither queued nor run
    kept: int  # bits of the RCs kept for it; its ARC may choose others for its patterns
    tentative: bool = False  # conflicts are not checked yet: it can't be taken up
    danger: Reason | None = None  # the last reported danger
    date: Ns = field(init=False)  # its start by the fleet's clock; while it is held, `booking.start` stays as it was

    def __post_init__(self) -> None:
        self.date = self.booking.start

    @property
    def is_taken(self) -> bool:
        return self.arc.claim is self

    @property
    def mask(self) -> int:
        return self.kept if self.arc.hold is None else self.arc.mask


@dataclass(slots=True, eq=False)
class Rc:
    """`bit` is its bit in every mask, for the life of the core."""

    name: RcName
    bit: int
    present: bool = False
    sharable: bool = False
    absence: str = ""  # the reason while absent, if known
    unwell: str = ""  # why it is granted to operators only, though present
    host: str = ""  # its host, or the last one while absent
    begin_within: Ns | None = 0
    """The longest time from a grant until it has begun, settling not included. None: the RC reports no bound."""
    holders: dict[ArcId, Arc] = field(default_factory=dict)
    demand: list[Rank] = field(default_factory=list)  # of the queued ARCs that name it, best first
    watchers: list[Rank] = field(default_factory=list)
    """Ranks of the queued ARCs that watch it (`QueueIndex`), best first."""

    @property
    def wanted(self) -> tuple[float, ...]:
        """Sort key, least wanted first: by the best rank that names the RC, then by the number of such ARCs."""
        if not self.demand:
            return (-math.inf,)
        priority, position, min_runtime, _, _ = self.demand[0]
        return -priority, -position, -min_runtime, len(self.demand)

    def non_preemptible_holders(self, arc: Arc, now: Ns) -> list[Arc]:
        return [holder for holder in self.holders.values() if not holder.preemptible_by(arc, now)]


@dataclass(slots=True, eq=False)
class PatternClass:
    """Queued ARCs with equal patterns, named RCs, priority and barred RCs: where no vote, booking or reservation
    matters, a binding found for one serves all (`patterns.py`)."""

    masks: dict[Need, int] = field(default_factory=dict)  # bits of the RCs for each pattern, present or not
    reach: int = 0  # bits of the RCs for any of them
    members: list[Rank] = field(default_factory=list)
    watchers: list[Rank] = field(default_factory=list)  # members that wait for any change within `reach`
    turns: list[tuple[Rank, Mapping[Need, RcName]]] = field(default_factory=list)
    """Bindings, to different RCs as far as possible. Each serves the ranks from its own up to the next entry's."""
    usable: int = 0  # `patterns.usable` and `short`, as of this version of the state
    usable_of: int = -1
    short: bool = False
    choices: dict[int, object] = field(default_factory=dict)
    """`patterns.Choices` that serve several members of the class, keyed by the bits of RCs reserved for other ARCs."""
    choices_of: tuple[int, int] = (-1, -1)  # versions of holders and demand

    def bound(self, arc: Arc) -> Mapping[Need, RcName]:
        return self.turns[bisect_right(self.turns, arc.rank, key=itemgetter(0)) - 1][1]


def absences(rcs: Iterable[Rc]) -> str:
    known = [f"{rc.name}: {rc.absence or rc.unwell}" for rc in rcs if rc.absence or rc.unwell]
    more = f"; {len(known) - SHOWN} more" if len(known) > SHOWN else ""
    return "; ".join(known[:SHOWN]) + more


def union(masks: Iterable[int]) -> int:
    return functools.reduce(operator.or_, masks, 0)


class WaitSoFar(NamedTuple):
    """Fields of a queued ARC that decide about its protection, as in `Arc`."""

    patience: Ns
    lost: Ns
    unproven_wait: Ns


class Requested(Struct, frozen=True):
    """`place` is set for an ARC of an earlier RCM; `since`, if known, is when it was last queued. `past` is set where
    a core is copied: a new RCM doesn't know it."""

    request: ArcRequest
    place: Place | None = None
    since: Ns | None = None
    past: WaitSoFar | None = None


class Cancelled(Struct, frozen=True):
    """`by`: the name of its ender, for the reason; empty: its own client."""

    arc: ArcId
    by: str = ""


class Released(Struct, frozen=True):
    arc: ArcId
    by: str = ""


class Vote(Struct, frozen=True):
    proposal: int
    accept: bool
    reason: str = ""


class VoteOverdue(Struct, frozen=True):
    proposal: int


class RcJoined(Struct, frozen=True):
    rc: RcName
    sharable: bool
    host: str = ""
    begin_within: Ns | None = 0
    """As in `Rc`."""
    unwell: str = ""


class RcBegins(Struct, frozen=True):
    """An RC reports how long it needs to begin. `holds`: by grant, the time by which the RC begins; None: it has."""

    rc: RcName
    begin_within: Ns | None
    holds: Mapping[Grant, Ns | None] = {}


class RcUnwell(Struct, frozen=True):
    """A present RC is unwell: holders keep it, and it is granted to operators only. An empty `why`: it is well."""

    rc: RcName
    why: str = ""


class RcReported(Struct, frozen=True):
    """Holds ended at the RC, or its voting rules changed."""

    rc: RcName
    ended: tuple[ArcId, ...] = ()
    rules_changed: bool = False


class RcLost(Struct, frozen=True):
    """An RC left or can't carry its holders; `why`, if known, appears in the reasons of waiting ARCs."""

    rc: RcName
    reason: str = "it left the mesh"
    why: str = ""


class ClientLost(Struct, frozen=True):
    client: ClientId
    reason: str = "its client left the mesh"


class PlaceShown(Struct, frozen=True):
    """A client presents the earlier place of an ARC that was queued without it."""

    arc: ArcId
    place: Place


class Unconfirmed(Struct, frozen=True):
    """A client could not confirm a grant: these RCs don't know it, or do not answer."""

    arc: ArcId
    grant: Grant
    rcs: tuple[RcName, ...]


class Reachable(Struct, frozen=True):
    arc: ArcId


class HandedOver(Struct, frozen=True):
    """An ARC moves to client `to` as `renamed`: same place, RCs and end, new grant."""

    arc: ArcId
    to: ClientId
    renamed: ArcId


class RecoveredHold(Struct, frozen=True):
    """A hold in force at a change of RCM: its grant is kept, `end` is on the core's clock. With certificates, a hold
    reported by RCs only is not `vouched` for by its client, and has no place."""

    request: ArcRequest
    place: Place | None
    grant: Grant
    start: Ns
    end: Ns
    bound: Mapping[Need, RcName] = {}
    vouched: bool = True
    protected_from: Ns | None = None
    """As reported by its RCs; None: they did not."""
    waits: Mapping[RcName, Ns | None] = {}
    """The RCs that have not begun (`Arc.waits`): `end` counts from the last one's bound."""
    runtime: Ns | None = None
    """As `Hold.runtime`."""

    def __post_init__(self) -> None:
        patterns = {need for need in self.request.needs if is_pattern(need)}
        if patterns != self.bound.keys() or not all(matcher(need)(rc) for need, rc in self.bound.items()):
            raise ValueError(f"recovered hold of ARC {self.request.arc}: `bound` must name a matching RC per pattern")

    @property
    def rcs(self) -> list[RcName]:
        return [self.bound.get(need, need) for need in self.request.needs]


class LeadTaken(Struct, frozen=True):
    """This RCM leads in `term`, with the recovered holds and queue."""

    term: Term
    recovered_holds: tuple[RecoveredHold, ...] = ()
    waiting: tuple[Requested, ...] = ()
    charged: Mapping[str, float] = {}
    """By group: contended RC-seconds, decayed as of now (`fair_shares.py`)."""
    dates_from: Ns = 0
    """Bookings with earlier dates are uncertain: their ARCs do not start."""
    patience: Ns | None = None
    """The patience that a leader last published."""


class Adopted(Struct, frozen=True):
    """RCs joined with a hold of an earlier term. It continues if its gang is complete, unless this RCM has ended it
    or its ARC has a newer hold."""

    held: RecoveredHold


class Vouched(Struct, frozen=True):
    """The client of an ARC reported by RCs only has answered, with its request and place. `bound`: the RC for each
    pattern; None: the hold does not meet the request, and ends."""

    request: ArcRequest
    place: Place | None
    bound: Mapping[Need, RcName] | None


class Tick(Struct, frozen=True):
    """Time has passed."""


_ArcEvent: TypeAlias = Requested | Cancelled | Released | ClientLost | PlaceShown | Unconfirmed | Reachable | HandedOver
_RcEvent: TypeAlias = Vote | VoteOverdue | RcJoined | RcReported | RcUnwell | RcBegins | RcLost
Event: TypeAlias = _ArcEvent | _RcEvent | LeadTaken | Adopted | Vouched | Dates | Booked | Unbooked | Redated | Tick


class Outcome(StrEnum):
    COMPLETED = "completed"
    PREEMPTED = "preempted"
    """Queued again with its place."""
    RELEASED = "released"
    """Ended by its client before its time was over."""
    CANCELLED = "cancelled"
    LOST = "lost"
    """An RC of the gang was lost; queued again with its place."""
    CLIENT_LOST = "client_lost"
    HANDED_OVER = "handed_over"


class Propose(Struct, frozen=True):
    proposal: int
    rc: RcName
    holders: Mapping[ArcId, Params]


class Granted(Struct, frozen=True):
    """The ARC holds all of `rcs` until `end`; None: it keeps them after its minimum runtime."""

    arc: ArcId
    client: ClientId
    grant: Grant
    rcs: tuple[RcName, ...]
    start: Ns
    end: Ns | None
    waited: Ns | None = None
    """ns in the queue before; None for a hold that was already running."""


class HoldTimed(Struct, frozen=True):
    """The devices of a hold are being started, so its runtime begins by `waits`; None: it begins now."""

    arc: ArcId
    client: ClientId
    grant: Grant
    rcs: tuple[RcName, ...]
    waits: Ns | None


class HoldEnded(Struct, frozen=True):
    """`requeued`: its ARC waits again; `by`: the ARC that took the hold."""

    arc: ArcId
    client: ClientId
    grant: Grant
    rcs: tuple[RcName, ...]
    outcome: Outcome
    reason: Reason
    requeued: bool
    by: ArcId | None = None


class Queued(Struct, frozen=True):
    """Sent at the first wait and when the reason changes. `settled` is False while the RCM awaits votes."""

    arc: ArcId
    client: ClientId
    reason: Reason
    settled: bool = True


class Dropped(Struct, frozen=True):
    arc: ArcId
    client: ClientId
    outcome: Outcome
    reason: Reason


class WakeAt(Struct, frozen=True):
    """Send a `Tick` by this time; replaces the last `WakeAt`. None: no tick is needed."""

    at: Ns | None


_BookingEffect: TypeAlias = BookingChanged | BookingThreatened | BookingBound | BookingConflict
Effect: TypeAlias = Propose | Granted | HoldTimed | HoldEnded | Queued | Dropped | _BookingEffect | WakeAt


class ArcStatus(Struct, frozen=True):
    request: ArcRequest
    place: Place
    hold: Hold | None
    needs: Mapping[RcName, Params]
    bound: Mapping[Need, RcName]
    since: Ns
    preemptions: int
    ahead: int | None
    """Queued ARCs of higher rank; None while it runs."""
    reason: Reason | None
    """The full reason to wait; None while it runs."""
    reported: Reason | None
    """The reason of its latest `Queued` effect, which may be out of date."""
    vouched: bool = True
    """False: so far only RCs have reported it."""

    @property
    def id(self) -> ArcId:
        return self.request.arc

    @property
    def name(self) -> str:
        return self.request.name


class RcStatus(Struct, frozen=True):
    name: RcName
    present: bool
    sharable: bool
    holders: tuple[ArcId, ...]


class Status(Struct, frozen=True):
    """The fleet: running ARCs by start, queued ARCs by rank and perhaps not all `waiting`, RCs by name."""

    running: tuple[ArcStatus, ...]
    queued: tuple[ArcStatus, ...]
    waiting: int
    rcs: tuple[RcStatus, ...]
