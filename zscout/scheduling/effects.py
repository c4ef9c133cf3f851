"""What the RCM must do: the outputs of the core, in the order in which they must be done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

from zscout.scheduling.reason import Reason
from zscout.types import ArcId, ClientId, Grant, Ns, Params, RcName


class Outcome(StrEnum):
    """How a hold, or the wait for one, came to its end."""

    COMPLETED = "completed"
    """It had its minimum runtime."""
    PREEMPTED = "preempted"
    """Taken away by a higher priority; queued again with its place."""
    RELEASED = "released"
    """Given back by its client before the time."""
    CANCELLED = "cancelled"
    LOST = "lost"
    """An RC of the gang went away; queued again with its place."""
    CLIENT_LOST = "client_lost"
    HANDED_OVER = "handed_over"
    """It goes on in another client, under a new grant."""


@dataclass(frozen=True, slots=True)
class Propose:
    """Ask a sharable RC whether it would carry exactly these holders, by ARC, with their parameters."""

    proposal: int
    rc: RcName
    holders: Mapping[ArcId, Params]


@dataclass(frozen=True, slots=True)
class Granted:
    """All of `rcs` are the ARC's until `end`; None where it may keep them past its minimum runtime."""

    arc: ArcId
    client: ClientId
    grant: Grant
    rcs: tuple[RcName, ...]
    start: Ns
    end: Ns | None


@dataclass(frozen=True, slots=True)
class HoldEnded:
    """A hold is over. `requeued` says whether its ARC waits again; `by` is the ARC it was taken for."""

    arc: ArcId
    client: ClientId
    grant: Grant
    rcs: tuple[RcName, ...]
    outcome: Outcome
    reason: Reason
    requeued: bool
    by: ArcId | None = None


@dataclass(frozen=True, slots=True)
class Queued:
    """The ARC waits, for this reason; sent at the first wait and when the reason changes.

    `settled` is False while the RCM itself is still asking votes, so that the answer is near."""

    arc: ArcId
    client: ClientId
    reason: Reason
    settled: bool = True


@dataclass(frozen=True, slots=True)
class Dropped:
    """A waiting ARC left the queue without having run."""

    arc: ArcId
    client: ClientId
    outcome: Outcome
    reason: Reason


@dataclass(frozen=True, slots=True)
class WakeAt:
    """Send a `Tick` at this time, or earlier; a later effect replaces it. None: nothing to wait for."""

    at: Ns | None


Effect: TypeAlias = Propose | Granted | HoldEnded | Queued | Dropped | WakeAt
