"""Operations of clients, and the answers and publications of the RCM."""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated, Final, TypeAlias

import msgspec

from zscout.messages.base import (
    LIMITS,
    MAX_LISTED,
    Amounts,
    Elapsed,
    Message,
    Problem,
    RcSeconds,
    Seconds,
    ShortText,
    State,
    VersionText,
    WallTime,
)
from zscout.types import NO_TERM, Grant, Place, Term

ADMISSION_CODES = frozenset({"unknown_device", "unknown_parameter", "too_much"})
"""Codes that refuse a request with `check` which can never start."""
MAX_KNOWN = 64
"""Bandwidth parameters of an RC."""
MAX_GROUPS = 1_000
"""Groups whose usage is published."""
MAX_OTHERS = 255
"""ARCs in one hand-over, besides the first."""


Seal: TypeAlias = Annotated[str, msgspec.Meta(max_length=128)]
RequestId: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
ContinuedArc: TypeAlias = Annotated[str, msgspec.Meta(max_length=130)]
"""An ARC's name, or empty."""
BookingRef: TypeAlias = Annotated[str, msgspec.Meta(max_length=96)]
MAX_WHO = 64
"""Characters of a user's, a host's or a command's name."""
MAX_COMMENT = 200


class Who(Message, frozen=True):
    """The requester's description of itself, displayed but never trusted. `host` defaults to the client's host.
    `command` is the program that it runs, `comment` a note of its user to others."""

    user: Annotated[str, msgspec.Meta(max_length=MAX_WHO)] = ""
    host: Annotated[str, msgspec.Meta(max_length=MAX_WHO)] = ""
    command: Annotated[str, msgspec.Meta(max_length=MAX_WHO)] = ""
    comment: Annotated[str, msgspec.Meta(max_length=MAX_COMMENT)] = ""


class _ArcParty(Message, frozen=True):
    """The ARC that a message is about, and its owner."""

    id: str
    arc: str
    client: str


class _Wanted(Message, frozen=True):
    """An ARC that a client wants: all of `needs` for at least `min_runtime` seconds. A need is the name of an RC, or a
    pattern, which any RC that matches meets (`keyexpr.check_need`)."""

    id: str
    arc: str
    needs: dict[str, Amounts]
    priority: int
    min_runtime: Decimal
    keep: bool = False


class _Asked(_Wanted, frozen=True):
    check: bool = False
    """Refuse a request at once that can never start: an unknown device, a parameter unknown to its RC, or a larger
    amount than the RC ever carries. Not allowed with a `place`."""
    wait_for_device: bool = False
    """With `check`: wait for unknown devices."""


class _Request(_Asked, frozen=True):
    """All that a client sends about a request."""

    place: Place | None = None
    waited: Elapsed = 0.0
    estimate: bool = False
    """Notices carry `starts_in` while the ARC is queued."""
    term: Term | None = None
    """The term that the client has promised, if an RCM of a lower term answered: that RCM steps down."""
    grant: Grant | None = None
    """The grant that the client believes to hold, or did not enter. A later RCM that does not know it answers
    `queued`."""
    rcs: Annotated[list[str], msgspec.Meta(max_length=MAX_OTHERS)] = []
    """The RCs of `grant`."""
    unconfirmed: Annotated[list[str], msgspec.Meta(max_length=MAX_OTHERS)] = []
    """Those of `rcs` that did not confirm the grant. If the grant is still in force, it is revoked, and the ARC is
    queued with its place."""
    reachable: bool = False
    """One of `unconfirmed` is visible to the client again: grants held back because of them need wait no longer."""
    direct: bool = False
    """The program accesses devices directly rather than through their RCs, which settle when the hold ends."""
    continues: ContinuedArc = ""
    """The name of another ARC of the client that this ARC continues: a device that passes from the old ARC to the new
    one in a single step is not made safe in between. Neither ARC may be direct."""
    unserved: bool = False
    """The time of `grant` passed while RCs of it settled: it was never used."""
    who: Who | None = None
    seal: Seal | None = None
    """Proof of `place`, from the notice with the place."""
    was: RequestId | None = None
    """The id under which the client had `place`, if it differs from `id`. A request open under it ends."""
    booking: BookingRef = ""
    """The booking that the ARC takes up, with the same needs: its id, or `booking` of a notice."""
    until_done: bool = False
    """It runs a command: a kept hold is protected for the fleet's `command_min_runtime`, cut to the next reserved time
    of its devices. Without effect where `min_runtime` is less than the fleet's."""


