"""Operations of clients, and what the RCM answers and publishes."""

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

DOOR_CODES = frozenset({"unknown_device", "unknown_parameter", "too_much"})
"""What a request is refused with that asked for a `check` and can never start."""
MAX_KNOWN = 64
"""Bandwidth parameters that one RC knows."""
MAX_GROUPS = 1_000
"""Groups of which is told what they had."""
MAX_OTHERS = 255
"""ARCs that one hand-over takes along, beside the one that it names first."""


Seal: TypeAlias = Annotated[str, msgspec.Meta(max_length=128)]
RequestId: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
ContinuedArc: TypeAlias = Annotated[str, msgspec.Meta(max_length=130)]
"""An ARC's name, or empty."""
BookingRef: TypeAlias = Annotated[str, msgspec.Meta(max_length=96)]
MAX_WHO = 64
"""Characters of a user's, a host's or a command's name."""
MAX_COMMENT = 200


class Who(Message, frozen=True):
    """Who asks, by its own word: shown to people, never believed. `host` may be left out: it is that of the client
    then. `command` is what it runs, `comment` what its user wants others to know."""

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
    """What a client wants of an ARC: all of `needs`, for at least `min_runtime` seconds. A need is the name of an RC,
    or a pattern that any one RC meets (`keyexpr.check_need`)."""

    id: str
    arc: str
    needs: dict[str, Amounts]
    priority: int
    min_runtime: Decimal
    keep: bool = False


class _Asked(_Wanted, frozen=True):
    check: bool = False
    """Refuse at once what can never start: a need that nobody knows, a parameter that its RC does not know, or more of
    one than that ever carries. Not with a `place`."""
    wait_for_device: bool = False
    """With `check`: a need that nobody knows is waited for."""


class _Request(_Asked, frozen=True):
    """All that a client says of a request."""

    place: Place | None = None
    waited: Elapsed = 0.0
    estimate: bool = False
    """Whether notices are to carry `starts_in` while it is queued."""
    term: Term | None = None
    """What its client has promised, where an RCM of a lower term answered: that RCM steps down."""
    grant: Grant | None = None
    """What its client believes to hold, or did not enter. A later RCM that was never told of it answers `queued`."""
    rcs: Annotated[list[str], msgspec.Meta(max_length=MAX_OTHERS)] = []
    """The RCs of `grant`."""
    unconfirmed: Annotated[list[str], msgspec.Meta(max_length=MAX_OTHERS)] = []
    """Those of them that did not confirm it. If it is still in force, it is revoked, and the ARC is queued with its
    place."""
    reachable: bool = False
    """One of those has shown itself to the client anew: what was held back for them need wait no more."""
    direct: bool = False
    """Its program touches devices past their RCs, which settle when its hold ends."""
    continues: ContinuedArc = ""
    """The name of another ARC of its client's from which it goes on: a device that passes from that one to this in one
    step is not made safe in between. Neither is direct."""
    unserved: bool = False
    """The time of `grant` went by while RCs of it settled: nobody made use of it."""
    who: Who | None = None
    seal: Seal | None = None
    """As its notice had it beside the place."""
    was: RequestId | None = None
    """The id under which its client had that place, where it is another one now. What is open under it ends."""
    booking: BookingRef = ""
    """The booking that it takes up, whose needs it has: its id, or as a notice has it."""


class OpenRequest(_Request, frozen=True):
    """A request as its client knows it, for an RCM that takes the lead, or another client that goes on with it. `place`
    is absent where no RCM has answered. What only an Ask has to say is left out."""


class Ask(_Request, frozen=True, tag_field="op", tag="request"):
    """Asks for an ARC. `id` is the client's own and stays the same however often it asks; `place` is what an earlier
    RCM gave, and `waited` the seconds since it was last queued there."""


class Cancel(Message, frozen=True, tag_field="op", tag="cancel"):
    """The ARC is not wanted any more. `client` names its owner where that is not the sender."""

    id: str
    client: str | None = None
    who: Who | None = None
    """Who ends it, where that is not its owner."""
    left: bool = False
    """Its program, where the ARC is direct, is gone: no RC settles for it."""


class Release(Message, frozen=True, tag_field="op", tag="release"):
    """Gives back what a running ARC holds. `client` names its owner where that is not the sender."""

    id: str
    client: str | None = None
    who: Who | None = None
    left: bool = False
    """As in `Cancel`."""


class HandOver(Message, frozen=True, tag_field="op", tag="hand_over"):
    """The sender's ARC goes on in client `to`: under a new grant if it runs, at its place if it waits.

    `others` are handed over in the same step; those that are not open at the sender are ignored. Idempotent:
    once it is done, answered with the present state of ARC `id` at `to`."""

    id: str
    to: str
    others: Annotated[list[str], msgspec.Meta(max_length=MAX_OTHERS)] = []


class Foresee(_Asked, frozen=True, tag_field="op", tag="foresee"):
    """Asks for the forecast of a request without making it. Answered with a Foresight."""


