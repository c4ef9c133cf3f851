"""What became of holds in one term, for who counts it or tells people: the core's events and effects as beginnings and
ends of holds. It is worked out once all answers of an instant are sent."""

from __future__ import annotations

import logging
from collections.abc import Callable, Container, Iterable, Sequence
from typing import NamedTuple, Protocol

from msgspec.structs import replace

from zscout.scheduling.model import (
    Adopted,
    ArcRequest,
    Dropped,
    Effect,
    Event,
    Granted,
    HandedOver,
    HoldEnded,
    LeadTaken,
    Outcome,
    RecoveredHold,
    Requested,
)
from zscout.scheduling.reason import Reason
from zscout.types import ArcId, ClientId, Ns, RcName

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


class _Wait(NamedTuple):
    request: ArcRequest
    since: Ns | None
    """None: what follows is no grant after a wait."""


class HoldDigest:
    """Of one term. Its own faults, and its listeners', end it and nothing else."""

    def __init__(self, is_running: Callable[[ArcId], bool], listeners: Sequence[HoldListener]) -> None:
        self._is_running, self._listeners = is_running, listeners
        self._waiting: dict[ArcId, _Wait] = {}
        self._foretold: dict[ArcId, Ns] = {}
        self._held: dict[ArcId, Began] = {}

    def foretell(self, arc: ArcId, start: Ns) -> None:
        """Its client is told that `arc` will start at `start`."""
        if arc in self._waiting:
            self._foretold.setdefault(arc, start)

    def take(self, now: Ns, events: Iterable[Event], effects: Iterable[Effect]) -> None:
        """What happened in one instant, in its order."""
        try:
            self._take(now, events, effects)
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

    def _take(self, now: Ns, events: Iterable[Event], effects: Iterable[Effect]) -> None:
        goes_on: dict[ArcId, Sequence[RcName]] = {}
        for event in events:
            match event:
                case Requested():
                    self._enter(now, event)
                case LeadTaken(recovered_holds=holds, waiting=waiting):
                    for held in holds:
                        self._recover(held, goes_on)
                    for asked in waiting:
                        self._enter(now, asked)
                case Adopted(held):
                    self._recover(held, goes_on)
                case HandedOver(arc, to, renamed):
                    self._rename(arc, to, renamed, goes_on)
        for effect in effects:
            self._apply(now, effect, goes_on)
        for arc, rcs in goes_on.items():
            # The core says no word of what goes on as it is.
            wait = self._waiting.get(arc)
            if wait is not None and wait.since is None:
                del self._waiting[arc]
                if self._is_running(arc) and arc not in self._held:
                    self._tell_began(Began(wait.request, tuple(sorted(rcs)), now, None, None))

    def _enter(self, now: Ns, asked: Requested) -> None:
        since = now if asked.since is None else min(asked.since, now)
        self._waiting.setdefault(asked.request.arc, _Wait(asked.request, since))

    def _recover(self, held: RecoveredHold, goes_on: dict[ArcId, Sequence[RcName]]) -> None:
        self._waiting.setdefault(held.request.arc, _Wait(held.request, None))
        goes_on[held.request.arc] = held.rcs

    def _rename(self, arc: ArcId, to: ClientId, renamed: ArcId, goes_on: dict[ArcId, Sequence[RcName]]) -> None:
        wait, began = self._waiting.get(arc), self._held.get(arc)
        if began is not None:
            self._waiting.setdefault(renamed, _Wait(replace(began.request, arc=renamed, client=to), None))
            goes_on[renamed] = began.rcs
        elif wait is not None:
            self._waiting.setdefault(renamed, _Wait(replace(wait.request, arc=renamed, client=to), wait.since))
            if arc in self._foretold:
                self._foretold.setdefault(renamed, self._foretold[arc])

    def _apply(self, now: Ns, effect: Effect, goes_on: Container[ArcId]) -> None:
        match effect:
            case Granted(arc=arc, rcs=rcs):
                start, wait = self._foretold.pop(arc, None), self._waiting.pop(arc, None)
                if wait is not None:
                    waited = None if wait.since is None or arc in goes_on else now - wait.since
                    late = None if start is None or waited is None else now - start
                    self._tell_began(Began(wait.request, rcs, now, waited, late))
            case HoldEnded(arc=arc, outcome=outcome, reason=reason, requeued=requeued):
                began, wait = self._held.pop(arc, None), self._waiting.pop(arc, None)
                if began is not None:
                    self._tell_over(Over(began, now, outcome, reason, requeued))
                known = began or wait
                if requeued and known is not None:
                    self._waiting[arc] = _Wait(known.request, now)
            case Dropped(arc=arc):
                self._waiting.pop(arc, None)
                self._foretold.pop(arc, None)

    def _tell_began(self, began: Began) -> None:
        self._held[began.request.arc] = began
        for listener in self._listeners:
            listener.on_began(began)

    def _tell_over(self, over: Over) -> None:
        for listener in self._listeners:
            listener.on_over(over)
