"""What candidates keep of the holds that are over, and how they are asked.

Times are the one exception to durations: a journal outlives the clocks of its hosts. They are seconds since 1970 (UTC)
by the clock of the candidate that answers, to be shown; what is asked for is told in durations."""

from __future__ import annotations

from typing import Annotated, Final, Literal, TypeAlias

import msgspec

from zscout.messages.base import Elapsed, Message, Seconds, WallTime
from zscout.messages.scheduling import ReasonParty, Who
from zscout.types import Grant

MAX_PAGE: Final = 1_000
"""Holds in one answer."""
MAX_GAPS: Final = 200
"""Gaps in one answer: the latest."""
MAX_TOLD_BYTES: Final = 1_000_000
"""About what the holds of one answer take, at most."""
MAX_ASKED_NAMES: Final = 512
UNHEARD: Final = "unheard"
"""The outcome of a hold whose end the candidate did not hear: it ended at `ended` or later."""

Cursor: TypeAlias = tuple[WallTime, Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]]
"""Where an answer ended: only its candidate knows what it means."""
JournalName: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
GapCause: TypeAlias = Literal["off", "silent", "missed", "dropped"]


class HistoryAsk(Message, frozen=True):
    """Asks a candidate for holds that stood at some time from `since` to `until` seconds ago, the latest first."""

    arc: Annotated[str, msgspec.Meta(min_length=1, max_length=200)] | None = None
    """The name or id of an ARC, or `<host>/<client>/<id>`."""
    rc: Annotated[str, msgspec.Meta(min_length=1, max_length=130)] | None = None
    """An RC, or a pattern of RCs."""
    who: Annotated[list[JournalName], msgspec.Meta(max_length=MAX_ASKED_NAMES)] = []
    """Users as they told themselves, or the hosts (names of certificates) of their clients; none: everybody."""
    since: Elapsed | None = None
    """None: as far back as the journal goes."""
    until: Elapsed = 0.0
    limit: Annotated[int, msgspec.Meta(ge=1, le=MAX_PAGE)] = 200
    before: Cursor | None = None
    """`next` of the answer before: go on there."""


class PastHold(Message, frozen=True):
    """A hold as a candidate heard of it."""

    grant: Grant
    id: str
    arc: str
    client: str
    rcs: list[str]
    began: WallTime
    late: bool = False
    """Whether it began earlier than at `began`: the candidate did not hear that."""
    ended: WallTime | None = None
    """None: it stands, as far as the candidate heard."""
    outcome: str = ""
    """How it ended, as in a Revocation, or UNHEARD."""
    reason: str = ""
    by: ReasonParty | None = None
    """The ARC that it was taken for."""
    priority: int = 0
    min_runtime: Seconds | None = None
    waited: Elapsed | None = None
    """How long its ARC was queued before, in seconds; None: not told."""
    who: Who | None = None
    used: dict[str, Elapsed] = {}
    """For how long each RC was used under it, as the RC told (see HoldUse); of one that is missing it is not known."""
    code: str = ""
    """The code of `reason`, as in a ReasonInfo; empty: not known, or kept by an older version."""
    own: bool = False
    """As in that ReasonInfo."""


class JournalGap(Message, frozen=True):
    """A time of which a journal knows nothing, or not all.

    `off`: the candidate did not run. `silent`: it heard no RCM. `missed`: publications were lost on the way, `count` or
    more. `dropped`: `count` of them could not be kept, or what was kept was damaged."""

    began: WallTime
    ended: WallTime | None
    """None: it lasts."""
    cause: GapCause
    count: int = 0


class History(Message, frozen=True):
    """A page of a candidate's journal. `now` is its clock's time; before `since` it knows nothing (absent: it knows
    nothing at all). `gaps` are those of the time that was asked for, told on the first page."""

    host: str
    now: WallTime
    since: WallTime | None = None
    holds: list[PastHold] = []
    next: Cursor | None = None
    """None: there are no more."""
    gaps: list[JournalGap] = []