class ReasonParty(_ArcParty, frozen=True):
    """An ARC that is in another's way, or was preferred to it."""

    priority: int
    who: Who | None = None
    yields_in: Seconds | None = None
    """In a reason to wait: seconds until it holds no more, or may be preempted for it, at the latest; absent: not
    known."""


class ReasonInfo(Message, frozen=True):
    """Why an ARC waits, or why a hold or a wait ended: what `reason` says, as data.

    `count` counts `rcs`, of which the first three are named (with `patterns` eight), or is a quota; with `vetoed` it
    counts who is in the way. `detail` is a host, a client or an RC's own words, as `code` has it (`docs/protocol.md`).
    """

    code: str
    rcs: list[str] = []
    by: list[ReasonParty] = []
    detail: str = ""
    count: int = 0
    pattern: str | None = None
    """The pattern of its needs that is not met; the rest is about one of the RCs that would meet it, or with `patterns`
    about all of them."""
    patterns: list[str] = []
    """By each of `rcs` the pattern that it is a choice for, empty where the ARC names it; left out where it names all.
    """
    own: bool = False
    """With `cancelled` and `released`: its own client ended it."""


class Foresight(Message, frozen=True):
    """The forecast of a request, if no other came. `starts_in` is absent where it would not start as things
    stand, or not within the horizon of the forecast; `reason` then names what it would wait for."""

    id: str
    arc: str
    starts_in: Seconds | None = None
    preempts: list[str] = []
    """Names of the ARCs that it would preempt at once."""
    reason: str = ""
    begin_within: Elapsed = 0.0
    """Seconds that its devices need to begin, at most: its runtime counts from then."""
    victims: list[ReasonParty] = []
    """The same ARCs, and whose they are."""
    why: ReasonInfo | None = None
    """What `reason` says, as data."""


RequestOperation: TypeAlias = Ask | Cancel | Release | HandOver | Foresee
MAX_UPCOMING: Final = 16


class Upcoming(Message, frozen=True):
    """A request, a booking or maintenance to which a hold yields. `code`: `waits`, `booked` or `maintenance`."""

    code: str
    by: ReasonParty
    rcs: list[str] = []
    """The RCs of the hold that it is about."""
    safe: Seconds = 0.0
    """For so many seconds the hold does not end for it; 0 or less: it may end at any time."""
    begins_in: Seconds | None = None
    """Seconds until the date of a booking or maintenance; 0 or less: it has begun."""


class Notice(_ArcParty, frozen=True):
    """The state of one request: the answer to an operation, and published to its client at each change.

    Of two notices about one request the one with the greater `(term, step)` is the newer."""

    state: State
    term: Term
    step: int
    priority: int = 0
    reason: str = ""
    outcome: str | None = None
    """How the last hold, or the wait, ended."""
    by: str | None = None
    """The ARC that it was taken for."""
    place: Place | None = None
    ahead: int | None = None
    """ARCs that rank before it in the queue."""
    grant: Grant | None = None
    rcs: list[str] = []
    """What it holds, or held; of a request that waits, the RCs that it names."""
    bound: dict[str, str] = {}
    """While it runs: the RC that meets each of its patterns."""
    remaining: Seconds | None = None
    """Seconds until its minimum runtime is over; with `waits`, at the latest."""
    starts_in: Seconds | None = None
    """While it is queued, where the client asked for estimates: seconds until it will start if nothing else
    comes; None where it will not as things stand, or not within what can be forecast."""
    why: ReasonInfo | None = None
    who: Who | None = None
    """Whose it is, while it is open."""
    seal: str | None = None
    """Proof that the place is this ARC's, for every RCM; absent where RCMs share no key."""
    hosts: dict[str, str] = {}
    """While it runs: where its RCs are, by RC, as far as that is known."""
    booking: BookingRef = ""
    """The date of a booking that it has taken up: `<id>@<start>`."""
    waits: Elapsed | None = None
    """While it runs and devices of it have not begun: seconds, at most, until they have."""
    problem: Problem | None = None
    """Why it ended, where an RCM that took the lead refuses what its client listed."""
    upcoming: Annotated[list[Upcoming], msgspec.Meta(max_length=MAX_UPCOMING)] = []
    """While it runs: to which request, and which booking or maintenance, it yields next."""


class _Hold(_ArcParty, frozen=True, kw_only=True):
    """What its request gave a hold: `bound` is the RC that meets each of its patterns. On the wire these come last."""

    bound: dict[str, str] = {}
    direct: bool = False
    """As asked: its RCs settle when it ends."""
    continues: ContinuedArc = ""
    """As asked: what the same client held by that name goes on in it."""
    who: Who | None = None
    booking: BookingRef = ""
    protected_from: Seconds | None = None
    """From when so many seconds of its minimum runtime remain, only operators preempt it; None: no such rule."""
    waits: Elapsed | None = None
    """Seconds, at most, until its devices have begun: `remaining` counts from then. From an RC: until this one has.
    None: begun."""


