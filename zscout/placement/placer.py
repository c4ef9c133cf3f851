"""The pure core of the component placer: events in, effects out, time passed in.

    effects = placer.handle(now, PlaceComponent("counter", spec), ...)

This module and those around its `state` decide where components run: `lifecycle` places, restarts and stops;
`migration` and `rebalancing` move; `reconciler` decides which incarnation counts.

A batch of events is one instant: events in order, then due timers, then placements, the heaviest first. Effects must be
carried out in order: changes are published before they are acted upon.

At most one incarnation of a component runs. Each start on another host or after an end has a higher incarnation; a
start with unknown outcome is repeated on the same host with the same incarnation, until the host's node is gone. So
nothing runs twice for long, despite losses."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from zscout.config.fleet import DEFAULT_PLACEMENT, PlacementPolicy
from zscout.messages import DrainHost, EndComponent, MigrateComponent, PlaceComponent, Placement, UncordonHost
from zscout.placement import events
from zscout.placement.balancer import Balancer
from zscout.placement.lifecycle import Lifecycle
from zscout.placement.migration import Migrations
from zscout.placement.rebalancing import Rebalancer
from zscout.placement.reconciler import Reconciler
from zscout.placement.repeating import Probes, SurplusIncarnations
from zscout.placement.state import PlacementState, TimerKind
from zscout.types import ComponentId, HostName, Ns


class Placer:
    """`balancer` knows the hosts and learns placements; with the term's `counter` incarnations rise by term."""

    def __init__(self, balancer: Balancer, counter: int, rules: PlacementPolicy = DEFAULT_PLACEMENT) -> None:
        self._state = state = PlacementState(balancer, counter, rules)
        self._surplus, self._probes = SurplusIncarnations(state), Probes(state)
        self._lifecycle = Lifecycle(state, self._surplus, self._probes)
        self._migrations = Migrations(state, self._lifecycle)
        self._rebalancer = Rebalancer(state, self._migrations)
        self._reconciler = Reconciler(state, self._lifecycle, self._migrations)
        self._wake: Ns | None = None
        self.components: Mapping[ComponentId, Placement] = MappingProxyType(state.published)
        """A live view of the published placements."""
        if rules.rebalance:
            state.timers.set(TimerKind.REBALANCE, "", 0)

    @property
    def cordoned(self) -> frozenset[HostName]:
        return frozenset(self._state.balancer.cordoned)

    @property
    def maintained(self) -> list[HostName]:
        return sorted(self._migrations.maintained)

    def handle(self, now: Ns, *batch: events.PlacerEvent) -> list[events.PlacerEffect]:
        """Apply one instant's events, or only the time. Raises ValueError if `now` goes backwards."""
        state = self._state
        state.begin(now)
        for event in batch:
            self._apply(event)
        while (due := state.timers.pop_due(now)) or state.to_place:
            for kind, name in due:
                self._timer(kind, name)
            self._lifecycle.place_waiting()
        effects = state.finish()
        at = state.timers.next()
        if at != self._wake:
            self._wake = at
            effects.append(events.PlacerWakeAt(at))
        return effects

    def _apply(self, event: events.PlacerEvent) -> None:
        match event:
            case PlaceComponent(component, spec):
                self._lifecycle.place(component, spec)
            case EndComponent(component):
                if (record := self._state.known(component)) is not None:
                    self._migrations.cancel(record)
                    self._lifecycle.stop(record)
            case MigrateComponent(component, to):
                self._migrations.request(component, to)
            case DrainHost(host):
                self._migrations.drain(host)
            case UncordonHost(host):
                self._migrations.uncordon(host)
            case events.Maintained(hosts):
                self._migrations.maintain(hosts)
            case events.StartAnswered():
                self._start_answered(event)
            case events.StopAnswered(component, incarnation, _, done):
                self._surplus.stop_answered(component, incarnation, done=done)
                self._lifecycle.surplus_ended(component)
            case events.MoveAnswered():
                self._move_answered(event)
            case events.TokenAppeared():
                self._reconciler.appeared(event)
            case events.TokenVanished():
                self._reconciler.vanished(event)
            case events.ComponentsListed():
                self._reconciler.listed(event)
            case events.HostJoined(host):
                self._reconciler.host_joined(host)
            case events.HostLost(host):
                self._reconciler.host_lost(host)
            case events.Inherited(components, cordoned):
                self._state.balancer.cordoned |= cordoned
                for status in components:
                    self._reconciler.inherited(status)

    # Answers about an incarnation that no longer counts change nothing

    def _start_answered(self, answer: events.StartAnswered) -> None:
        record = self._state.get(answer.component)
        may_run = answer.result in ("ok", "unknown")
        if record is None or record.state != "stopping" or record.incarnation != answer.incarnation:
            may_run = True  # the refusal may be of another start
        if self._surplus.start_answered(answer.component, answer.incarnation, may_run=may_run):
            self._lifecycle.surplus_ended(answer.component)
            return
        if record is None:
            return
        move, answering = record.migration, (answer.incarnation, answer.host)
        if move is not None and answering == (move.incarnation, move.to):
            self._migrations.target_answered(record, move, answer)
        elif move is None and answering == (record.incarnation, record.host):
            self._lifecycle.start_answered(record, answer)

    def _move_answered(self, answer: events.MoveAnswered) -> None:
        record = self._state.get(answer.component)
        if record is None or record.migration is None:
            return
        if (answer.incarnation, answer.host) == (record.incarnation, record.host):
            self._migrations.answered(record, record.migration, answer)

    def _timer(self, kind: TimerKind, name: str) -> None:
        match kind:
            case TimerKind.DRAIN:
                self._migrations.drain_timer()
            case TimerKind.REBALANCE:
                self._rebalancer.timer()
            case TimerKind.SURPLUS:
                self._surplus.timer(name)
            case TimerKind.PROBES:
                self._probes.timer(name)
            case TimerKind.LIFECYCLE | TimerKind.MIGRATION:
                record = self._state.get(name)
                if record is None:
                    return
                move = record.migration
                if kind is TimerKind.MIGRATION:
                    if move is not None:
                        self._migrations.timer(record, move)
                elif move is not None:
                    self._migrations.source_timer(record, move)
                else:
                    self._lifecycle.timer(record)
