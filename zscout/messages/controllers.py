"""Votes, commands and states of RCs, and the heads of frames."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

from msgspec import Meta

from zscout.messages.base import (
    LIMITS,
    MAX_HELD,
    MAX_NEEDS,
    NEWEST_COUNTS,
    Amounts,
    Elapsed,
    Message,
    Problem,
    Seconds,
    VersionText,
)
from zscout.messages.scheduling import Holder, Parameters
from zscout.types import NO_TERM, Grant, Term

MAX_FIGURES = 32
MAX_ID = 64
"""Characters of a command's id."""
MAX_USES = 256
"""Grants whose use is reported in one state."""
MAX_FRAME = 2_000_000
"""Bytes of one frame."""
MAX_REGIONS = 16
MAX_REGION = 64
"""Numbers of one region."""
Share: TypeAlias = Annotated[float, Meta(ge=0, le=1)]
Region: TypeAlias = Annotated[list[Share], Meta(min_length=4, max_length=MAX_REGION)]
"""x and y of each corner in turn, as shares of the picture's width and height; two corners are opposite corners of a
rectangle."""
Figures: TypeAlias = Annotated[dict[str, float], Meta(max_length=MAX_FIGURES)]


class ProposedHolder(Message, frozen=True):
    id: str
    arc: str
    client: str
    params: Amounts = {}


class Proposal(Message, frozen=True):
    """Asks an RC to vote on whether it would carry exactly these holders."""

    proposal: int
    term: Term
    holders: list[ProposedHolder]


class Ballot(Message, frozen=True):
    proposal: int
    accept: bool
    reason: str = ""


class Command(Message, frozen=True):
    """An action `do` under `grant`, refused if it has waited longer than `ttl` seconds. Commands of one sender with the
    same `id` are carried out only once.

    `do` has the action in `name`; its other fields are defined by the driver. Every RC knows `confirm`, `leaving` and
    `left`. Without a grant, a radio only stops a robot, for the node of the robot's RC."""

    do: dict[str, Any]
    grant: Grant | None = None
    ttl: float = 1.0
    id: Annotated[str, Meta(min_length=1, max_length=MAX_ID)] | None = None


class Done(Message, frozen=True):
    """A command was carried out. `warming`: seconds until the device is fully usable."""

    result: Any = None
    warming: Seconds = 0.0
    settle: Elapsed | None = None
    """In an answer to `confirm`: for how many seconds, at most, the RC settles after `leaving`."""


class Confirm(Message, frozen=True):
    """Sends the command `confirm` under `grant` to several RCs of a process at once; the answer takes at most `ttl`
    seconds."""

    grant: Grant
    rcs: Annotated[list[str], Meta(max_length=MAX_NEEDS)]
    ttl: float = 1.0


class Confirmed(Message, frozen=True):
    """The answers of those queried RCs that are in this process."""

    done: dict[str, Done] = {}
    refused: dict[str, Problem] = {}


class RcAsk(Message, frozen=True):
    """Queries the state of an RC. With `promise`, an RC that answers never obeys a lower term again."""

    promise: Term | None = None
    above: str | None = None
    """Host of the asking candidate, if it was refused because of a far higher term, or sees an RC that obeys one: then
    an RC that sees the candidate's token accepts the jump."""
    instance: str | None = None
    """Instance of the RC whose token caused this query: another instance that answers is not meant, and its token may
    not be visible."""
    ordinary: bool = False
    """A process that refuses the promise answers with its state and the term that it obeys, instead of `old_term`: an
    error is sent under the key of the query, and access control blocks errors under a wildcard key."""


class EndedHold(Message, frozen=True):
    """A hold that the RC ended: `why` is `time`, `lease` or `failed`."""

    id: str
    grant: Grant
    why: str


class HoldUse(Message, frozen=True):
    """For how many `seconds` an RC was used under a grant so far: from the start of the first command carried out, or
    frame published, to the end of the last; the whole hold if it is direct. The value never decreases."""

    grant: Grant
    seconds: Elapsed = 0.0


class Unwell(Message, frozen=True):
    """Why a device does not work at present, for how many seconds (`since`), and how many are `left` until its RC
    counts as lost."""

    why: str
    since: Elapsed
    left: Elapsed


class RcState(Message, frozen=True):
    """The state of an RC. `term`, `seq`: the newest publication received, or term promised."""

    rc: str
    host: str
    instance: str
    sharable: bool
    term: Term = NO_TERM
    seq: int = 0
    holders: list[Holder] = []
    ended: list[EndedHold] = []
    health: str = "ok"
    """`ok`, or the fault in words; an RC that is not ok counts as lost."""
    rules: int = 0
    """Grows when the rules change by which the RC votes: earlier votes are void."""
    leader: bool = False
    """The RC sees a leading RCM."""
    unwell: Unwell | None = None
    """Present while `health` is still `ok`: its holders continue, and it is granted only to operators."""
    capacity: Amounts = {}
    figures: Figures = {}
    """Rates, drops, latency and the like of the device, by name; only displayed."""
    duplicate_of: str = ""
    """Names the instance for which this instance is on standby: it holds nothing and is not granted."""
    leaving: bool = False
    """The RC ends, with its device in the safe state: another instance may be used at once."""
    settle: Elapsed | None = None
    """Seconds for which the RC settles, at most, after `leaving`; absent if it does not support settling."""
    parameters: Parameters | None = None
    """All bandwidth parameters that the RC knows; None if it does not list them."""
    version: VersionText = ""
    begin_within: Elapsed | None = None
    """Seconds, at most, from a grant until the device has begun, not counting settling; absent if the RC does not
    support `waits`."""
    used: Annotated[list[HoldUse], Meta(max_length=MAX_USES)] = []
    """Use under grants that it holds, and grants that ended within the last half minute."""


class MotionLimits(Message, frozen=True):
    """Which motion of a camera is reported."""

    ignore: Annotated[list[Region], Meta(max_length=MAX_REGIONS)] = []
    """Regions of the picture in which motion is ignored."""
    min_area: Share = 0.0
    """Smallest share of the picture that a moving object covers."""
    min_duration: Elapsed = 0.0


class FrameHead(Message, frozen=True):
    """The attachment of a frame, whose payload is the JPEG."""

    number: int
    """Number of the picture since the source was first opened; a gap means that pictures were not published."""
    time: Seconds
    """Time at which the picture was read, by the framegrabber's own clock: only differences are meaningful."""
    width: int
    height: int
    grant: Grant | None = None
    """The hold under which it was taken; None while the framegrabber is free."""
    source: str = ""
    """The video RC to which the framegrabber is tuned, if it knows several."""
    frozen: Seconds = 0.0
    """Seconds for which the source has sent this same picture; 0 unless it counts as frozen."""
    motion: MotionLimits | None = None


LIMITS[RcState] = MAX_HELD
NEWEST_COUNTS.add(RcState)
