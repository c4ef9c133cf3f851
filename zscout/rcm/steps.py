"""Input and output of the leader's steps: stimuli and the Outbox. Pure values.

Stimuli from the mesh, timers and bookings are queued; a step takes as many as fit in one instant of the core. Their
names are checked on arrival; names within holds and requests are checked at admission."""

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
    """The reason that a date of a booking may not be kept; empty: it is safe again. `over`: the date was not kept."""

    record: BookingRecord
    start: Instant
    why: str
    later: int = 0
    """The number of later dates in the same danger."""
    over: bool = False


class Keep(NamedTuple):
    """Have keepers store a record, then answer; `withdraw`: remove the record if storing fails."""

    ticket: Ticket
    booking: str
    withdraw: bool


class Question(NamedTuple):
    """A question to the mesh; its first answer, or none in `timeout` seconds, becomes a `QuestionAnswered`. Without
    `kind` it asks for the tokens on `key`, for a `TokensFound`."""

    purpose: Purpose
    key: str
    timeout: float
    message: RcAsk = RcAsk()
    kind: type[Struct] | None = None
    token: Token | None = None
    client: ClientId = ""
    number: int = 0
    """The client's deadline, or the number of `Roster.find_client`."""


class Purpose(Enum):
    PROMISE = "an RC's promise to obey this term"
    RETURN = "the state of an RC whose token is back"
    REQUESTS = "the requests of a client"
    OVERDUE = "a client without a token may answer all the same"
    FIND_CLIENT = "the new client of a hand-over"
    PROBE = "a client or RC whose token disappeared: an answer shows that the mesh contradicts itself"
    WITNESS = "any other host: an answer shows that this leader is not away"


class OperationAsked(NamedTuple):
    ticket: Ticket
    sender: Sender
    operation: Operation


class Lead(NamedTuple):
    """The first stimulus: begin the term with the results of the takeover."""

    recovered: RecoveredState


class TokenSeen(NamedTuple):
    """A token of a client or an RC appeared or disappeared."""

    token: Token
    alive: bool


class Reported(NamedTuple):
    state: RcState


class QuestionAnswered(NamedTuple):
    """The first answer to a question; without message and problem: no answer in time."""

    question: Question
    message: Any = None
    problem: Problem | None = None


class TokensFound(NamedTuple):
    question: Question
    tokens: Sequence[Token]


class CoreEvents(NamedTuple):
    """Events of one instant for the core: ballots, dates."""

    events: Sequence[Event]


class Shunned(NamedTuple):
    """An RC shows a term that is not believed: it counts as absent until `until`."""

    token: Token
    until: Ns


class Stalled(NamedTuple):
    """This process stalled. `fresh`: messages that arrived meanwhile may not be handled yet."""

    length: Ns
    ended: Ns
    fresh: bool


class Shared(NamedTuple):
    """Keepers of bookings sent records that were unknown here."""


class ClocksRead(NamedTuple):
    """The clocks of all keepers, as of `at`."""

    at: Ns
    heard: tuple[float, Ns] | None
    """The fleet time that has run longest at any keeper: seconds that it has run, and ns since 1970."""
    walls: Mapping[HostName, Ns]
    """The wall clock of each host, in ns since 1970."""
    kept: frozenset[HostName]
    """Hosts whose clocks a time service synchronises."""


class Kept(NamedTuple):
    """A record is stored; or not, for the reason `why`."""

    keep: Keep
    why: str


class Reloaded(NamedTuple):
    """The fleet file's rights changed."""


class Compare(NamedTuple):
    """Compare the holds that a present RC reports with the core's."""

    state: RcState


class Name(NamedTuple):
    """Publish this RC with its named instance, so that its instances learn which of them serves."""

    rc: RcName


class ClientListed(NamedTuple):
    answer: ClientRequests


class ClientFound(NamedTuple):
    """The result of `Roster.find_client` with this number: `there` is True if the client has a token."""

    number: int
    there: bool


class Resume(NamedTuple):
    """RCs are no longer pending."""


class RetryBooking(NamedTuple):
    """Retry an operation on bookings that waited for votes."""

    undecided: Any


class BookingAsked(NamedTuple):
    """An operation on bookings, once the core is at the present time."""

    asked: OperationAsked


class Due(Enum):
    DEADLINES = auto()
    TIME = auto()
    """The core's own deadline, notices of reasons, and lines of the log may be due."""
    BOOKINGS = auto()


Stimulus: TypeAlias = (
    OperationAsked
    | Lead
    | TokenSeen
    | Reported
    | QuestionAnswered
    | TokensFound
    | CoreEvents
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
    | RetryBooking
    | BookingAsked
    | Due
)


class Proposed(NamedTuple):
    rc: RcName
    proposal: Proposal


class Outbox(Struct):
    """The results of a step, carried out in the order of the fields, without awaiting in between. Each part of the
    leader returns one, with events for the core and stimuli for the next instants."""

    at_once: list[Answer] = []
    """Answers that need no decision: refusals, and states of requests before the instant."""
    higher: list[tuple[Word, Token | None]] = []
    """Terms above this leader's, each with the token of the RC that showed it, if one did. A leader that steps down
    for one carries out nothing more."""
    disbelieved: list[tuple[RcName, Term]] = []
    granted: list[Answer] = []
    """Answers to granted requests, sent before the publication."""
    grant_notices: list[Notice] = []
    reopened: list[tuple[str, ArcId]] = []
    """Lines for the trace, written before the publication."""
    publication: Grants | None = None
    notices: list[Notice] = []
    answers: list[Answer] = []
    proposals: list[Proposed] = []
    questions: list[Question] = []
    suspicions: list[tuple[str, bool]] = []
    """Contradictions of the mesh: True if it began, False if it is over."""
    events: list[Event] = []
    effects: Sequence[Effect] = ()
    """The effects of the instant, for figures and notices about holds."""
    changed: list[BookingRecord] = []
    """Records to share with all keepers soon."""
    keep: list[Keep] = []
    """Records that must be stored before their operation is answered."""
    dangers: list[BookedDanger] = []
    drained: list[frozenset[HostName]] = []
    """The hosts in maintenance, if they have changed; the last entry counts."""
    log: list[str] = []
    strange: list[tuple[str, str]] = []
    """Warnings, each with its subject: the number logged per subject is bounded."""
    duplicates: list[tuple[RcName, HostName]] = []
    """RCs that a second host offers."""
    over: list[tuple[str, ArcId]] = []
    """Lines for the trace, written at the end."""
    then: list[Stimulus] = []
    """Stimuli of later instants: the leader takes them itself, before all that are queued."""
    wake: Ns | None = None
    """The time at which the next step is due at the latest."""
    more: bool = False
    """True if stimuli are left: the next step is due at once."""
    last: bool = True
    """False for the parts of an instant with its first answers and its publication."""

    def take(self, names: Iterable[str]) -> Outbox:
        part = Outbox(last=False)
        for name in names:
            setattr(part, name, getattr(self, name))
            setattr(self, name, None if name == "publication" else [])
        return part

    def merge(self, part: Outbox) -> list[Event]:
        """Append the lists of `part`, and return its events, for the core."""
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