class OpenRequest(_Request, frozen=True):
    """A request as its client knows it, for an RCM that takes the lead, or for a client that takes it over. `place` is
    absent if no RCM has answered. Fields that only an Ask needs are left out."""


class Ask(_Request, frozen=True, tag_field="op", tag="request"):
    """Asks for an ARC. `id` is chosen by the client and is the same in repetitions; `place` is from an earlier RCM, and
    `waited` the seconds since the ARC was last queued there."""


class Cancel(Message, frozen=True, tag_field="op", tag="cancel"):
    """Ends an ARC. `client` names its owner if that is not the sender."""

    id: str
    client: str | None = None
    who: Who | None = None
    """Describes the sender if it is not the owner."""
    left: bool = False
    """The program of a direct ARC has ended: no RC settles."""


class Release(Message, frozen=True, tag_field="op", tag="release"):
    """Gives back the RCs of a running ARC. `client` names its owner if that is not the sender."""

    id: str
    client: str | None = None
    who: Who | None = None
    left: bool = False
    """As in `Cancel`."""


class HandOver(Message, frozen=True, tag_field="op", tag="hand_over"):
    """Moves an ARC of the sender to client `to`: under a new grant if it runs, with its place if it waits.

    `others` are handed over in the same step; those not open at the sender are ignored. Idempotent: once done, answered
    with the present state of ARC `id` at `to`."""

    id: str
    to: str
    others: Annotated[list[str], msgspec.Meta(max_length=MAX_OTHERS)] = []


class Foresee(_Asked, frozen=True, tag_field="op", tag="foresee"):
    """Asks for the forecast of a request without making it. Answered with a Foresight."""


class ReasonParty(_ArcParty, frozen=True):
    """An ARC that blocks another ARC, or was preferred to it."""

    priority: int
    who: Who | None = None
    yields_in: Seconds | None = None
    """In a reason to wait: seconds, at most, until this ARC has given way or may be preempted by the waiting ARC;
    absent if unknown."""


class ReasonInfo(Message, frozen=True):
    """Why an ARC waits, or why a hold or a wait ended: `reason` as data.

    `count` is the number of `rcs`, of which the first three are listed (with `patterns` eight), or a quota; with
    `vetoed` it is the number of ARCs in the way. `detail` is a host, a client or a text of an RC, depending on `code`
    (`docs/protocol/messages.md`)."""

    code: str
    rcs: list[str] = []
    by: list[ReasonParty] = []
    detail: str = ""
    count: int = 0
    pattern: str | None = None
    """The need that is not met, if it is a pattern; the other fields are about one of the RCs that would meet it, or
    with `patterns` about all of them."""
    patterns: list[str] = []
    """For each of `rcs` the pattern that it would meet, empty if the ARC names the RC; left out if the ARC names
    all."""
    own: bool = False
    """With `cancelled` and `released`: the ARC's client ended it."""


class Foresight(Message, frozen=True):
    """The forecast of a request, as if no other request came. `starts_in` is absent if it would not start at present,
    or not within the horizon of the forecast; then `reason` explains its wait."""

    id: str
    arc: str
    starts_in: Seconds | None = None
    preempts: list[str] = []
    """Names of the ARCs that the request would preempt at once."""
    reason: str = ""
    begin_within: Elapsed = 0.0
    """Seconds, at most, until its devices have begun: its runtime counts from then."""
    victims: list[ReasonParty] = []
    """The ARCs in `preempts`, with their owners."""
    why: ReasonInfo | None = None
    """`reason` as data."""


RequestOperation: TypeAlias = Ask | Cancel | Release | HandOver | Foresee
MAX_UPCOMING: Final = 16


class Upcoming(Message, frozen=True):
    """A request, a booking or maintenance to which a hold yields. `code`: `waits`, `booked` or `maintenance`."""

    code: str
    by: ReasonParty
    rcs: list[str] = []
    """RCs of the hold that the other needs."""
    safe: Seconds = 0.0
    """Seconds for which the hold does not yield; 0 or less: it may yield at any time."""
    begins_in: Seconds | None = None
    """Seconds until the date of a booking or maintenance; 0 or less if it has begun."""


