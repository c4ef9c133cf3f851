"""What crosses the mesh: JSON objects with their schema in the Zenoh encoding (`docs/protocol.md`).

Durations are seconds, never wall times. Unknown fields are ignored, wrong types refused. Terms, grants and
places are arrays that compare element by element: `[counter, rcm]`, `[term, seq]`, `[term, arrival]`.
"""

from __future__ import annotations

import json
from collections import Counter
from decimal import Decimal
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import msgspec

from zscout.balancing.model import Metric, Policy
from zscout.scheduling.model import NO_TERM, Grant, Place, Term

MAX_PAYLOAD = 65_536
"""Bytes of one message that is not a state answer."""
MAX_STATE = 16_000_000
"""Bytes of one answer about a whole fleet."""
MAX_NEEDS = 64
MAX_PARAMS = 16
MAX_COUNTER = 10**12
"""A term whose counter is above this is believed by nobody."""
MAX_JUMP = 1_000_000
"""A term whose counter is this far above all that was heard is an error, not an election."""
MAX_RANKED = 256
"""Hosts in one answer of the balancer."""
MAX_LABELS = 32
"""Of one host."""
MAX_COMPONENTS = 256
"""In one load report."""
MAX_ERROR = 400
"""Characters in the text of an error: it may quote what was sent."""

Amounts: TypeAlias = dict[str, Decimal]
State: TypeAlias = Literal["queued", "running", "ended"]
Seconds: TypeAlias = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""A duration that is computed with: bounded, so that it is still finite in nanoseconds."""
Elapsed: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
"""Likewise; of something that lies behind."""
ShortText: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=130)]
"""A name, or `kind/name`."""
Figure: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Bytes: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=1 << 60)]


class Message(msgspec.Struct, frozen=True, omit_defaults=True):
    """Base of all messages."""


# To the RCM


class Ask(Message, frozen=True, tag_field="op", tag="request"):
    """Asks for an ARC: all of `needs`, for at least `min_runtime` seconds. A need is the name of an RC, or a
    pattern that any one RC meets (`keyexpr.check_need`).

    `id` is the client's own and stays the same however often it asks; `place` is what an earlier RCM gave,
    and `waited` the seconds since it was last queued there.
    """

    id: str
    arc: str
    needs: dict[str, Amounts]
    priority: int
    min_runtime: Decimal
    keep: bool = False
    place: Place | None = None
    waited: Elapsed = 0.0


class Cancel(Message, frozen=True, tag_field="op", tag="cancel"):
    """The ARC is not wanted any more. `client` names its owner where that is not the sender."""

    id: str
    client: str | None = None


class Release(Message, frozen=True, tag_field="op", tag="release"):
    """Gives back what a running ARC holds. `client` names its owner where that is not the sender."""

    id: str
    client: str | None = None


class HandOver(Message, frozen=True, tag_field="op", tag="hand_over"):
    """The sender's running ARC goes on in client `to`, under a new grant."""

    id: str
    to: str


class Foresee(Message, frozen=True, tag_field="op", tag="foresee"):
    """Asks what would come of a request, without making it. Answered with a Foresight."""

    id: str
    arc: str
    needs: dict[str, Amounts]
    priority: int
    min_runtime: Decimal
    keep: bool = False


class Foresight(Message, frozen=True):
    """What would come of a request, if nothing else came. `starts_in` is absent where it would not start as
    things stand, or not within what can be foretold; `reason` then says what it would wait for."""

    id: str
    arc: str
    starts_in: Seconds | None = None
    preempts: list[str] = []
    """Names of the ARCs that it would preempt at once."""
    reason: str = ""


Operation: TypeAlias = Ask | Cancel | Release | HandOver | Foresee


class Notice(Message, frozen=True):
    """How one request stands: the answer to an operation, and what the client is told at each change.

    Of two notices about one request the one with the greater `(term, step)` is the newer.
    """

    id: str
    arc: str
    client: str
    state: State
    term: Term
    step: int
    priority: int = 0
    reason: str = ""
    outcome: str | None = None
    """How the last hold, or the wait, came to its end."""
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
    """Seconds until its minimum runtime is over."""


# From the RCM to all


class Holder(Message, frozen=True):
    """One holder of one RC, told so fully that a new RCM can carry its ARC on from the RCs' word alone.

    `rcs` names the whole gang, `bound` the RC that meets each of its patterns. `remaining` seconds of its
    minimum runtime are left, negative where it is over; with `keep` the hold does not end then."""

    id: str
    arc: str
    client: str
    grant: Grant
    place: Place
    rcs: list[str]
    min_runtime: Decimal
    remaining: Seconds
    priority: int = 0
    keep: bool = False
    params: Amounts = {}
    bound: dict[str, str] = {}


