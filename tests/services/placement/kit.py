"""A fleet in memory, in virtual time: a real load balancer and placer, and nodes that speak the protocol."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any, TypeVar

import msgspec

from tests.mesh.kit import until
from tests.services.kit import MemoryFleet, answer
from zscout.config.fleet import default_fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Declaration, IncomingQuery, Refused
from zscout.messages import (
    ComponentList,
    ComponentOperation,
    ComponentSpec,
    ComponentView,
    ListComponents,
    LoadReport,
    MoveComponent,
    Moved,
    Phase,
    Placement,
    Placements,
    PlacerOperation,
    RankAsk,
    StartComponent,
    StopComponent,
)
from zscout.placement.events import Inherited
from zscout.services.placement.component_placer import ComponentPlacer
from zscout.services.placement.load_balancer import LoadBalancer
from zscout.testing.memory import MemoryMesh
from zscout.types import Term

JOB = ComponentSpec("job")
R = TypeVar("R")


@dataclass
class FakeNode:
    """A node that does what it is asked at once, unless it is `silent`, or `refuses` has a code for the
    operation's class."""

    mesh: MemoryMesh
    instance: str = "n1"
    refuses: dict[str, str] = field(default_factory=dict)
    silent: bool = False
    movable: bool = True
    commands: list[ComponentOperation] = field(default_factory=list)
    views: dict[tuple[str, int], ComponentView] = field(default_factory=dict)
    tokens: dict[tuple[str, int], Declaration] = field(default_factory=dict)
    others: dict[str, FakeNode] = field(default_factory=dict)

    @property
    def host(self) -> str:
        return self.mesh.me.host

    @property
    def running(self) -> list[str]:
        return sorted(name for (name, _), view in self.views.items() if view.phase == "running")

    def start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        mesh.serve(keys.component(self.host, mesh.me), ComponentOperation, self._on_query)
        self.reporter = mesh.alive(Token(self.host, Role.LOAD, "load", "l1"))
        self.token = mesh.alive(Token(self.host, Role.NODE, "node", self.instance))
        self._numbers = itertools.count(1)
        self.report()

    def report(self, load: float = 0.0, *, of: str | None = None, **more: Any) -> None:
        """Publishes a load report, on the key of host `of`."""
        report = LoadReport(self.host, next(self._numbers), 4, (load, load, load), 0.0, 10**9, 10**10, **more)
        self.mesh.put(self.mesh.keys.load(of or self.host), report)

    def run(self, component: str, incarnation: int, spec: ComponentSpec = JOB, phase: Phase = "running") -> None:
        """It runs there from now on, or stands by."""
        key = component, incarnation
        self.views[key] = ComponentView(component, incarnation, self.host, spec, phase, movable=self.movable)
        if phase == "running":
            token = Token(self.host, Role.COMPONENT, component, f"{incarnation}-x")
            self.tokens[key] = self.mesh.alive(token)

    def end(self, component: str, incarnation: int, how: Any = "completed", reason: str = "") -> None:
        key = component, incarnation
        self.views[key] = msgspec.structs.replace(self.views[key], phase="ended", ended=how, reason=reason)
        if key in self.tokens:
            self.tokens.pop(key).close()

    def _on_query(self, query: IncomingQuery[ComponentOperation]) -> None:
        operation = query.message
        self.commands.append(operation)
        if self.silent:
            return
        code = self.refuses.get(type(operation).__name__)
        if code is not None:
            raise Refused(code, f"{code} here")
        match operation:
            case ListComponents(only):
                found = [view for view in self.views.values() if only in (None, view.component)]
                query.answer(ComponentList(self.host, found))
            case StartComponent(component, incarnation, spec, standby):
                if (component, incarnation) not in self.views:
                    self.run(component, incarnation, spec, "standby" if standby else "running")
                query.answer(self.views[component, incarnation])
            case StopComponent(component, incarnation) if incarnation is not None:
                if (component, incarnation) not in self.views:
                    raise Refused("unknown_component", "unknown component; see zscout component list")
                self.end(component, incarnation, "stopped")
                query.answer(self.views[component, incarnation])
            case MoveComponent(component, incarnation, to, to_incarnation):
                self.others[to].run(component, to_incarnation)
                self.end(component, incarnation, "moved")
                query.answer(Moved(component, to, to_incarnation, 0.25))
            case _:
                raise AssertionError(operation)


class PlacerFleet(MemoryFleet):
    """`published` are the placements that were published, the newest last."""

    def __init__(self, *hosts: str) -> None:
        super().__init__()
        self.published: list[Placement] = []
        self.watcher.subscribe(self.watcher.keys.placements, Placements, self._on_placements)
        self.leader = self.mesh("leader")
        self.nodes: dict[str, FakeNode] = {}
        for host in hosts:
            self.node(host)

    def node(self, host: str, **how: Any) -> FakeNode:
        node = self.nodes[host] = FakeNode(self.mesh(host), others=self.nodes, **how)
        return node

    def _on_placements(self, _key: str, placements: Placements) -> None:
        self.published.extend(placements.components)

    def states(self, component: str) -> list[str]:
        """The states of a component as they were published, each once in a row."""
        states = [one.state for one in self.published if one.component == component]
        return [state for state, _ in itertools.groupby(states)]

    async def lead(self, inherited: Inherited | None = None) -> ComponentPlacer:
        """The balancer, the nodes, and, once all have reported, the placer."""
        self.balancer = LoadBalancer(self.leader, self.failures.append)
        self.balancer.start()
        for node in self.nodes.values():
            node.start()
        await until(lambda: len(self.balancer.core.reports) == len(self.nodes))
        return self.place(inherited)

    def place(self, inherited: Inherited | None = None) -> ComponentPlacer:
        kept, term = inherited or Inherited(()), Term(1, "rcm")
        placer = ComponentPlacer(self.leader, default_fleet(), term, self.balancer, kept, self.failures.append)
        placer.start()
        return placer

    async def ask(self, operation: PlacerOperation | RankAsk, kind: type[R], timeout: float = 90) -> R:
        """The answer of placer or balancer. Raises Refusal."""
        keys = self.watcher.keys
        key = keys.rank if isinstance(operation, RankAsk) else keys.placer(self.watcher.me)
        return await answer(self.watcher, key, operation, kind, timeout)


async def placing(*hosts: str) -> PlacerFleet:
    """With a placer, once all hosts have reported."""
    fleet = PlacerFleet(*hosts)
    await fleet.lead()
    return fleet


def fail(*_: Any, **__: Any) -> None:
    raise RuntimeError("a fault of the core")