class Notice(_ArcParty, frozen=True):
    """The state of one request: the answer to an operation, and published to the client at each change.

    Of two notices about a request, the one with the greater `(term, step)` is newer."""

    state: State
    term: Term
    step: int
    priority: int = 0
    reason: str = ""
    outcome: str | None = None
    """How the last hold or wait ended."""
    by: str | None = None
    """The ARC for which the hold was ended."""
    place: Place | None = None
    ahead: int | None = None
    """Number of ARCs that rank before it in the queue."""
    grant: Grant | None = None
    rcs: list[str] = []
    """RCs that the request holds or held; while it waits, the RCs that it names."""
    bound: dict[str, str] = {}
    """While it runs: the RC for each of its patterns."""
    remaining: Seconds | None = None
    """Seconds until its minimum runtime is over; at most, if `waits` is present."""
    starts_in: Seconds | None = None
    """While it is queued, if the client asked for estimates: seconds until it starts if no other request comes; None if
    it would not start at present, or not within the horizon of the forecast."""
    why: ReasonInfo | None = None
    who: Who | None = None
    """Describes the owner, while the request is open."""
    seal: str | None = None
    """Proof for other RCMs that `place` belongs to this ARC; absent if the RCMs share no key."""
    hosts: dict[str, str] = {}
    """While it runs: the host of each RC, as far as known."""
    booking: BookingRef = ""
    """The date of a booking that the request has taken up: `<id>@<start>`."""
    waits: Elapsed | None = None
    """While it runs and some devices have not begun: seconds, at most, until all have."""
    problem: Problem | None = None
    """Why an RCM that took the lead refuses a request that the client listed."""
    upcoming: Annotated[list[Upcoming], msgspec.Meta(max_length=MAX_UPCOMING)] = []
    """While it runs: the request, and the booking or maintenance, to which the hold yields next."""


class _Hold(_ArcParty, frozen=True, kw_only=True):
    """Fields that a hold has from its request; `bound` has the RC for each pattern. On the wire these come last."""

    bound: dict[str, str] = {}
    direct: bool = False
    """As in the request: its RCs settle when it ends."""
    continues: ContinuedArc = ""
    """As in the request: the name of the client's ARC that this hold continues."""
    who: Who | None = None
    booking: BookingRef = ""
    protected_from: Seconds | None = None
    """Once no more than this many seconds of the minimum runtime remain, only operators preempt the hold; None if there
    is no such rule."""
    waits: Elapsed | None = None
    """Seconds, at most, until all devices have begun, after which `remaining` counts; from an RC, until this device
    has. None if begun."""
    runtime: Elapsed | None = None
    """Seconds for which this hold is protected in all, if longer than `min_runtime`."""


class Holder(_Hold, frozen=True):
    """One holder of one RC, complete enough for a new RCM to recover the ARC from the states of RCs alone.

    `rcs` names the whole gang. `remaining` is the rest of the minimum runtime in seconds, negative once it is over;
    with `keep` the hold does not end then."""

    grant: Grant
    place: Place
    rcs: list[str]
    min_runtime: Decimal
    remaining: Seconds
    priority: int = 0
    keep: bool = False
    params: Amounts = {}


class Revocation(_ArcParty, frozen=True):
    """A hold that ended, by name."""

    grant: Grant
    rcs: list[str]
    outcome: str
    reason: str
    by: str | None = None
    why: ReasonInfo | None = None
    own: bool = False
    """The ARC's client gave it back: its program has ended."""


Charged: TypeAlias = Annotated[dict[ShortText, RcSeconds], msgspec.Meta(max_length=MAX_GROUPS)]