class Revocation(Message, frozen=True):
    """A hold that is over, by name."""

    id: str
    arc: str
    client: str
    grant: Grant
    rcs: list[str]
    outcome: str
    reason: str
    by: str | None = None


class Grants(Message, frozen=True):
    """A publication of the leading RCM. For each RC touched, all its holders from now on.

    `prev` is the seq of the publication before: a receiver that heard another one has missed something.
    Without `rcs` and `revoked` it is a heartbeat; one comes at least every `every` seconds.
    """

    term: Term
    seq: int
    prev: int
    every: Seconds
    rcs: dict[str, list[Holder]] = {}
    revoked: list[Revocation] = []


# The state of the RCM


class StateAsk(Message, frozen=True):
    """Asks how things stand. `arc` (a name or an id) asks for the story of one ARC besides."""

    arc: str | None = None
    holds_only: bool = False
    forecast: bool = False
    """Whether to foretell when who waits will start."""


class HoldView(Message, frozen=True):
    """A hold in force. `held` is how long it has stood, in seconds; `needs` are by RC, `bound` the RC that
    meets each of its patterns."""

    id: str
    arc: str
    client: str
    priority: int
    grant: Grant
    place: Place
    needs: dict[str, Amounts]
    min_runtime: Decimal
    held: Seconds
    remaining: Seconds
    keep: bool = False
    bound: dict[str, str] = {}


class WaitView(Message, frozen=True):
    """An ARC in the queue, in rank order. `waited` seconds since it was last queued; `needs` as asked."""

    id: str
    arc: str
    client: str
    priority: int
    place: Place
    needs: dict[str, Amounts]
    min_runtime: Decimal
    waited: Seconds
    reason: str
    preemptions: int = 0
    starts_in: Seconds | None = None
    """An estimate, where one was asked for: as if nothing else were to come."""


class RcView(Message, frozen=True):
    rc: str
    present: bool
    sharable: bool
    holders: list[str] = []
    """Ids of the ARCs that hold it."""


class StoryLine(Message, frozen=True):
    """Something that happened to an ARC, `ago` seconds before the answer."""

    ago: Seconds
    text: str


class RcmState(Message, frozen=True):
    """What the RCM knows. `seq` is the last that it published; `more` counts queued ARCs left out."""

    term: Term
    seq: int
    host: str
    holds: list[HoldView] = []
    queue: list[WaitView] = []
    rcs: list[RcView] = []
    story: list[StoryLine] = []
    more: int = 0


# RCs


class ProposedHolder(Message, frozen=True):
    id: str
    arc: str
    client: str
    params: Amounts = {}


class Proposal(Message, frozen=True):
    """Would the RC carry exactly these holders?"""

    proposal: int
    term: Term
    holders: list[ProposedHolder]


class Ballot(Message, frozen=True):
    proposal: int
    accept: bool
    reason: str = ""


class Command(Message, frozen=True):
    """Do `do` under `grant`, unless it has waited longer than `ttl` seconds by then.

    `do` names what to do in `name`; the rest is the driver's. Every RC knows `confirm`.
    """

    grant: Grant
    do: dict[str, Any]
    ttl: float = 1.0


class Done(Message, frozen=True):
    """A command was carried out. `warming` seconds are left until the device has its full use."""

    result: Any = None
    warming: Seconds = 0.0


class RcAsk(Message, frozen=True):
    """Asks an RC for its state. With `promise`, an RC that answers obeys no lower term again."""

    promise: Term | None = None


class EndedHold(Message, frozen=True):
    """A hold that ended at the RC by itself: `why` is `time`, `lease` or `failed`."""

    id: str
    grant: Grant
    why: str


class RcState(Message, frozen=True):
    """An RC as it is. `term`, `seq`: the newest publication heard, or term promised."""

    rc: str
    host: str
    instance: str
    sharable: bool
    term: Term = NO_TERM
    seq: int = 0
    holders: list[Holder] = []
    ended: list[EndedHold] = []
    health: str = "ok"
    """`ok`, or in words what is wrong; an RC that is not ok counts as lost."""
    rules: int = 0
    """Grows when what it votes by changes: earlier votes are void."""
    leader: bool = False
    """Whether it sees a leading RCM."""
    capacity: Amounts = {}


# Clients


class OpenRequest(Message, frozen=True):
    """A request as its client knows it, for an RCM that takes the lead. `waited` as in Ask."""

    id: str
    arc: str
    needs: dict[str, Amounts]
    priority: int
    min_runtime: Decimal
    keep: bool = False
    place: Place | None = None
    waited: Elapsed = 0.0
    grant: Grant | None = None


class ClientRequests(Message, frozen=True):
    client: str
    requests: list[OpenRequest]


# Hosts


