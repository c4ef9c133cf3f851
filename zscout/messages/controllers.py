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
"""Grants of which one state tells how long the RC was used under them."""
MAX_FRAME = 2_000_000
"""Bytes of one frame."""
MAX_REGIONS = 16
MAX_REGION = 64
"""Numbers of one region."""
Share: TypeAlias = Annotated[float, Meta(ge=0, le=1)]
Region: TypeAlias = Annotated[list[Share], Meta(min_length=4, max_length=MAX_REGION)]
"""x and y of each corner in turn, as shares of the picture's width and height; two corners are opposite ones of a
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
    """An action `do` under `grant`, to be refused once it has waited longer than `ttl` seconds. Under one `id` a sender
    has it carried out once, however often it arrives.

    `do` has the action in `name`; the rest is the driver's. Every RC knows `confirm`, `leaving` and `left`. Without a
    grant only what stops a robot is done, by a radio, for the node of that robot's RC."""

    do: dict[str, Any]
    grant: Grant | None = None
    ttl: float = 1.0
    id: Annotated[str, Meta(min_length=1, max_length=MAX_ID)] | None = None


class Done(Message, frozen=True):
    """A command was carried out. `warming` seconds are left until the device has its full use."""

    result: Any = None
    warming: Seconds = 0.0
    settle: Elapsed | None = None
    """To a `confirm`: the seconds that the RC settles at most once its client has said `leaving`."""


class Confirm(Message, frozen=True):
    """Asks all RCs of a process at once what each would answer to the command `confirm` under `grant`, waiting for no
    longer than `ttl` seconds."""

    grant: Grant
    rcs: Annotated[list[str], Meta(max_length=MAX_NEEDS)]
    ttl: float = 1.0


class Confirmed(Message, frozen=True):
    """How the RCs answer that are asked about and are here; of others nothing is said."""

    done: dict[str, Done] = {}
    refused: dict[str, Problem] = {}


class RcAsk(Message, frozen=True):
    """Queries the state of an RC. With `promise`, an RC that answers obeys no lower term again."""

    promise: Term | None = None
    above: str | None = None
    """The host of the candidate that asks, where it was refused for a term far above, or an RC that it sees obeys one:
    the jump is no reason to refuse it then, if its token is seen."""
    instance: str | None = None
    """That of the RC whose token led to this question: another that answers is not meant, and may not be seen."""
    ordinary: bool = False
    """Whether who does not promise answers all the same, with the term that it obeys, instead of `old_term`: an error
    travels under the key of the question, and where that has a wildcard access control lets none through."""


class EndedHold(Message, frozen=True):
    """A hold that ended at the RC by itself: `why` is `time`, `lease` or `failed`."""

    id: str
    grant: Grant
    why: str


class HoldUse(Message, frozen=True):
    """For how many `seconds` an RC was used under a grant so far: from the beginning of the first command that it
    carried out under it, or frame that it published, to the end of the last; all of the hold if that is direct. It only
    grows."""

    grant: Grant
    seconds: Elapsed = 0.0


class Unwell(Message, frozen=True):
    """Why a device does not work at present, `since` how many seconds, and how many are `left` until its RC counts as
    lost."""

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
    """`ok`, or in words what is wrong; an RC that is not ok counts as lost."""
    rules: int = 0
    """Grows when what it votes by changes: earlier votes are void."""
    leader: bool = False
    """Whether it sees a leading RCM."""
    unwell: Unwell | None = None
    """While `health` is still ok: its holders go on, and it is granted to operators only."""
    capacity: Amounts = {}
    figures: Figures = {}
    """Rates, drops, latency and the like of the device, by name; for people, they decide nothing."""
    duplicate_of: str = ""
    """For which other instance of the RC this one stands by, in words: it holds nothing and is not granted."""
    leaving: bool = False
    """Its device is in its safe state for good: another instance may be taken at once."""
    settle: Elapsed | None = None
    """Seconds that it settles at most after `leaving`; absent: it does not know how to settle."""
    parameters: Parameters | None = None
    """All bandwidth parameters that it knows; None: it does not say."""
    version: VersionText = ""
    begin_within: Elapsed | None = None
    """Seconds, at most, from a grant until it has begun, without what settles; absent: it knows nothing of `waits`."""
    used: Annotated[list[HoldUse], Meta(max_length=MAX_USES)] = []
    """Under grants that it holds, and that ended within the last half minute; of others it does not say."""


class MotionLimits(Message, frozen=True):
    """What of a camera's motion is reported."""

    ignore: Annotated[list[Region], Meta(max_length=MAX_REGIONS)] = []
    """Regions of the picture in which motion does not count."""
    min_area: Share = 0.0
    """Of the picture, in one moving thing."""
    min_duration: Elapsed = 0.0


class FrameHead(Message, frozen=True):
    """What is attached to a frame; the payload itself is the JPEG."""

    number: int
    """Of the picture since its source was opened first; a gap means that pictures were not published."""
    time: Seconds
    """When the picture was read, by a clock of the framegrabber's own: only differences mean anything."""
    width: int
    height: int
    grant: Grant | None = None
    """The hold under which it was taken; none while the framegrabber is free."""
    source: str = ""
    """The video RC to which the framegrabber is tuned, if it knows several."""
    frozen: Seconds = 0.0
    """For how long the source has sent this same picture, where it counts as frozen by that."""
    motion: MotionLimits | None = None


LIMITS[RcState] = MAX_HELD
NEWEST_COUNTS.add(RcState)