class Grants(Message, frozen=True):
    """A publication of the leading RCM. `rcs` has for each changed RC all its holders from now on; `instances` has the
    instance of the RC that is meant: any other instance that receives this holds nothing.

    `prev` is the seq of the previous publication: a receiver that last received another has missed some. Without `rcs`
    and `revoked` this is a heartbeat. Publications come at least every `every` seconds."""

    term: Term
    seq: int
    prev: int
    every: Seconds
    rcs: dict[str, list[Holder]] = {}
    revoked: list[Revocation] = []
    instances: dict[str, str] = {}
    begun: list[tuple[int, Elapsed]] = []
    """For each grant of this term that begins with this publication: its seq, and the seconds for which its ARC was
    queued. For journals only."""
    time: WallTime | None = None
    """Fleet time, to which the dates of bookings refer."""
    time_age: Elapsed = 0.0
    """Seconds for which this fleet time has run, across changes of leader and corrections: of two times the older
    counts."""
    charged: Charged = {}
    """With fair shares, now and then: recent contended usage per group, in RC-seconds. For candidates only, which start
    from it when they lead."""
    patience: Elapsed | None = None
    """Under `adaptive`, now and then: the patience of an ARC queued now, in seconds. Candidates start from it when they
    lead."""


class StateAsk(Message, frozen=True):
    """Queries the state of the RCM. `arc` (a name or an id) adds the history of that ARC."""

    arc: str | None = None
    holds_only: bool = False
    forecast: bool = False
    """Include estimates of the starts of queued ARCs."""
    devices_only: bool = False
    """Only `rcs` is wanted."""


class _HoldView(_Hold, frozen=True):
    priority: int
    grant: Grant
    place: Place
    needs: dict[str, Amounts]
    min_runtime: Decimal
    held: Seconds
    remaining: Seconds
    keep: bool = False


class HoldView(_HoldView, frozen=True, kw_only=True):
    """A hold in force. `held` is its duration so far in seconds; `needs` are by RC. `ends_in`: seconds until it is
    likely to be given back early, as similar holds were."""

    ends_in: Seconds | None = None


class WaitView(_ArcParty, frozen=True):
    """An ARC in the queue, in rank order. `waited`: seconds since it was last queued; `needs` as in the request."""

    priority: int
    place: Place
    needs: dict[str, Amounts]
    min_runtime: Decimal
    waited: Seconds
    reason: str
    preemptions: int = 0
    starts_in: Seconds | None = None
    """An estimate, if the query asked for it, as if no other request came."""
    why: ReasonInfo | None = None
    who: Who | None = None
    booking: BookingRef = ""


class Parameter(Message, frozen=True):
    """A bandwidth parameter that an RC knows."""

    name: str
    unit: str = ""
    bound: Decimal | None = None
    """The most that the RC ever carries, whatever else it carries; None if there is no limit."""
    default: Decimal | None = None
    """The amount of an ARC that gives none; None: nothing."""
    unless: list[str] = []
    """`bound` does not apply if one of these other parameters is given."""


Parameters: TypeAlias = Annotated[list[Parameter], msgspec.Meta(max_length=MAX_KNOWN)]


class RcView(Message, frozen=True):
    rc: str
    present: bool
    sharable: bool
    holders: list[str] = []
    """Ids of the ARCs that hold the RC."""
    host: str = ""
    """Host of the instance in use; without an instance, the last or expected host."""
    reason: str = ""
    """Why the RC is not present, in words."""
    gone: Elapsed | None = None
    """Seconds since the RC was last seen."""
    duplicates: list[str] = []
    """Hosts with further instances of the RC, on standby."""
    unseen: dict[str, Elapsed] = {}
    """Hosts with instances that are not visible any more, and the seconds since they were last seen."""
    parameters: Parameters | None = None
    """All bandwidth parameters that the RC knows; None if it does not list them."""


class StoryLine(Message, frozen=True):
    """An event in the history of an ARC, `ago` seconds before the answer."""

    ago: Seconds
    text: str


class RcmState(Message, frozen=True):
    """The state of the RCM. `seq` is the number of its last publication; `more` counts queued ARCs left out.
    `instances` has the instance in use of each held RC, and its host."""

    term: Term
    seq: int
    host: str
    holds: list[HoldView] = []
    queue: list[WaitView] = []
    rcs: list[RcView] = []
    story: list[StoryLine] = []
    more: int = 0
    instances: dict[str, tuple[str, str]] = {}
    version: VersionText = ""
    charged: Charged = {}
    """As in Grants."""
    patience: Elapsed | None = None
    """As in Grants."""


class ClientRequests(Message, frozen=True):
    client: str
    requests: list[OpenRequest]
    term: Term = NO_TERM
    """The highest term that the client has promised."""


LIMITS[ClientRequests] = MAX_LISTED
