"""A small honest world around the placer's core: hosts that start components, fail, are cut off, die and come
back; messages that are late, overtake each other or are lost; tokens that come late; leaders that change.
"""

from __future__ import annotations

import heapq
import itertools
from collections import Counter
from collections.abc import Callable
from functools import partial
from random import Random

from tests.placement.placer_hosts import Host, Hosts, Say, seen_of, told_of
from tests.placement.test_balancer import report
from zscout.config.fleet import PlacementPolicy
from zscout.messages import Incarnation, ListComponents, MoveComponent, Placement, StartComponent, StopComponent
from zscout.placement.balancer import Balancer
from zscout.placement.events import (
    ComponentChanged,
    ComponentsListed,
    HostCommand,
    HostJoined,
    HostLost,
    Inherited,
    MoveAnswered,
    PlacementRefused,
    PlacerEffect,
    PlacerEvent,
    PlacerWakeAt,
    StartAnswered,
    StopAnswered,
)
from zscout.placement.placer import Placer
from zscout.types import SECOND, ComponentId, HostName, Ns

RULES = PlacementPolicy(start_timeout=3 * SECOND, longest_back_off=4 * SECOND, settled=5 * SECOND)
QUERY: Ns = 4 * SECOND
"""A question without an answer by then is `unknown`."""
REPORT: Ns = 3 * SECOND


class World(Hosts):
    """The placer that leads, and what it says and hears."""

    balancer: Balancer
    placer: Placer

    def __init__(self, seed: int, hosts: int, rules: PlacementPolicy = RULES) -> None:
        super().__init__(seed, hosts)
        self.rules = rules
        self.starts: dict[tuple[ComponentId, Incarnation], HostCommand] = {}
        self.published: dict[ComponentId, Placement] = {}
        self.refusals: list[PlacementRefused] = []
        self.alive: set[HostName] = set()
        """As the leading placer was told."""
        self.heard: Counter[str] = Counter()
        """How often the placer heard of what, by the event's name and what it says."""
        self.counter = 0
        self._reports = itertools.count(1)
        self._wake: Ns | None = None
        self.new_leader()
        self._report()

    # Time

    def run(self, until: Ns) -> None:
        while True:
            at = self.queue[0][0]
            if self._wake is not None and self._wake <= min(at, until):
                self.now, self._wake = max(self.now, self._wake), None
                self.send()
            elif at <= until:
                self.now, _, what = heapq.heappop(self.queue)
                what()
            else:
                self.now = until
                return

    def _report(self) -> None:
        for host in self.hosts.values():
            if host.there:
                self._report_now(host)
        self.later(REPORT, self._report)

    def _report_now(self, host: Host) -> None:
        load = float(sum(one.lives for one in host.procs.values()))
        self.balancer.reported(self.now, report(host.name, next(self._reports), load, cores=4.0, cpu=0.5))

    # The placer

    def new_leader(self) -> None:
        """Another placer, which knows what was published; what was sent before is still on its way."""
        cordoned = frozenset(self.balancer.cordoned) if self.counter else frozenset()
        self.counter += 1
        self.balancer = Balancer(Random(self.counter))  # noqa: S311
        self.placer = Placer(self.balancer, self.counter, self.rules)
        self.alive, self._wake = set(), None
        self.send(Inherited(tuple(self.published.values()), cordoned))
        for host in self.hosts.values():
            if host.there:
                self._report_now(host)
                self.token(host, "node", partial(self.seen, host))
            if host.linked:
                for proc in host.procs.values():
                    if proc.token:
                        self._appear(host, proc)

    def seen(self, host: Host) -> None:
        self.send(HostJoined(host.name))
        leader = self.counter
        if host.there and not self.lost():
            told = ComponentsListed(host.name, tuple(seen_of(host, one) for one in host.procs.values()))
            self.later(self.delay(), lambda: self.answer(leader, told))

    def send(self, *events: PlacerEvent) -> None:
        for event in events:
            self.heard[" ".join([type(event).__name__, getattr(event, "result", "")]).strip()] += 1
            if isinstance(event, HostJoined):
                self.alive.add(event.host)
            elif isinstance(event, HostLost):
                self.alive.discard(event.host)
        effects = self.placer.handle(self.now, *events)
        for effect in effects:
            self.carry_out(effect)

    def answer(self, leader: int, event: PlacerEvent) -> None:
        """Of a question of this leader: nobody hears it if another leads."""
        if leader == self.counter:
            self.send(event)

    def carry_out(self, effect: PlacerEffect) -> None:
        match effect:
            case ComponentChanged(component, placement):
                if placement is None:
                    del self.published[component]
                else:
                    self.published[component] = placement
            case PlacementRefused():
                self.refusals.append(effect)
            case PlacerWakeAt(at):
                assert at is None or at > self.now, "it would wake at once, for ever"
                self._wake = at
            case HostCommand(host, StartComponent(component, incarnation) as start):
                before = self.starts.setdefault((component, incarnation), effect)
                assert before == effect, f"one incarnation, two starts: {before} and {effect}"
                known = self.published[component].incarnation
                assert start.standby or known == incarnation, "started before it was published"
                unknown = StartAnswered(component, incarnation, host, "unknown")
                self.ask(host, lambda there, say: self.on_start(there, start, say), unknown)
            case HostCommand(host, StopComponent(component, incarnation) as stop):
                silent = StopAnswered(component, incarnation or 0, host, done=False)
                self.ask(host, lambda there, say: self.on_stop(there, stop, say), silent)
            case HostCommand(host, MoveComponent(component, incarnation) as move):
                open_end = MoveAnswered(component, incarnation, host, "unknown")
                self.ask(host, lambda there, say: self.on_move(there, move, say), open_end)
            case HostCommand(host, ListComponents(str(component))):
                self.ask(host, lambda there, say: say(told_of(there, component)), None)

    def ask(self, name: HostName, on_host: Callable[[Host, Say], None], unknown: PlacerEvent | None) -> None:
        """A query: its answer comes late or not at all, and then its outcome is unknown."""
        assert name in self.alive, f"asked {name}, which is gone"
        host, leader = self.hosts[name], self.counter
        done: list[bool] = []

        def come_back(event: PlacerEvent) -> None:
            if not done:
                done.append(True)
                self.answer(leader, event)

        def say(event: PlacerEvent) -> None:
            if host.there and not self.lost():
                self.later(self.delay(), lambda: come_back(event))

        if not self.lost():
            self.later(self.delay(), lambda: on_host(host, say) if host.there else None)
        if unknown is not None:
            self.later(QUERY, lambda: come_back(unknown))