class Holder(_Hold, frozen=True):
    """One holder of one RC, so complete that a new RCM can recover its ARC from the RCs' states alone.

    `rcs` names the whole gang. `remaining` seconds of its minimum runtime are left, negative where it is over; with
    `keep` the hold does not end then."""

    grant: Grant
    place: Place
    rcs: list[str]
    min_runtime: Decimal
    remaining: Seconds
    priority: int = 0
    keep: bool = False
    params: Amounts = {}


class Revocation(_ArcParty, frozen=True):
    """A hold that is over, by name."""

    grant: Grant
    rcs: list[str]
    outcome: str
    reason: str
    by: str | None = None
    why: ReasonInfo | None = None
    own: bool = False
    """Whether its own client gave it back: its program is gone."""


Charged: TypeAlias = Annotated[dict[ShortText, RcSeconds], msgspec.Meta(max_length=MAX_GROUPS)]


class Grants(Message, frozen=True):
    """A publication of the leading RCM. For each RC touched, all its holders from now on, and the `instance` of it that
    is meant: another one that hears this holds nothing.

    `prev` is the seq of the publication before: a receiver whose last one was another has missed some. Without `rcs`
    and `revoked` it is a heartbeat; one comes at least every `every` seconds."""

    term: Term
    seq: int
    prev: int
    every: Seconds
    rcs: dict[str, list[Holder]] = {}
    revoked: list[Revocation] = []
    instances: dict[str, str] = {}
    begun: list[tuple[int, Elapsed]] = []
    """Of each grant of this term that begins with it: its seq, and the seconds for which its ARC was queued. Nobody
    obeys this: journals keep it."""
    time: WallTime | None = None
    """Fleet time, by which bookings have their dates."""
    time_age: Elapsed = 0.0
    """For how many seconds that time has gone on, over changes of leader and corrections: of two the older counts."""
    charged: Charged = {}
    """With fair shares, now and then: by group the RC-seconds that it lately had and others waited for. Nobody obeys
    this: candidates go on from it when they lead."""
    patience: Elapsed | None = None
    """Now and then, under `adaptive`: that of an ARC that is queued now. Candidates go on from it."""


class StateAsk(Message, frozen=True):
    """Queries the state of the RCM. `arc` (a name or an id) asks for the history of one ARC besides."""

    arc: str | None = None
    holds_only: bool = False
    forecast: bool = False
    """Whether to estimate when queued ARCs will start."""
    devices_only: bool = False
    """Whether only `rcs` is wanted."""


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
    """A hold in force. `held` is how long it has stood, in seconds; `needs` are by RC. In `ends_in` seconds it is
    likely to be given back, as such holds usually were, before it is over."""

    ends_in: Seconds | None = None


class WaitView(_ArcParty, frozen=True):
    """An ARC in the queue, in rank order. `waited` seconds since it was last queued; `needs` as asked."""

    priority: int
    place: Place
    needs: dict[str, Amounts]
    min_runtime: Decimal
    waited: Seconds
    reason: str
    preemptions: int = 0
    starts_in: Seconds | None = None
    """An estimate, where one was asked for: as if nothing else were to come."""
    why: ReasonInfo | None = None
    who: Who | None = None
    booking: BookingRef = ""


class Parameter(Message, frozen=True):
    """A bandwidth parameter that an RC knows."""

    name: str
    unit: str = ""
    bound: Decimal | None = None
    """More than this is never carried, whoever holds the RC besides; None: any amount is."""
    default: Decimal | None = None
    """What an ARC books that does not say; None: nothing."""
    unless: list[str] = []
    """With one of these other parameters `bound` says nothing."""


Parameters: TypeAlias = Annotated[list[Parameter], msgspec.Meta(max_length=MAX_KNOWN)]


class RcView(Message, frozen=True):
    rc: str
    present: bool
    sharable: bool
    holders: list[str] = []
    """Ids of the ARCs that hold it."""
    host: str = ""
    """Of the instance that is meant; while there is none, where it was last, or is expected."""
    reason: str = ""
    """Why it is not present, in words."""
    gone: Elapsed | None = None
    """For how many seconds it has not been seen."""
    duplicates: list[str] = []
    """Hosts that offer it as well, and stand by."""
    unseen: dict[str, Elapsed] = {}
    """Hosts that offered it as well, and have not been seen for so many seconds."""
    parameters: Parameters | None = None
    """All bandwidth parameters that it knows; None: it does not say."""


class StoryLine(Message, frozen=True):
    """Something that happened to an ARC, `ago` seconds before the answer."""

    ago: Seconds
    text: str


class RcmState(Message, frozen=True):
    """The state of the RCM. `seq` is the last that it published; `more` counts queued ARCs left out. `instances` has
    the instance that is meant of each RC that is held, and its host."""

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
    """The highest that it has promised."""


LIMITS[ClientRequests] = MAX_LISTED
