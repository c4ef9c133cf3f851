"""What became of holds in one term, for who counts it or tells people: the core's events and effects as beginnings and
ends of holds. It is worked out once all answers of an instant are sent."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple, Protocol

from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    ArcRequest,
    Effect,
    Event,
    Granted,
    HoldEnded,
    LeadTaken,
    Outcome,
    RcJoined,
    RcLost,
    RcUnwell,
)
from zscout.scheduling.reason import Reason
from zscout.types import ArcId, Ns, RcName

log = logging.getLogger(__name__)


class Began(NamedTuple):
    """A hold began here, `at` this time on the host's clock."""

    request: ArcRequest
    rcs: tuple[RcName, ...]
    at: Ns
    waited: Ns | None
    """Since it was last queued; None: it goes on, from another RCM or client."""
    late: Ns | None
    """By how much it starts later than its client was told first; None: that was told nothing."""


class Over(NamedTuple):
    """That hold is over. `outcome` and `reason` are None where it goes on, under another RCM."""

    began: Began
    at: Ns
    outcome: Outcome | None
    reason: Reason | None
    requeued: bool


class HoldListener(Protocol):
    """Is told in the RCM's event loop: it must not block."""

    def on_began(self, began: Began) -> None: ...

    def on_over(self, over: Over) -> None: ...

    def on_unwell(self, rc: RcName, why: str, holders: Sequence[ArcRequest]) -> None:
        """An RC became unwell, or (empty) is well again."""
        ...


class HoldDigest:
    """Of one term of `core`. Its own faults, and its listeners', end it and nothing else."""

    def __init__(self, core: Core, listeners: Sequence[HoldListener]) -> None:
        self._core, self._listeners = core, listeners
        self._held: dict[ArcId, Began] = {}
        self._unwell: set[RcName] = set()

    def take(
        self,
        now: Ns,
        events: Iterable[Event],
        effects: Iterable[Effect],
        estimates: Mapping[ArcId, Ns] = MappingProxyType({}),
    ) -> None:
        """What happened in one instant, in its order. `foretold`: the starts that clients were notified of first."""
        try:
            self._take(now, events, effects, estimates)
        except Exception:
            log.exception("holds are neither counted nor told of any more in this term")
            self._listeners = ()

    def close(self, now: Ns) -> None:
        """This RCM does not lead any more: what is held goes on."""
        effects = [Over(began, now, None, None, requeued=False) for began in self._held.values()]
        self._held.clear()
        try:
            for over in effects:
                self._tell_over(over)
        except Exception:
            log.exception("holds that go on were not counted")

    def _take(self, now: Ns, events: Iterable[Event], effects: Iterable[Effect], estimates: Mapping[ArcId, Ns]) -> None:
        recovered: list[ArcId] = []
        for event in events:
            match event:
                case LeadTaken(recovered_holds=holds):
                    recovered += (held.request.arc for held in holds)
                case RcJoined() | RcLost():
                    self._unwell.discard(event.rc)
                    if isinstance(event, RcJoined) and event.unwell:
                        self._unwell.add(event.rc)
                case RcUnwell(rc, why) if bool(why) is not (rc in self._unwell):
                    (self._unwell.add if why else self._unwell.discard)(rc)
                    holders = [status.request for status in self._core.holders(rc)]
                    for listener in self._listeners:
                        listener.on_unwell(rc, why, holders)
        for effect in effects:
            match effect:
                case Granted(arc=arc, waited=waited):
                    start = estimates.get(arc)
                    self._begin(arc, now, waited, None if start is None or waited is None else now - start)
                case HoldEnded(arc=arc, outcome=outcome, reason=reason, requeued=requeued):
                    if (began := self._held.pop(arc, None)) is not None:
                        self._tell_over(Over(began, now, outcome, reason, requeued))
        for arc in recovered:
            # The core says no word of what goes on as it is.
            if arc not in self._held and self._core.is_running(arc):
                self._begin(arc, now)

    def _begin(self, arc: ArcId, now: Ns, waited: Ns | None = None, late: Ns | None = None) -> None:
        status = self._core.arc(arc)
        if status is None:
            return  # over within the same instant
        began = Began(status.request, tuple(sorted(status.needs)), now, waited, late)
        self._held[arc] = began
        for listener in self._listeners:
            listener.on_began(began)

    def _tell_over(self, over: Over) -> None:
        for listener in self._listeners:
            listener.on_over(over)
