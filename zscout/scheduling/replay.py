"""Plays a workload through the core under virtual time, and keeps what came of it."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from zscout.config.scheduling_policy import DEFAULT, SchedulingPolicy
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    Effect,
    Event,
    Granted,
    HoldEnded,
    Outcome,
    Propose,
    RcJoined,
    Released,
    Requested,
    Tick,
    Vote,
    WakeAt,
)
from zscout.scheduling.state import Strategy
from zscout.scheduling.workload import Workload, excess
from zscout.types import ArcId, Ns, RcName


def play_instant(
    core: Core, now: Ns, events: Iterable[Event], vote: Callable[[Propose], Vote]
) -> Iterator[list[Effect]]:
    """One instant, with every vote and every further pass that it takes; yields the effects of each batch."""
    batch = list(events)
    while batch:
        effects = core.handle(now, *batch)
        yield effects
        batch = [vote(effect) for effect in effects if isinstance(effect, Propose)]
        if not batch and any(isinstance(effect, WakeAt) and effect.at == now for effect in effects):
            batch = [Tick()]


@dataclass(frozen=True, slots=True)
class HoldRecord:
    """One hold from its grant to its end, in ns."""

    arc: ArcId
    start: Ns
    end: Ns
    outcome: Outcome
    rcs: tuple[RcName, ...]


@dataclass(frozen=True, slots=True)
class Replay:
    """What came of a workload: holds by start, ARC, end; and the ARCs that never completed, by name."""

    holds: tuple[HoldRecord, ...]
    unserved: tuple[ArcId, ...]


Watcher = Callable[[Ns, Core, list[Effect]], None]


def replay(
    workload: Workload,
    watch: Watcher | None = None,
    *,
    strategy: Strategy | None = None,
    policy: SchedulingPolicy = DEFAULT,
) -> Replay:
    """Runs the workload to its end. `watch` sees the core after each batch, for tests and recorders.

    What is kept past its minimum runtime ends when nothing else is left to come."""
    return _Player(workload, watch, Core(strategy, policy)).play()


class _Player:
    def __init__(self, workload: Workload, watch: Watcher | None, core: Core) -> None:
        self.workload, self.watch, self.core = workload, watch, core
        self.capacity = {rc.name: rc.capacity for rc in workload.rcs if rc.sharable}
        self.open: dict[ArcId, Granted] = {}
        self.holds: list[HoldRecord] = []

    def play(self) -> Replay:
        self._step(0, [RcJoined(rc.name, rc.sharable) for rc in self.workload.rcs])
        arrivals = [
            (arrival.at, number, arrival.request) for number, arrival in enumerate(self.workload.arrivals)
        ]
        heapq.heapify(arrivals)
        runtime = {arrival.request.arc: arrival.request.min_runtime for arrival in self.workload.arrivals}
        now: Ns = 0
        while arrivals or self.open:
            # Only an arrival or the end of a minimum runtime (a kept hold may be displaced from then on)
            # changes anything here; the quantum's ticks would not.
            ends = [hold.start + runtime[arc] for arc, hold in self.open.items()]
            coming = [end for end in ends if end > now] + [at for at, _, _ in arrivals[:1]]
            if not coming:
                self._step(now, [Released(arc) for arc in sorted(self.open)])
                continue
            now = min(coming)
            events: list[Event] = []
            while arrivals and arrivals[0][0] == now:
                events.append(Requested(heapq.heappop(arrivals)[2]))
            self._step(now, events or [Tick()])
        asked = {arrival.request.arc for arrival in self.workload.arrivals}
        served = {hold.arc for hold in self.holds if hold.outcome is Outcome.COMPLETED}
        holds = sorted(self.holds, key=lambda hold: (hold.start, hold.arc, hold.end))
        return Replay(tuple(holds), tuple(sorted(asked - served)))

    def _step(self, now: Ns, events: list[Event]) -> None:
        """One instant."""
        for effects in play_instant(self.core, now, events, self._vote):
            if self.watch is not None:
                self.watch(now, self.core, effects)
            for effect in effects:
                match effect:
                    case Granted(arc=arc):
                        self.open[arc] = effect
                    case HoldEnded(arc=arc, outcome=outcome, rcs=rcs):
                        start = self.open.pop(arc).start
                        self.holds.append(HoldRecord(arc, start, now, outcome, rcs))
                    case _:
                        pass

    def _vote(self, asked: Propose) -> Vote:
        reason = excess(self.capacity[asked.rc], asked.holders.items())
        return Vote(asked.proposal, accept=not reason, reason=reason)
