"""The component placer on the mesh, beside the leading RCM: a pure core, its desk and its errands.

What is asked and seen becomes an event of the core; its effects become questions to nodes, whose answers are
events again. Each change of a record is published, for the candidates that may have to go on and for all who
watch.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from zscout import clock
from zscout.config import Fleet
from zscout.keyexpr import Role, Token, incarnation_of
from zscout.mesh import Declared, Mesh
from zscout.messages import Placements, PlacerOperation
from zscout.placing.events import (
    Appeared,
    Changed,
    Event,
    Forgotten,
    HostLost,
    HostSeen,
    Inherited,
    Record,
    Tick,
    Vanished,
    WakeAt,
)
from zscout.placing.events import Refused as RefusedByCore
from zscout.placing.placer import Placer
from zscout.scheduling.model import SECOND, Ns, Term
from zscout.services.load_balancer import LoadBalancer
from zscout.services.placements import placement_of
from zscout.services.placer_desk import PlacerDesk
from zscout.services.placer_errands import Errands

log = logging.getLogger("zscout.placer")

BEGIN: Final = 2.0
"""Seconds at most until a new placer begins, though not all hosts have told what runs there."""
LIST_TRIES: Final = 5
LIST_AGAIN: Final = 0.5
"""Seconds until a host that did not answer is asked again."""
PUBLISH_AT_ONCE: Final = 200
"""Components in one publication."""


class ComponentPlacer:
    """One reign's placer. `inherited` is what the one before it published."""

    def __init__(
        self, mesh: Mesh, fleet: Fleet, term: Term, balancer: LoadBalancer, inherited: Inherited
    ) -> None:
        self.mesh, self.term = mesh, term
        self.core = Placer(balancer.core, term.counter, fleet.rules)
        self.desk = PlacerDesk(self.core, term, self._feed)
        self._errands = Errands(mesh, fleet, self._feed)
        self._inherited = inherited
        self._nodes: dict[str, set[str]] = {}
        """Instances alive of each host's node."""
        self._untold: set[str] = set()
        """Hosts that have not told yet what runs there."""
        self._cordoned: frozenset[str] = frozenset()
        """As published last."""
        self._declared: list[Declared] = []
        self._wake: asyncio.TimerHandle | None = None
        self._begin_by: asyncio.TimerHandle | None = None
        self._closed = False

    def start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self._publisher = mesh.publisher(keys.placements, Placements)
        self._feed(self._inherited)
        self._declared = [
            mesh.watch(keys.alive_any(Role.NODE), self._on_node),
            mesh.watch(keys.alive_any(Role.COMPONENT), self._on_component),
            mesh.serve(keys.placer, PlacerOperation, self.desk.on_operation),
        ]
        self._begin_by = asyncio.get_running_loop().call_later(BEGIN, self.desk.open)

    def stop(self) -> None:
        """Stops placing. Nothing is stopped: what runs, runs for the next placer."""
        if self._closed:
            return
        self._closed = True
        for declared in reversed(self._declared):
            declared.close()
        for timer in (self._wake, self._begin_by):
            if timer is not None:
                timer.cancel()
        self._errands.stop()
        self.desk.close()
        self._publisher.close()

    # What is seen

    def _on_node(self, token: Token, alive: bool) -> None:
        instances = self._nodes.setdefault(token.host, set())
        if alive:
            # A node that started anew has lost its components, though its old token may live on for a while.
            if instances:
                self._feed(HostLost(token.host))
            instances.add(token.instance)
            self._feed(HostSeen(token.host))
            self._untold.add(token.host)
            self._errands.spawn(self._listen_to(token))
            return
        instances.discard(token.instance)
        if not instances:
            del self._nodes[token.host]
            self._feed(HostLost(token.host))
            self._told(token.host)

    async def _listen_to(self, token: Token) -> None:
        """Asks a host what runs there until it answers."""
        for _ in range(LIST_TRIES):
            gone = token.instance not in self._nodes.get(token.host, ())
            if gone or await self._errands.everything(token.host):
                break
            await asyncio.sleep(LIST_AGAIN)
        self._told(token.host)

    def _told(self, host: str) -> None:
        self._untold.discard(host)
        if not self._untold and self._begin_by is not None and not self._closed:
            self._begin_by.cancel()
            self._begin_by = None
            self.desk.open()

    def _on_component(self, token: Token, alive: bool) -> None:
        event = Appeared if alive else Vanished
        self._feed(event(token.name, incarnation_of(token.instance), token.host))

    # Events into the core, effects out of it

    def _feed(self, event: Event) -> list[RefusedByCore]:
        """Carries out what follows from an event; returns what the core refused."""
        if self._closed:
            return []
        refusals: list[RefusedByCore] = []
        changed: dict[str, Record | None] = {}
        for effect in self.core.handle(clock.now(), event):
            match effect:
                case RefusedByCore():
                    refusals.append(effect)
                case Changed(component):
                    changed[component] = self.core.record(component)
                case Forgotten(component):
                    changed[component] = None
                case WakeAt(at):
                    self._wake_at(at)
                case _:
                    self._errands.run(effect)
        if changed or self._cordoned != self.core.balancer.cordoned:
            self._publish(changed)
        return refusals

    def _wake_at(self, at: Ns | None) -> None:
        if self._wake is not None:
            self._wake.cancel()
        self._wake = None
        if at is not None:
            delay = max(0.0, (at - clock.now()) / SECOND)
            self._wake = asyncio.get_running_loop().call_later(delay, self._woken, at)

    def _woken(self, at: Ns) -> None:
        # A timer may go off a little early, and the core says only once when it wants to be woken.
        if clock.now() < at:
            self._wake_at(at)
        else:
            self._feed(Tick())

    def _publish(self, changed: dict[str, Record | None]) -> None:
        """Tells everybody what has changed, and those who wait for it."""
        self._cordoned = frozenset(self.core.balancer.cordoned)
        records = [record for record in changed.values() if record is not None]
        forgotten = [name for name, record in changed.items() if record is None]
        for first in range(0, max(1, len(records)), PUBLISH_AT_ONCE):
            some = [placement_of(record) for record in records[first : first + PUBLISH_AT_ONCE]]
            self._publisher.put(Placements(self.term, some, sorted(self._cordoned), forgotten))
            forgotten = []
        for record in records:
            log.info("%s", describe(record))
        self.desk.changed(changed)


def describe(record: Record) -> str:
    """A record in one line."""
    where = f" on {record.host}" if record.host is not None else ""
    to = f" to {record.to}" if record.to is not None else ""
    why = f": {record.reason}" if record.reason else ""
    return f"{record.component} {record.state.replace('_', ' ')}{where}{to}{why}"
