"""What the scheduling core knows: requests, resource controllers (RCs) and what stands between them.

Times are whole nanoseconds on one clock of the caller's choice; nothing here reads a clock. Bandwidth
parameters are `Fraction`, so that sums are exact (0.1 + 0.2 is 0.3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import NamedTuple, TypeAlias

ArcId: TypeAlias = str
"""Names one request for as long as it lives; chosen by whoever feeds the core."""
ClientId: TypeAlias = str
"""Names the program behind requests: `<host>/<client>` on the mesh."""
RcName: TypeAlias = str
"""`kind/name` of a resource controller."""
Need: TypeAlias = str
"""What a request asks for: the name of an RC, or a pattern such as `framegrabber/*`."""
Ns: TypeAlias = int
"""Whole nanoseconds."""
Params: TypeAlias = Mapping[str, Fraction]
"""Bandwidth parameters of one ARC at one RC; only the RC knows what they mean."""

SECOND: Ns = 1_000_000_000
QUANTUM: Ns = SECOND
"""The paper's quantum: while anything waits, a pass runs at least this often."""


class Term(NamedTuple):
    """The reign of one RCM: compared by counter, then by the RCM's instance (design, section 5)."""

    counter: int
    rcm: str


NO_TERM = Term(0, "")


class Grant(NamedTuple):
    """Identity of one hold: the term it was given in and its number there. A later grant compares greater."""

    term: Term
    seq: int


class Place(NamedTuple):
    """Place in the queue: term and arrival number of the first request; the smaller goes first."""

    term: Term
    arrival: int


Rank: TypeAlias = tuple[int, Ns, Place, ArcId]
"""Sorts contenders, best first: priority (negated), minimum runtime, place, id."""


@dataclass(frozen=True, slots=True)
class Request:
    """One ARC as its client asked for it: all of `needs` at once, for at least `min_runtime` ns (> 0).

    A need names an RC, or is a pattern that any one RC meets (`keyexpr.check_need`)."""

    arc: ArcId
    client: ClientId
    needs: Mapping[Need, Params]
    priority: int
    min_runtime: Ns
    keep: bool = False
    label: str = ""
    """What people call it; the core only prints it."""

    def __post_init__(self) -> None:
        if not self.needs:
            raise ValueError(f"ARC {self.arc} needs nothing; name at least one RC")
        if self.min_runtime <= 0:
            raise ValueError(f"ARC {self.arc}: the minimum runtime must be positive")
        if any(value < 0 for params in self.needs.values() for value in params.values()):
            raise ValueError(f"ARC {self.arc}: bandwidth parameters must not be negative")

    @property
    def name(self) -> str:
        return self.label or self.arc


@dataclass(slots=True)
class Hold:
    """A grant in force. `end` is when the minimum runtime is over; with `keep` the hold goes on past it."""

    grant: Grant
    start: Ns
    end: Ns
    shield: int | None = None
    """Below this priority nobody takes it before `end`; None: any higher priority does."""


@dataclass(slots=True, eq=False)
class Arc:
    """A request the core follows, queued (`hold is None`) or running."""

    request: Request
    place: Place
    mask: int
    """Bits of the needed RCs, sharable or not (see `Floor.rc`); of a pattern, the RC that it is bound to."""
    hold: Hold | None = None
    reason: str = ""
    """Why it waits, in the words last told; empty while it runs. `Core.reason` has those of now."""
    since: Ns = 0
    """When it was last queued or granted."""
    preemptions: int = 0
    turn: int = 0
    """Grows with each entry into the queue or among the running: who came there first."""
    rcs: tuple[Rc, ...] = ()
    """Those of `mask`, in the order of the bits; set when the ARC comes to the floor."""
    id: ArcId = field(init=False)
    priority: int = field(init=False)
    rank: Rank = field(init=False)
    """Higher priority, then shorter minimum runtime, then earlier place goes first.

    Clients tell their places after a takeover, so two may claim one: the id keeps the order total."""
    watched: Rc | None = None
    """While it waits: the RC whose situation alone keeps it out; None if it has to be looked at anyway."""
    footprint: int = 0
    """What it would take or free, as bits, from a visit that came to no end."""
    hidden: int = 0
    """Where a firm obstacle lay under what was off limits at that visit, as bits."""
    asked: bool = False
    """Whether that visit waits for votes of its own."""
    band: int = 0
    """Which priorities it waits its turn with (`Policy.band`)."""
    slots: tuple[Need, ...] = ()
    """Those of its needs that are patterns."""
    named: int = 0
    """Bits of the others."""
    bound: Mapping[Need, RcName] = field(default_factory=dict)
    """The RC that each pattern is bound to (`patterns.py`): while it runs, and for the time of a visit. Empty
    if there are none to be bound to."""
    needs: Mapping[RcName, Params] = field(init=False)
    """By RC: what it holds, or would as it is bound."""
    owed: bool = False
    """Whether it has waited longer than the fleet's patience (`reservations.py`)."""

    def __post_init__(self) -> None:
        self.id, self.priority = self.request.arc, self.request.priority
        self.rank = (-self.priority, self.request.min_runtime, self.place, self.id)
        self.needs = self.request.needs

    @property
    def name(self) -> str:
        return self.request.name

    @property
    def unbound(self) -> bool:
        """Whether some pattern of its needs has no RC."""
        return bool(self.slots) and not self.bound

    def overstays(self, now: Ns) -> bool:
        """True when a kept hold has had its minimum runtime: equal priority may displace it then."""
        return self.hold is not None and self.request.keep and now >= self.hold.end

    def yields_to(self, other: Arc, now: Ns) -> bool:
        """Whether `other` may take what this running ARC holds."""
        return self.yields_at(other.priority, now)

    def yields_at(self, priority: int, now: Ns) -> bool:
        """Whether any ARC of this priority may."""
        if self.priority >= priority:
            return self.priority == priority and self.overstays(now)
        return not self.shielded(now) or (self.hold is not None and priority >= (self.hold.shield or 0))

    def shielded(self, now: Ns) -> bool:
        """Whether its hold is out of reach for some of those above it in priority."""
        return self.hold is not None and self.hold.shield is not None and now < self.hold.end


@dataclass(slots=True, eq=False)
class Rc:
    """One resource controller. `bit` is its bit in every mask, kept for as long as the core lives."""

    name: RcName
    bit: int
    present: bool = False
    sharable: bool = False
    holders: dict[ArcId, Arc] = field(default_factory=dict)
    wanted: int = 0
    """How many of the queued ARCs name it."""
    watchers: list[Rank] = field(default_factory=list)
    """Ranks of the queued ARCs that watch this RC, best first."""
