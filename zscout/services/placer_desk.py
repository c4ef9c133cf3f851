"""The placer's desk: operations come in, and are answered when they have come to their end, or when whoever
asked has waited long enough."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, TypeAlias

import msgspec

from zscout.keyexpr import check_name
from zscout.mesh import Refused, Request
from zscout.messages import (
    MAX_PARAMS_SIZE,
    ComponentSpec,
    DrainHost,
    EndComponent,
    ListPlacements,
    MigrateComponent,
    PlaceComponent,
    Placements,
    PlacerOperation,
    UncordonHost,
)
from zscout.placing.events import (
    DrainAsked,
    Event,
    MoveAsked,
    PlaceAsked,
    Record,
    State,
    StopAsked,
    UncordonAsked,
)
from zscout.placing.events import Refused as RefusedByCore
from zscout.placing.placer import Placer
from zscout.scheduling.model import Term
from zscout.services.placements import placement_of, spec_of

MAX_WAIT: Final = 60.0
MAX_WAITING: Final = 1_000
"""Operations that wait for their answer at one time."""

Lasting: TypeAlias = PlaceComponent | EndComponent | MigrateComponent
"""Operations that take their time."""
ENDS: Final[dict[type, frozenset[State]]] = {
    PlaceComponent: frozenset({"running", "given_up", "ended", "waiting"}),
    EndComponent: frozenset({"ended", "given_up"}),
    MigrateComponent: frozenset({"running", "given_up", "ended", "waiting"}),
}
"""The states in which they are answered."""


@dataclass(slots=True, eq=False)
class _Asker:
    """Somebody who waits for the end of an operation; `before` is the record when it came."""

    request: Request[PlacerOperation]
    operation: Lasting
    before: Record | None
    timer: asyncio.TimerHandle | None = None


class PlacerDesk:
    """Takes operations once it is open. `feed` gives the core an event and returns what the core refused."""

    def __init__(self, core: Placer, term: Term, feed: Callable[[Event], list[RefusedByCore]]) -> None:
        self.core, self.term, self._feed = core, term, feed
        self._open = False
        self._early: list[Request[PlacerOperation]] = []
        self._askers: dict[str, list[_Asker]] = {}

    def open(self) -> None:
        """From now on operations are carried out; those that came before now are the first."""
        self._open = True
        early, self._early = self._early, []
        for request in early:
            try:
                self.on_operation(request)
            except Refused as refused:
                request.refuse(refused.problem)

    def close(self) -> None:
        """Refuses what still waits: another placer has to be asked."""
        askers = [asker for askers in self._askers.values() for asker in askers]
        for asker in askers:
            if asker.timer is not None:
                asker.timer.cancel()
        problem = Refused("not_leading", "this placer stopped leading; ask again").problem
        for request in (*self._early, *(asker.request for asker in askers)):
            request.refuse(problem)
        self._early, self._askers = [], {}

    def on_operation(self, request: Request[PlacerOperation]) -> None:
        operation = request.message
        if isinstance(operation, ListPlacements):
            request.answer(self.placements(operation.component))
            return
        if len(self._early) + sum(map(len, self._askers.values())) >= MAX_WAITING:
            raise Refused("busy", "too many operations are waiting here; ask again")
        if not self._open:
            self._early.append(request)
            return
        match operation:
            case PlaceComponent(component, spec):
                check_spec(component, spec)
                self._take(request, operation, PlaceAsked(component, spec_of(spec)))
            case EndComponent(component):
                self._take(request, operation, StopAsked(check_name(component, "component")))
            case MigrateComponent(component, to):
                to = None if to is None else check_name(to, "host")
                self._take(request, operation, MoveAsked(check_name(component, "component"), to))
            case DrainHost(host):
                self._feed_or_refuse(DrainAsked(check_name(host, "host")))
                request.answer(self.placements(host=host))
            case UncordonHost(host):
                self._feed_or_refuse(UncordonAsked(check_name(host, "host")))
                request.answer(self.placements(host=host))

    def changed(self, components: Iterable[str]) -> None:
        """Answers those who waited for one of these to change so."""
        for component in components:
            for asker in list(self._askers.get(component, ())):
                if self._answer(asker):
                    self._leave(asker)

    def placements(self, component: str | None = None, *, host: str | None = None) -> Placements:
        """All components, or that one, or those of a host."""
        return Placements(
            self.term,
            [
                placement_of(record)
                for name, record in sorted(self.core.records.items())
                if component in (None, name) and host in (None, record.host)
            ],
            sorted(self.core.balancer.cordoned),
        )

    def _take(self, request: Request[PlacerOperation], operation: Lasting, event: Event) -> None:
        asker = _Asker(request, operation, self.core.record(operation.component))
        self._feed_or_refuse(event)
        if self._answer(asker):
            return
        loop = asyncio.get_running_loop()
        asker.timer = loop.call_later(min(operation.wait, MAX_WAIT), self._out_of_patience, asker)
        self._askers.setdefault(operation.component, []).append(asker)

    def _feed_or_refuse(self, event: Event) -> None:
        """Raises Refused with the core's words, if it will not."""
        for refused in self._feed(event):
            raise Refused(refused.code, refused.message)

    def _out_of_patience(self, asker: _Asker) -> None:
        self._leave(asker)
        record = self.core.record(asker.operation.component)
        if record is not None:
            asker.request.answer(placement_of(record))

    def _leave(self, asker: _Asker) -> None:
        component = asker.operation.component
        if asker.timer is not None:
            asker.timer.cancel()
        self._askers[component].remove(asker)
        if not self._askers[component]:
            del self._askers[component]

    def _answer(self, asker: _Asker) -> bool:
        """Answers who waits, if what was asked has come to its end."""
        operation, record = asker.operation, self.core.record(asker.operation.component)
        if record is None:
            asker.request.refuse(Refused("unknown_component", "nothing is known of it").problem)
        elif record.state not in ENDS[type(operation)]:
            return False
        elif isinstance(operation, MigrateComponent) and _stayed(asker.before, record, operation):
            reason = record.reason or f"it goes on on {record.host}"
            asker.request.refuse(Refused("move_failed", reason).problem)
        else:
            asker.request.answer(placement_of(record))
        return True


def _stayed(before: Record | None, record: Record, asked: MigrateComponent) -> bool:
    return before is not None and record.host == before.host and record.host != asked.to


def check_spec(component: str, spec: ComponentSpec) -> None:
    """Raises BadName or Refused for what can't be placed."""
    check_name(component, "component")
    check_name(spec.kind, "kind")
    for host in spec.hosts or ():
        check_name(host, "host")
    for label in spec.labels:
        check_name(label, "label")
    size = len(msgspec.json.encode(spec.params))
    if size > MAX_PARAMS_SIZE:
        raise Refused("too_large", f"the parameters have {size} bytes; at most {MAX_PARAMS_SIZE} are taken")
