"""Digest of an instant (not of files): translates the core's events and effects in one term to beginnings and ends of
holds, for figures and notices to people. It runs once all answers of an instant are sent."""

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
    """The time since it was last queued; None: it continues from another RCM or client."""
    late: Ns | None
    """The delay compared with the first estimate sent to its client; None: no estimate was sent."""


class Over(NamedTuple):
    """`outcome` and `reason` are None if the hold continues under another RCM."""

    began: Began
    at: Ns
    outcome: Outcome | None
    reason: Reason | None
    requeued: bool


class HoldListener(Protocol):
    """Called in the RCM's event loop: it must not block."""

    def on_began(self, began: Began) -> None: ...

    def on_over(self, over: Over) -> None: ...

    def on_unwell(self, rc: RcName, why: str, holders: Sequence[ArcRequest]) -> None:
        """An RC became unwell, or (empty) is well again."""
        ...


class HoldDigest:
    """The digest of one term of `core`. Errors in it, or in a listener, end the digest and nothing else."""

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
        """Digest one instant. `estimates`: the first estimated starts that clients were notified of."""
        try:
            self._take(now, events, effects, estimates)
        except Exception:
            log.exception("figures and notices of holds failed: disabled for this term")
            self._listeners = ()

    def close(self, now: Ns) -> None:
        """This RCM no longer leads: all holds continue elsewhere."""
        effects = [Over(began, now, None, None, requeued=False) for began in self._held.values()]
        self._held.clear()
        try:
            for over in effects:
                self._notify_over(over)
        except Exception:
            log.exception("figures and notices failed for holds that continue under the next leader")

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
                        self._notify_over(Over(began, now, outcome, reason, requeued))
        for arc in recovered:
            # The core yields no effect for recovered holds that continue unchanged.
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

    def _notify_over(self, over: Over) -> None:
        for listener in self._listeners:
            listener.on_over(over)
