"""How things stand after the core's last batch of events, as values that nobody can change anything by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from zscout.scheduling.model import ArcRequest, Hold
from zscout.scheduling.reason import Reason
from zscout.types import ArcId, Need, Ns, Params, Place, RcName


@dataclass(frozen=True, slots=True)
class ArcStatus:
    """One ARC that is queued (`hold is None`) or runs."""

    request: ArcRequest
    place: Place
    hold: Hold | None
    needs: Mapping[RcName, Params]
    """By RC: what it holds, or would hold as its patterns are bound at present."""
    bound: Mapping[Need, RcName]
    """The RC that each pattern of its needs is bound to."""
    since: Ns
    """When it was last queued or granted."""
    preemptions: int
    ahead: int | None
    """How many of the queued rank above it; None while it runs."""
    reason: Reason | None
    """Why it is queued, with all that is in its way; None while it runs."""
    reported: Reason | None
    """The reason of its latest `Queued` effect: not every change of holders far ahead of it is one."""

    @property
    def id(self) -> ArcId:
        return self.request.arc

    @property
    def name(self) -> str:
        return self.request.name


@dataclass(frozen=True, slots=True)
class RcStatus:
    """One RC; `holders` in the order in which they came to hold it."""

    name: RcName
    present: bool
    sharable: bool
    holders: tuple[ArcId, ...]


@dataclass(frozen=True, slots=True)
class Status:
    """The whole fleet: who runs, in the order in which they started; who is queued, best rank first and
    perhaps not all of the `waiting`; the RCs by name."""

    running: tuple[ArcStatus, ...]
    queued: tuple[ArcStatus, ...]
    waiting: int
    rcs: tuple[RcStatus, ...]
