"""The component placer on the mesh, beside the leading RCM: a pure core, its requests and its commands.

Requests and observations are events of the core; its effects are queries to nodes, whose answers are events again. Each
change is published, for candidates that may take over and for watchers."""

from __future__ import annotations

import logging
from asyncio import TimerHandle, sleep
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token, incarnation_of
from zscout.mesh import Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import ListComponents, Placement, Placements, PlacerOperation
from zscout.placement import events
from zscout.placement.placer import Placer
from zscout.rcm.authority import Authority
from zscout.services.placement.load_balancer import LoadBalancer
from zscout.services.placement.node_client import NodeClient
from zscout.services.placement.request_handler import MAX_WAITING, PlacerRequestHandler
from zscout.types import SECOND, HostName, Ns, Term

log = logging.getLogger("zscout.placer")

BEGIN: Final = 2.0  # most seconds until a new placer begins, even if some hosts have not listed their components
LIST_TRIES: Final = 5
LIST_AGAIN: Final = 0.5  # seconds until an unanswered list is asked for again
PUBLISH_AT_ONCE: Final = 200  # components in one publication


class ComponentPlacer:
    """`inherited`: its predecessor's placements; `maintained`: hosts in maintenance. Stop it after `on_failure`."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        term: Term,
        balancer: LoadBalancer,
        inherited: events.Inherited,
        on_failure: Callable[[Exception], object],
        authority: Authority | None = None,
        maintained: frozenset[HostName] = frozenset(),
    ) -> None:
        self.mesh, self.term = mesh, term
        self._core = Placer(balancer.core, term.counter, fleet.placement)
        self._supervisor = Supervisor("the component placer", on_failure)
        self._requests = PlacerRequestHandler(
            self._core, term, mesh.keys, authority or Authority(fleet), self._supervisor, self._feed
        )
        self._nodes = NodeClient(mesh, fleet.placement.start_timeout)
        self._known = events.Maintained(maintained), inherited
        self._instances: dict[HostName, set[str]] = {}  # living instances of each host's node
        self._unlisted: set[HostName] = set()  # hosts that have not listed their components
        self._published = self._core.cordoned, self._core.maintained  # as of the last publication
        self._declarations = ExitStack()
        self._wake: TimerHandle | None = None

    def start(self) -> None:
        keys, mesh, guard = self.mesh.keys, self.mesh, self._supervisor.guard
        self._publisher = mesh.publisher(keys.placements, Placements)
        self._declarations.callback(self._publisher.close)
        self._feed(*self._known)
        for declared in (
            mesh.watch(keys.alive_any(Role.NODE), guard(self._on_node)),
            mesh.watch(keys.alive_any(Role.COMPONENT), guard(self._on_component)),
            *(
                mesh.serve(key, PlacerOperation, guard(self._requests.receive), unanswered=MAX_WAITING)
                for key in keys.served_placer()
            ),
        ):
            self._declarations.callback(declared.close)
        self._supervisor.call_later(BEGIN, self._requests.open)

    def maintain(self, hosts: frozenset[HostName]) -> None:
        """Set the hosts in maintenance: no component is placed there, and components leave."""
        self._feed(events.Maintained(hosts))

    def stop(self) -> None:
        """Stop placing. Components run on for the next placer."""
        self._supervisor.cancel()
        self._requests.close()
        self._declarations.close()

    def _on_node(self, token: Token, alive: bool) -> None:
        host = token.host
        instances = self._instances.setdefault(host, set())
        if alive:
            # A restarted node has lost its components, even if its old token still lives.
            if instances:
                self._feed(events.HostLost(host))
            instances.add(token.instance)
            self._feed(events.HostJoined(host))
            self._unlisted.add(host)
            self._supervisor.spawn(self._list_components(token))
            return
        instances.discard(token.instance)
        if not instances:
            del self._instances[host]
            self._feed(events.HostLost(host))
            self._listed(host)

    async def _list_components(self, node: Token) -> None:
        """Ask a host for its components until it answers."""
        for _ in range(LIST_TRIES):
            gone = node.instance not in self._instances.get(node.host, ())
            if gone or await self._command(events.HostCommand(node.host, ListComponents())):
                break
            await sleep(LIST_AGAIN)
        self._listed(node.host)

    def _listed(self, host: HostName) -> None:
        self._unlisted.discard(host)
        if not self._unlisted:
            self._requests.open()

    def _on_component(self, token: Token, alive: bool) -> None:
        event = events.TokenAppeared if alive else events.TokenVanished
        self._feed(event(token.name, incarnation_of(token.instance), token.host))

    def _feed(self, *happened: events.PlacerEvent) -> list[events.PlacementRefused]:
        """Carry out the effects of events, or of the time; return the refusals."""
        refusals: list[events.PlacementRefused] = []
        changed: dict[str, Placement | None] = {}
        for effect in self._core.handle(self.mesh.now(), *happened):
            match effect:
                case events.PlacementRefused():
                    refusals.append(effect)
                case events.ComponentChanged(component, placement):
                    changed[component] = placement
                case events.PlacerWakeAt(at):
                    self._wake_at(at)
                case _:
                    self._supervisor.spawn(self._command(effect))
        if changed or self._published != (self._core.cordoned, self._core.maintained):
            self._publish(changed)
        return refusals

    async def _command(self, command: events.HostCommand) -> bool:
        """Return True if it led to an event."""
        event = await self._nodes.carry_out(command)
        if event is not None:
            self._feed(event)
        return event is not None

    def _wake_at(self, at: Ns | None) -> None:
        if self._wake is not None:
            self._wake.cancel()
        if at is not None:
            delay = max(0.0, (at - self.mesh.now()) / SECOND)
            self._wake = self._supervisor.call_later(delay, self._woken, at)

    def _woken(self, at: Ns) -> None:
        # A timer may fire early, and the core gives each wake-up time only once.
        if self.mesh.now() < at:
            self._wake_at(at)
        else:
            self._feed()

    def _publish(self, changed: dict[str, Placement | None]) -> None:
        cordoned, maintained = self._published = self._core.cordoned, self._core.maintained
        statuses = [status for status in changed.values() if status is not None]
        forgotten = [name for name, status in changed.items() if status is None]
        for first in range(0, max(1, len(statuses)), PUBLISH_AT_ONCE):
            some = statuses[first : first + PUBLISH_AT_ONCE]
            self._publisher.put(Placements(self.term, some, sorted(cordoned), forgotten, maintained))
            forgotten = []
        for status in statuses:
            log.info("%s", describe(status))
        self._requests.changed(changed)


def describe(status: Placement) -> str:
    """One line for the log."""
    where = f" on {status.host}" if status.host is not None else ""
    to = f" to {status.to}" if status.to is not None else ""
    why = f": {status.reason}" if status.reason else ""
    return f"{status.component} {status.state.replace('_', ' ')}{where}{to}{why}"
