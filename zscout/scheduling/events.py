"""What may happen to the RCM: the inputs of the core. Each carries everything the core may know about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

from zscout.keyexpr import is_pattern, matcher
from zscout.scheduling.model import ArcRequest
from zscout.types import ArcId, ClientId, Grant, Need, Ns, Place, RcName, Term


@dataclass(frozen=True, slots=True)
class Requested:
    """A program requests an ARC. `place` is set when it had one under an earlier RCM; `since` is then when it
    was last queued, on the core's clock, if that is known."""

    request: ArcRequest
    place: Place | None = None
    since: Ns | None = None


@dataclass(frozen=True, slots=True)
class Cancelled:
    """The ARC is not wanted any more, whether it waits or runs."""

    arc: ArcId
    by: str = "its client"


@dataclass(frozen=True, slots=True)
class Released:
    """A running ARC gives back what it holds; a waiting one leaves the queue."""

    arc: ArcId
    by: str = "its client"


@dataclass(frozen=True, slots=True)
class Vote:
    """A sharable RC's answer to a proposal."""

    proposal: int
    accept: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class VoteOverdue:
    """No answer to a proposal in time, or the question could not be delivered."""

    proposal: int


@dataclass(frozen=True, slots=True)
class RcJoined:
    """An RC is there and can be granted."""

    rc: RcName
    sharable: bool


@dataclass(frozen=True, slots=True)
class RcReported:
    """An RC reports that holds ended there, or that the rules it votes by have changed."""

    rc: RcName
    ended: tuple[ArcId, ...] = ()
    rules_changed: bool = False


@dataclass(frozen=True, slots=True)
class RcLost:
    """An RC is gone, or can't carry its holders any longer."""

    rc: RcName
    reason: str = "it left the mesh"


@dataclass(frozen=True, slots=True)
class ClientLost:
    """A program is gone: what it holds is free and what it asked for is forgotten."""

    client: ClientId
    reason: str = "its client left the mesh"


@dataclass(frozen=True, slots=True)
class HandedOver:
    """An ARC goes on in another client (migration), by the name `renamed`: same place; if it runs, same RCs,
    same end, new grant."""

    arc: ArcId
    to: ClientId
    renamed: ArcId


@dataclass(frozen=True, slots=True)
class RecoveredHold:
    """A hold that stood when an RCM took the lead: its grant is kept, `end` is on the core's clock."""

    request: ArcRequest
    place: Place
    grant: Grant
    start: Ns
    end: Ns
    bound: Mapping[Need, RcName] = field(default_factory=dict)
    """By each pattern of its needs: the RC that it holds."""

    def __post_init__(self) -> None:
        patterns = {need for need in self.request.needs if is_pattern(need)}
        if patterns != self.bound.keys() or not all(matcher(need)(rc) for need, rc in self.bound.items()):
            raise ValueError(f"what ARC {self.request.arc} holds for its patterns is not told, or told wrong")


class RecoveredRequest(NamedTuple):
    """A request that waited when an RCM took the lead; `since` as in `Requested`."""

    request: ArcRequest
    place: Place
    since: Ns | None = None


@dataclass(frozen=True, slots=True)
class LeadTaken:
    """This RCM leads from now on, in `term`, over the holds and the queue that stood."""

    term: Term
    standing: tuple[RecoveredHold, ...] = ()
    waiting: tuple[RecoveredRequest, ...] = ()


@dataclass(frozen=True, slots=True)
class Tick:
    """Time has passed: holds may be over, the quantum may be."""


Event: TypeAlias = (
    Requested
    | Cancelled
    | Released
    | Vote
    | VoteOverdue
    | RcJoined
    | RcReported
    | RcLost
    | ClientLost
    | HandedOver
    | LeadTaken
    | Tick
)
