"""The pure core of the component placer: events in, effects out, time given.

Every decision about where components run is made here and in the files beside it; there is no clock, socket
or log inside. `ground` is what is known and done; `choosing` finds hosts; `keeping` starts, restarts and
stops; `moving`, `draining` and `rebalance` move; `hearing` believes tokens and hosts. The service drives this
one class:

    effects = placer.handle(now, PlaceAsked("counter", spec), ...)

A batch of events is one instant: the events are applied in the order given, then what is due, then all that
is to be placed, the heaviest first. The effects are to be carried out in their order: what has changed is
published before it is acted upon.

Of every component one incarnation runs, or none. Each start on another host and each start after an end has
a higher incarnation than all before; a start whose outcome is unknown is asked for again on the same host
under the same incarnation, until that host's node is gone. So nothing runs twice for long, whatever is lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from zscout.balancing.balancer import Balancer
from zscout.balancing.model import ComponentId, Ns
from zscout.placing.draining import Drain
from zscout.placing.events import (
    Appeared,
    DrainAsked,
    Effect,
    Event,
    HostLost,
    HostSeen,
    HostTold,
    Inherited,
    MoveAnswered,
    MoveAsked,
    PlaceAsked,
    Record,
    StartAnswered,
    StopAnswered,
    StopAsked,
    Tick,
    UncordonAsked,
    Vanished,
    WakeAt,
)
from zscout.placing.ground import DRAIN, Ground
from zscout.placing.hearing import Hearing
from zscout.placing.inquiries import KIND as INQUIRY
from zscout.placing.inquiries import Inquiries
from zscout.placing.keeping import Keeper
from zscout.placing.moving import Mover
from zscout.placing.rebalance import REBALANCE, Rebalance
from zscout.placing.rules import DEFAULT_RULES, Rules
from zscout.placing.strays import Strays
from zscout.placing.timers import Key


class Placer:
    """All components of one fleet. `balancer` knows the hosts, and is told what is placed; `counter` is that
    of the term, and makes incarnations higher than those of terms before."""

    def __init__(self, balancer: Balancer, counter: int, rules: Rules = DEFAULT_RULES) -> None:
        self.balancer, self.rules = balancer, rules
        self._ground = Ground(balancer, counter, rules)
        self._strays = Strays(self._ground)
        self._inquiries = Inquiries(self._ground)
        self._keeper = Keeper(self._ground, self._strays, self._inquiries)
        self._mover = Mover(self._ground, self._keeper)
        self._hearing = Hearing(self._ground, self._keeper, self._mover)
        self._drain = Drain(self._ground, self._mover)
        self._rebalance = Rebalance(self._ground, self._mover)
        self._wake: Ns | None = None
        if rules.rebalance:
            self._ground.timers.set(REBALANCE, 0)

    @property
    def records(self) -> Mapping[ComponentId, Record]:
        """All components, as they were told of last."""
        return MappingProxyType(self._ground.records)

    def record(self, component: ComponentId) -> Record | None:
        return self._ground.records.get(component)

    def handle(self, now: Ns, *events: Event) -> list[Effect]:
        """Applies one instant's events. Raises ValueError if `now` goes backwards."""
        ground = self._ground
        ground.begin(now)
        for event in events:
            self._apply(event)
        while (due := ground.timers.due(now)) or ground.to_place:
            for key in due:
                self._woke(key)
            self._keeper.chooser.place_all()
        effects = ground.finish()
        at = ground.timers.next()
        if at != self._wake:
            self._wake = at
            effects.append(WakeAt(at))
        return effects

    def _apply(self, event: Event) -> None:
        match event:
            case PlaceAsked(component, spec):
                self._keeper.place(component, spec)
            case StopAsked(component):
                self._stop(component)
            case MoveAsked(component, to):
                self._mover.asked(component, to)
            case DrainAsked(host):
                self._drain.asked(host)
            case UncordonAsked(host):
                self._drain.uncordon(host)
            case StartAnswered():
                self._start_answered(event)
            case StopAnswered():
                self._stop_answered(event)
            case MoveAnswered():
                self._move_answered(event)
            case Appeared(component, incarnation, host):
                self._hearing.appeared(component, incarnation, host)
            case Vanished(component, incarnation, host):
                self._hearing.vanished(component, incarnation, host)
            case HostTold():
                self._hearing.told(event)
            case HostSeen(host):
                self._hearing.seen(host)
            case HostLost(host):
                self._hearing.lost(host)
            case Inherited(records, cordoned):
                self.balancer.cordoned |= cordoned
                for record in records:
                    self._hearing.inherited(record)
            case Tick():
                pass

    def _stop(self, component: ComponentId) -> None:
        entry = self._ground.entry(component)
        if entry is None:
            self._ground.refuse(component, "unknown_component", f"there is no component {component}")
            return
        self._mover.cancel(entry)
        self._keeper.stop(entry)

    # Answers: those about an incarnation that no longer counts change nothing

    def _start_answered(self, answer: StartAnswered) -> None:
        ground, component, incarnation = self._ground, answer.component, answer.incarnation
        if self._strays.start_answered(component, incarnation):
            return
        entry = ground.entry(component)
        if entry is None:
            return
        move = entry.move
        if move is not None and (incarnation, answer.host) == (move.incarnation, move.to):
            self._mover.target_answered(entry, move, answer)
        elif (incarnation, answer.host) == (entry.incarnation, entry.host) and move is None:
            self._keeper.start_answered(entry, answer)

    def _stop_answered(self, answer: StopAnswered) -> None:
        component, incarnation = answer.component, answer.incarnation
        self._strays.stop_answered(component, incarnation, done=answer.done)
        entry = self._ground.entry(component)
        if entry is None or entry.state != "stopping":
            return
        if (incarnation, answer.host) == (entry.incarnation, entry.host):
            self._keeper.stop_answered(entry, answer)
        else:
            self._keeper.stray_over(component)

    def _move_answered(self, answer: MoveAnswered) -> None:
        entry = self._ground.entry(answer.component)
        if entry is None or entry.move is None:
            return
        if (answer.incarnation, answer.host) == (entry.incarnation, entry.host):
            self._mover.answered(entry, entry.move, answer)

    # Time

    def _woke(self, key: Key) -> None:
        kind, name = key
        if key == DRAIN:
            self._drain.run()
        elif key == REBALANCE:
            self._rebalance.run()
        elif kind == "strays":
            self._strays.woke(name)
        elif kind == INQUIRY:
            self._inquiries.woke(name)
        elif (entry := self._ground.entry(name)) is not None:
            if kind == "move" and entry.move is not None:
                self._mover.woke(entry, entry.move)
            elif kind == "entry" and entry.move is not None:
                self._mover.source_woke(entry, entry.move)
            elif kind == "entry":
                self._keeper.woke(entry)
