"""Journals of past holds on candidates, and queries for them.

A journal outlives restarts of monotonic clocks, so it uses wall times: seconds since 1970 (UTC) by the clock of the
answering candidate, for display. Queries use durations."""

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
MAX_HISTORY_BYTES: Final = 1_000_000
"""Approximate limit for the holds of one answer."""
MAX_ASKED_NAMES: Final = 512
UNHEARD: Final = "unheard"
"""The outcome of a hold whose end the candidate did not receive: it ended at `ended` or later."""

Cursor: TypeAlias = tuple[WallTime, Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]]
"""Position at which an answer ended, meaningful only to its candidate."""
JournalName: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
GapCause: TypeAlias = Literal["off", "silent", "missed", "dropped"]


class HistoryAsk(Message, frozen=True):
    """Asks a candidate for holds in force at some time from `since` to `until` seconds ago, the latest first."""

    arc: Annotated[str, msgspec.Meta(min_length=1, max_length=200)] | None = None
    """The name or id of an ARC, or `<host>/<client>/<id>`."""
    rc: Annotated[str, msgspec.Meta(min_length=1, max_length=130)] | None = None
    """An RC, or a pattern of RCs."""
    who: Annotated[list[JournalName], msgspec.Meta(max_length=MAX_ASKED_NAMES)] = []
    """Names of users as given in Who, or hosts (certificate names) of clients; empty: all."""
    since: Elapsed | None = None
    """None: since the start of the journal."""
    until: Elapsed = 0.0
    limit: Annotated[int, msgspec.Meta(ge=1, le=MAX_PAGE)] = 200
    before: Cursor | None = None
    """`next` of the previous answer, to continue there."""


class PastHold(Message, frozen=True):
    """A hold as a candidate received it."""

    grant: Grant
    id: str
    arc: str
    client: str
    rcs: list[str]
    began: WallTime
    late: bool = False
    """True if it began before `began`: the candidate did not receive its beginning."""
    ended: WallTime | None = None
    """None if it is in force, as far as the candidate knows."""
    outcome: str = ""
    """Outcome as in a Revocation, or UNHEARD."""
    reason: str = ""
    by: ReasonParty | None = None
    """The ARC for which it was ended."""
    priority: int = 0
    min_runtime: Seconds | None = None
    waited: Elapsed | None = None
    """Seconds for which its ARC was queued before; None if unknown."""
    who: Who | None = None
    used: dict[str, Elapsed] = {}
    """Seconds for which each RC was used under the grant, as reported by the RC (see HoldUse); a missing RC is
    unknown."""
    code: str = ""
    """The code of `reason`, as in a ReasonInfo; empty if unknown or recorded by an older version."""
    own: bool = False
    """As in a ReasonInfo."""


class JournalGap(Message, frozen=True):
    """A period for which a journal is missing or incomplete.

    `off`: the candidate did not run. `silent`: it received no publications of an RCM. `missed`: at least `count`
    publications were lost on the way. `dropped`: `count` could not be stored, or stored data was damaged."""

    began: WallTime
    ended: WallTime | None
    """None while it lasts."""
    cause: GapCause
    count: int = 0


class History(Message, frozen=True):
    """A page of a candidate's journal. `now` is the time of its clock; the journal starts at `since` (absent if it is
    empty). `gaps` are the gaps in the queried period, on the first page only."""

    host: str
    now: WallTime
    since: WallTime | None = None
    holds: list[PastHold] = []
    next: Cursor | None = None
    """None on the last page."""
    gaps: list[JournalGap] = []