class ComponentUse(Message, frozen=True):
    """What one component uses, with all its child processes: `cpu` in cores, `memory` in bytes. `served` is
    the share of the time in which it wanted a processor that it had one; None where nobody knows."""

    component: ShortText
    kind: ShortText
    incarnation: Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNTER)]
    cpu: Figure
    memory: Bytes
    processes: Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNTER)] = 1
    served: Annotated[float, msgspec.Meta(ge=0, le=1)] | None = None


class LoadReport(Message, frozen=True):
    """A host's load. `number` counts one reporter's reports; memory in bytes, `cpu` in percent of all.

    `speed` is how fast one core does a fixed piece of work (`docs/protocol.md`), 1.0 in a millisecond;
    clocks in MHz, 0 if unknown; `temperature` in degrees Celsius."""

    host: str
    number: int
    cores: (
        Annotated[int, msgspec.Meta(gt=0, le=1_000_000)] | Annotated[float, msgspec.Meta(gt=0, le=1_000_000)]
    )
    load_average: tuple[float, float, float]
    cpu: float
    memory_available: int
    memory_total: int
    speed: Annotated[float, msgspec.Meta(ge=0.001, le=1_000)] = 1.0
    clock: Figure = 0.0
    clock_rated: Figure = 0.0
    temperature: float | None = None
    labels: Annotated[tuple[ShortText, ...], msgspec.Meta(max_length=MAX_LABELS)] = ()
    components: Annotated[tuple[ComponentUse, ...], msgspec.Meta(max_length=MAX_COMPONENTS)] = ()


# The load balancer


class RankAsk(Message, frozen=True):
    """Which host is the best for a component of this kind? Only `hosts` where given, else all that report.

    `labels` and `memory` (bytes) are what a host must have."""

    hosts: Annotated[list[str], msgspec.Meta(max_length=MAX_RANKED)] | None = None
    kind: str = ""
    metric: Metric = "composite"
    policy: Policy = "pending"
    labels: Annotated[list[str], msgspec.Meta(max_length=MAX_LABELS)] = []
    memory: Bytes = 0
    at_most: Annotated[int, msgspec.Meta(ge=1, le=MAX_RANKED)] = 16
    """How many hosts are named."""


class RankedHost(Message, frozen=True):
    """The greater `score` is the better host; `reason` says it in words."""

    host: str
    score: float
    reason: str


class HostRanking(Message, frozen=True):
    """Hosts best first, by `metric`; `why` says how that was chosen. `left_out` names hosts that can't be
    ranked, and why; as many as were asked for of either."""

    hosts: list[RankedHost]
    metric: Metric
    why: str
    left_out: dict[str, str] = {}
    more: int = 0
    """Ranked hosts that are not named."""


# Errors


class Problem(Message, frozen=True):
    """Why something was refused. `term` is the term that the answerer has promised, where that is why."""

    code: str
    message: str
    term: Term | None = None


T = TypeVar("T")
_ENCODER = msgspec.json.Encoder(decimal_format="number")
_DECODERS: dict[Any, msgspec.json.Decoder[Any]] = {}


class Malformed(ValueError):
    """A payload that is not the message it should be; says what and where."""


def absurd(term: Term, known: Term) -> bool:
    """Whether `term` is too far above `known`, the newest heard, to be believed. Who has heard of none yet
    (`NO_TERM`) believes any up to MAX_COUNTER: a fleet may be old."""
    bound = MAX_COUNTER if known == NO_TERM else min(MAX_COUNTER, known.counter + MAX_JUMP)
    return term.counter > bound


def encode(message: msgspec.Struct) -> bytes:
    return _ENCODER.encode(message)


def decode(payload: bytes, kind: type[T] | Any, limit: int = MAX_PAYLOAD) -> T:
    """`payload` as a message of `kind` (a struct, or a union of tagged ones). Raises Malformed."""
    if len(payload) > limit:
        raise Malformed(f"{len(payload)} bytes are too many; at most {limit} are taken")
    decoder = _DECODERS.get(kind)
    if decoder is None:
        decoder = _DECODERS[kind] = msgspec.json.Decoder(kind)
    try:
        message: T = decoder.decode(payload)
        if kind is Operation:
            # Of a name that stands twice the decoder takes the last. In a request that would drop a need
            # without a word; elsewhere the 6 us are not worth it.
            _ONCE.decode(payload.decode())
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise Malformed(f"not a valid {_name(kind)}: {str(error)[:MAX_ERROR]}") from None
    return message


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"{twice[:80]!r} stands more than once in one object; write it once")
    return found


_ONCE = json.JSONDecoder(object_pairs_hook=_unique, parse_int=str, parse_float=str)


def schema(kind: type) -> str:
    """The name under which a message travels in the encoding."""
    return f"zscout.{kind.__name__}.v1"


def _name(kind: Any) -> str:
    return getattr(kind, "__name__", "operation")
