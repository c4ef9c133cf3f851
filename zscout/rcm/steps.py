"""What goes into a step of the leader, and what comes out. Pure values.

Stimuli that the mesh, timers and bookings bring are queued; a step takes as many as make one instant of the core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from zscout import messages
from zscout.keyexpr import Sender, Token
from zscout.messages import BookingRecord, Grants, Notice, Problem
from zscout.rcm.booked import Answer, BookedDanger, Keep, Ticket
from zscout.rcm.recovery import RecoveredState
from zscout.rcm.roster import Question
from zscout.rcm.terms import Word
from zscout.scheduling.model import Effect, Event
from zscout.types import ArcId, HostName, Ns, RcName, Term


class OperationAsked(NamedTuple):
    """An operation on requests."""

    ticket: Ticket
    sender: Sender
    operation: messages.Operation


class Lead(NamedTuple):
    """The first stimulus: what a takeover found."""

    recovered: RecoveredState


class TokenSeen(NamedTuple):
    """A token of a client or an RC came or went."""

    token: Token
    alive: bool


class Reported(NamedTuple):
    """An RC's state, and its key."""

    key: str
    state: messages.RcState


class QuestionAnswered(NamedTuple):
    """The first answer to a question; neither message nor problem: there was none."""

    question: Question
    message: Any = None
    problem: Problem | None = None


class TokensFound(NamedTuple):
    """The tokens on a question's key."""

    question: Question
    tokens: Sequence[Token]


class Happened(NamedTuple):
    """Events of the core, of one instant: ballots, dates."""

    events: Sequence[Event]


class Shunned(NamedTuple):
    """An RC shows a term that is not believed: it counts as absent until then."""

    token: Token
    until: Ns


class Stalled(NamedTuple):
    """This process stalled. `fresh`: what arrived meanwhile may not be handled yet."""

    length: Ns
    ended: Ns
    fresh: bool


class Shared(NamedTuple):
    """All keepers of bookings were asked; or there is `news`: records that were not known here."""

    news: bool


class Kept(NamedTuple):
    """A record is kept, or not: `why`."""

    keep: Keep
    why: str


class Reloaded(NamedTuple):
    """The fleet file's rights changed."""


Stimulus: TypeAlias = (
    OperationAsked
    | Lead
    | TokenSeen
    | Reported
    | QuestionAnswered
    | TokensFound
    | Happened
    | Shunned
    | Stalled
    | Shared
    | Kept
    | Reloaded
)


class Proposed(NamedTuple):
    rc: RcName
    proposal: messages.Proposal


@dataclass(slots=True)
class Outbox:
    """What follows from a step, in the order in which it is carried out, nothing awaited in between."""

    at_once: list[Answer] = field(default_factory=list)
    """Answers that need no instant: refusals, and how requests stood before it."""
    higher: list[tuple[Word, Token | None]] = field(default_factory=list)
    """Terms above the own, and for an RC that is seen its token. A leader that steps down does nothing of the rest."""
    disbelieved: list[tuple[RcName, Term]] = field(default_factory=list)
    granted: list[Answer] = field(default_factory=list)
    """Answers to requests that are granted: before anybody else learns of it."""
    grant_notices: list[Notice] = field(default_factory=list)
    reopened: list[tuple[str, ArcId]] = field(default_factory=list)
    """For the trace, before the publication."""
    publication: Grants | None = None
    notices: list[Notice] = field(default_factory=list)
    answers: list[Answer] = field(default_factory=list)
    proposals: list[Proposed] = field(default_factory=list)
    questions: list[Question] = field(default_factory=list)
    suspicions: list[tuple[str, bool]] = field(default_factory=list)
    """Contradictions of the mesh, and those that are over."""
    events: Sequence[Event] = ()
    effects: Sequence[Effect] = ()
    """Of the instant, for those who count holds."""
    changed: list[BookingRecord] = field(default_factory=list)
    """Records to be shared with all keepers soon."""
    keep: list[Keep] = field(default_factory=list)
    """Those that are kept before they are answered."""
    dangers: list[BookedDanger] = field(default_factory=list)
    log: list[str] = field(default_factory=list)
    strange: list[tuple[str, str]] = field(default_factory=list)
    """Warnings, each with its subject: of one subject not too many are logged."""
    duplicates: list[tuple[RcName, HostName]] = field(default_factory=list)
    """RCs that a second host offers."""
    over: list[tuple[str, ArcId]] = field(default_factory=list)
    """For the trace."""
    wake: Ns | None = None
    """The next step is due then at the latest."""
    more: bool = False
    """Another step is due at once: stimuli are left."""
