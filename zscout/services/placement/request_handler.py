"""Requests of operators and programs to the placer: their events for the core, and their answers."""

from __future__ import annotations

from asyncio import TimerHandle
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Final, TypeAlias

import msgspec
from msgspec import structs

from zscout import messages
from zscout.keyexpr import Keys, Sender, check_name
from zscout.mesh import IncomingQuery, Refused
from zscout.mesh.supervision import Supervisor
from zscout.placement.events import PlacementRefused, PlacerEvent
from zscout.placement.placer import Placer
from zscout.placement.state import OVER
from zscout.rcm.authority import Authority
from zscout.types import HostName, Term

MAX_WAIT: Final = 60.0
MAX_WAITING: Final = 1_000  # requests awaiting their answer at one time

Operation: TypeAlias = messages.PlacementOperation | messages.DrainHost | messages.UncordonHost
PlacerQuery: TypeAlias = IncomingQuery[messages.PlacerOperation]

SETTLED: Final = OVER | {"running", "waiting"}


@dataclass(slots=True)
class _Waiting:
    """An unfinished operation; `host` is its component's host at the request."""

    operation: messages.PlacementOperation
    host: HostName | None
    timer: TimerHandle


class PlacerRequestHandler:
    """Answers requests once the component's state settles, or their `wait` is over. `feed` passes an event to the core,
    and returns the refusals."""

    def __init__(
        self,
        placer: Placer,
        term: Term,
        keys: Keys,
        authority: Authority,
        supervisor: Supervisor,
        feed: Callable[[PlacerEvent], list[PlacementRefused]],
    ) -> None:
        self._keys, self._authority = keys, authority
        self._placer, self.term, self._supervisor, self._feed = placer, term, supervisor, feed
        self._early: list[tuple[PlacerQuery, PlacerEvent]] = []
        self._is_open = False
        self._waiting: dict[PlacerQuery, _Waiting] = {}

    def receive(self, query: PlacerQuery) -> None:
        """Answer the query, carry it out, or keep it until `open`. Raises Refused and BadName."""
        operation = query.message
        if isinstance(operation, messages.ListPlacements):
            query.answer(self.placements(operation.component))
            return
        event = _event_of(operation)
        if self._keys.closed:
            event = self._allowed(event, self._keys.sender_of(query.key))
        if self._is_open:
            self._carry_out(query, event)
        else:
            self._early.append((query, event))

    def _allowed(self, event: Operation, sender: Sender) -> Operation:
        """Check the sender's rights, and set the owner. Raises Refused."""
        if isinstance(event, messages.DrainHost | messages.UncordonHost):
            self._authority.check_operator(sender, f"empty {event.host} or fill it again")
            return event
        if isinstance(event, messages.PlaceComponent):
            self._authority.check_user(sender, "start components")
            return structs.replace(event, spec=structs.replace(event.spec, owner=sender.host))
        known = self._placer.components.get(event.component)
        if known is None or known.spec.owner != sender.host:
            whose = f", which is {known.spec.owner}'s" if known is not None and known.spec.owner else ""
            self._authority.check_operator(sender, f"stop or move {event.component}{whose}")
        return event

    def open(self) -> None:
        """Carry out requests from now on, waiting ones first."""
        self._is_open = True
        early, self._early = self._early, []
        for query, event in early:
            self._carry_out(query, event)

    def close(self) -> None:
        """Another placer must be asked."""
        problem = Refused("not_leading", "this placer stopped leading; try again").problem
        for query in (*(query for query, _ in self._early), *self._waiting):
            query.refuse(problem)
        self._early, self._waiting = [], {}

    def _carry_out(self, query: PlacerQuery, event: PlacerEvent) -> None:
        operation = query.message
        if isinstance(operation, messages.PlacementOperation):
            before = self._placer.components.get(operation.component)
            timer = self._supervisor.call_later(min(operation.wait, MAX_WAIT), self._timed_out, query)
            self._waiting[query] = _Waiting(operation, before.host if before is not None else None, timer)
        if refusals := self._feed(event):
            self._pop(query)
            query.refuse(Refused(refusals[0].code, refusals[0].message).problem)
        elif isinstance(operation, messages.DrainHost | messages.UncordonHost):
            query.answer(self.placements(host=operation.host))

    def changed(self, components: Collection[str]) -> None:
        """Answer settled requests about these components."""
        for query, waiting in list(self._waiting.items()):
            operation, component = waiting.operation, waiting.operation.component
            if component not in components:
                continue
            status = self._placer.components.get(component)
            ends = OVER if isinstance(operation, messages.EndComponent) else SETTLED
            if status is not None and status.state not in ends:
                continue
            self._pop(query)
            if status is None:
                query.refuse(Refused("unknown_component", "unknown component; see zscout component list").problem)
            elif isinstance(operation, messages.MigrateComponent) and waiting.host == status.host != operation.to:
                reason = status.reason or f"it still runs on {status.host}"
                query.refuse(Refused("move_failed", reason).problem)
            else:
                query.answer(status)

    def placements(self, component: str | None = None, *, host: str | None = None) -> messages.Placements:
        """All components, or those with a name or on a host."""
        components = sorted(self._placer.components.items())
        found = [status for name, status in components if component in (None, name) and host in (None, status.host)]
        return messages.Placements(self.term, found, sorted(self._placer.cordoned), maintained=self._placer.maintained)

    def _timed_out(self, query: PlacerQuery) -> None:
        waiting = self._pop(query)
        status = self._placer.components.get(waiting.operation.component) if waiting else None
        if status is not None:
            query.answer(status)
        else:
            query.drop()

    def _pop(self, query: PlacerQuery) -> _Waiting | None:
        waiting = self._waiting.pop(query, None)
        if waiting is not None:
            waiting.timer.cancel()
        return waiting


def _event_of(operation: Operation) -> Operation:
    """The operation, its spec normalised. Raises BadName or Refused."""
    if isinstance(operation, messages.DrainHost | messages.UncordonHost):
        check_name(operation.host, "host")
        return operation
    check_name(operation.component, "component")
    if isinstance(operation, messages.PlaceComponent):
        return structs.replace(operation, spec=_checked(operation.spec))
    if isinstance(operation, messages.MigrateComponent) and operation.to is not None:
        check_name(operation.to, "host")
    return operation


def _checked(spec: messages.ComponentSpec) -> messages.ComponentSpec:
    """Sorted, so that equal specs compare equal."""
    check_name(spec.kind, "kind")
    for host in spec.hosts or ():
        check_name(host, "host")
    for label in spec.labels:
        check_name(label, "label")
    size = len(msgspec.json.encode(spec.params))
    if size > messages.MAX_PARAMS_SIZE:
        raise Refused("too_large", f"the parameters have {size} bytes; at most {messages.MAX_PARAMS_SIZE} are allowed")
    hosts = None if spec.hosts is None else sorted(set(spec.hosts))
    return structs.replace(spec, labels=sorted(set(spec.labels)), hosts=hosts, owner="")
