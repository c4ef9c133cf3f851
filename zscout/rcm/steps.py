"""What goes into a step of the leader, and what comes out. Pure values.

Stimuli that the mesh, timers and bookings bring are queued; a step takes as many as make one instant of the core. The
names in them were checked as they came in, those within holds and requests are checked where these enter."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum, auto
from operator import attrgetter
from typing import Any, Final, NamedTuple, TypeAlias

from msgspec import Struct

from zscout.keyexpr import Sender, Token
from zscout.messages import (
    BookingRecord,
    ClientRequests,
    Grants,
    Instant,
    Notice,
    Operation,
    Problem,
    Proposal,
    RcAsk,
    RcState,
)
from zscout.rcm.recovery import RecoveredState
from zscout.rcm.terms import Word
from zscout.scheduling.model import Effect, Event
from zscout.types import ArcId, ClientId, HostName, Ns, RcName, Term

Ticket: TypeAlias = int
"""The number of a query that waits for its answer."""
Answer: TypeAlias = tuple[Ticket, Struct]


class BookedDanger(NamedTuple):
    """A date of a booking may not be kept, and why; empty: it is safe again. `over`: it is not kept."""

    record: BookingRecord
    start: Instant
    why: str
    later: int = 0
    """Dates after that of which the same is to be reported."""
    over: bool = False


class Keep(NamedTuple):
    """Answer once a record is kept; `withdraw`: forget it where it can't be."""

    ticket: Ticket
    booking: str
    withdraw: bool


class Question(NamedTuple):
    """A question to the mesh. The first answer, or none within `timeout` seconds, becomes a `QuestionAnswered`; the
    tokens on `key`, where `kind` is None, `TokensFound`."""

    why: Why
    key: str
    timeout: float
    message: RcAsk = RcAsk()
    kind: type[Struct] | None = None
    token: Token | None = None
    client: ClientId = ""
    number: int = 0
    """The client's deadline, or the caller's number of `seek`."""


class Why(Enum):
    PROMISE = "an RC's promise to obey this term"
    RETURN = "the state of an RC whose token is back"
    REQUESTS = "the requests of a client"
    OVERDUE = "a client without a token may answer all the same"
    SOUGHT = "the new client of a hand-over"
    PROBE = "a client or RC whose token disappeared: an answer shows that the mesh contradicts itself"
    WITNESS = "any other host: an answer shows that this leader is not away"


class OperationAsked(NamedTuple):
    """An operation on requests."""

    ticket: Ticket
    sender: Sender
    operation: Operation


class Lead(NamedTuple):
    """The first stimulus: what a takeover found."""

    recovered: RecoveredState


class TokenSeen(NamedTuple):
    """A token of a client or an RC came or went."""

    token: Token
    alive: bool


class Reported(NamedTuple):
    """An RC's state, on its own key."""

    state: RcState


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
    """Keepers of bookings have records that were not known here."""


class ClocksRead(NamedTuple):
    """All keepers were asked, and this was so at `at`."""

    at: Ns
    heard: tuple[float, Ns] | None
    """The oldest fleet time that others have heard, in ns since 1970, and for how many seconds it has gone on."""
    walls: Mapping[HostName, Ns]
    """What hosts' clocks say, likewise."""
    kept: frozenset[HostName]
    """The hosts whose clocks are kept by a time service."""


class Kept(NamedTuple):
    """A record is kept, or not: `why`."""

    keep: Keep
    why: str


class Reloaded(NamedTuple):
    """The fleet file's rights changed."""


class Compare(NamedTuple):
    """An RC that counts as present reports its holds: the core is to agree."""

    state: RcState


class Name(NamedTuple):
    """Publish this RC, so that its instances learn which one is meant."""

    rc: RcName


class ClientListed(NamedTuple):
    answer: ClientRequests


class ClientFound(NamedTuple):
    """By number of `Roster.seek`: whether the client has a token."""

    number: int
    there: bool


class Resume(NamedTuple):
    """RCs are no longer pending."""


class Again(NamedTuple):
    """An operation on bookings whose votes were not all known is tried once more."""

    undecided: Any


class BookingAsked(NamedTuple):
    """An operation on bookings, once the core is at the present time."""

    asked: OperationAsked


class Due(Enum):
    DEADLINES = auto()
    TIME = auto()
    """The core's time is over; reasons and lines of the log may be due."""
    BOOKINGS = auto()


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
    | ClocksRead
    | Kept
    | Reloaded
    | Compare
    | Name
    | ClientListed
    | ClientFound
    | Resume
    | Again
    | BookingAsked
    | Due
)


class Proposed(NamedTuple):
    rc: RcName
    proposal: Proposal


class Outbox(Struct):
    """What follows from a step, in the order in which it is carried out, nothing awaited in between. Each part of the
    leader returns its share, with the events that are to be decided, and the stimuli of the next instants."""

    at_once: list[Answer] = []
    """Answers that need no instant: refusals, and how requests stood before it."""
    higher: list[tuple[Word, Token | None]] = []
    """Terms above the own, and for an RC that is seen its token. A leader that steps down does nothing of the rest."""
    disbelieved: list[tuple[RcName, Term]] = []
    granted: list[Answer] = []
    """Answers to requests that are granted: before anybody else learns of it."""
    grant_notices: list[Notice] = []
    reopened: list[tuple[str, ArcId]] = []
    """For the trace, before the publication."""
    publication: Grants | None = None
    notices: list[Notice] = []
    answers: list[Answer] = []
    proposals: list[Proposed] = []
    questions: list[Question] = []
    suspicions: list[tuple[str, bool]] = []
    """Contradictions of the mesh, and those that are over."""
    events: list[Event] = []
    effects: Sequence[Effect] = ()
    """Of the instant, for those who count holds."""
    changed: list[BookingRecord] = []
    """Records to be shared with all keepers soon."""
    keep: list[Keep] = []
    """Those that are kept before they are answered."""
    dangers: list[BookedDanger] = []
    drained: list[frozenset[HostName]] = []
    """The hosts in maintenance, if they have changed; the last counts."""
    log: list[str] = []
    strange: list[tuple[str, str]] = []
    """Warnings, each with its subject: of one subject not too many are logged."""
    duplicates: list[tuple[RcName, HostName]] = []
    """RCs that a second host offers."""
    over: list[tuple[str, ArcId]] = []
    """For the trace."""
    then: list[Stimulus] = []
    """Each an instant of its own, after this one and before those that wait: the leader takes them itself."""
    wake: Ns | None = None
    """The next step is due then at the latest."""
    more: bool = False
    """Another step is due at once: stimuli are left."""
    last: bool = True
    """Whether it ends the instant: before it come its answers, and its publication."""

    def take(self, names: Iterable[str]) -> Outbox:
        """Take these fields out, as a part of its own."""
        part = Outbox(last=False)
        for name in names:
            setattr(part, name, getattr(self, name))
            setattr(self, name, None if name == "publication" else [])
        return part

    def merge(self, part: Outbox) -> list[Event]:
        """Take over all that a part lists. Its events are returned: they are to be decided."""
        if part == _NOTHING:
            return []
        for own, more in zip(_lists_of(self), _lists_of(part), strict=True):
            if more:
                own.extend(more)
        return part.events


ANSWERS: Final = ("at_once", "higher", "disbelieved", "granted", "grant_notices")
PUBLISHED: Final = ("reopened", "publication")
_NOTHING: Final = Outbox()
_lists_of: Final[Callable[[Outbox], tuple[list[Any], ...]]] = attrgetter(
    *(name for name in Outbox.__struct_fields__ if name != "events" and isinstance(getattr(Outbox(), name), list))
)
