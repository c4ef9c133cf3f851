"""Plays a workload through the core under virtual time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from zscout.config.scheduling_policy import DEFAULT, SchedulingPolicy
from zscout.scheduling import model
from zscout.scheduling.capacity import excess
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.state import Strategy
from zscout.simulation.workload import Workload
from zscout.types import ArcId, Ns, RcName

SERVED: Final = (
    model.Outcome.COMPLETED,
    model.Outcome.RELEASED,
)  # outcomes of holds that ran as long as their programs wanted


@dataclass(frozen=True, slots=True)
class HoldRecord:
    """A hold from its grant to its end, ns."""

    arc: ArcId
    start: Ns
    end: Ns
    outcome: model.Outcome
    rcs: tuple[RcName, ...]


@dataclass(frozen=True, slots=True)
class Replay:
    """Holds sorted by start, ARC and end, and the names of the ARCs that never completed, sorted."""

    holds: tuple[HoldRecord, ...]
    unserved: tuple[ArcId, ...]


Watcher = Callable[[Ns, Core, list[model.Effect]], None]


def replay(
    workload: Workload,
    watch: Watcher | None = None,
    *,
    strategy: Strategy | None = None,
    policy: SchedulingPolicy = DEFAULT,
    lasting: Mapping[ArcId, Ns] = MappingProxyType({}),
) -> Replay:
    """Run the workload to its end. `watch` is called with the core after each batch. `lasting`: by ARC, when its
    program releases its hold (ns), if before its minimum runtime. Holds kept longer end when no other event is left."""
    core = Core(strategy, policy)
    capacity = {rc.name: rc.capacity for rc in workload.rcs if rc.sharable}
    runtime = {arrival.request.arc: arrival.request.min_runtime for arrival in workload.arrivals}
    early = {arc: at for arc, at in lasting.items() if at < runtime[arc]}
    arrivals = deque(sorted(workload.arrivals, key=lambda arrival: arrival.at))
    running: dict[ArcId, model.Granted] = {}
    holds: list[HoldRecord] = []

    def vote(asked: model.Propose) -> model.Vote:
        reason = excess(capacity[asked.rc], asked.holders.items())
        return model.Vote(asked.proposal, accept=not reason, reason=reason)

    def step(now: Ns, events: Iterable[model.Event]) -> None:
        for effects in play_instant(core, now, events, vote):
            if watch is not None:
                watch(now, core, effects)
            for effect in effects:
                match effect:
                    case model.Granted(arc=arc):
                        running[arc] = effect
                    case model.HoldEnded(arc=arc, outcome=outcome, rcs=rcs):
                        holds.append(HoldRecord(arc, running.pop(arc).start, now, outcome, rcs))

    now: Ns = 0
    step(now, [model.RcJoined(rc.name, rc.sharable) for rc in workload.rcs])
    while arrivals or running:
        # The instants at which the leader's passes may change something: its other ticks change nothing.
        coming = [end for arc, hold in running.items() if arc in early and (end := hold.start + early[arc]) > now]
        if (change := core.next_change()) is not None and change > now:
            coming.append(change)
        if arrivals:
            coming.append(arrivals[0].at)
        if not coming:
            step(now, [model.Released(arc) for arc in sorted(running)])
            continue
        now = min(*coming, core.next_order() or coming[0])
        released = sorted(arc for arc, hold in running.items() if arc in early and hold.start + early[arc] <= now)
        events: list[model.Event] = [*map(model.Released, released)]
        while arrivals and arrivals[0].at == now:
            events.append(model.Requested(arrivals.popleft().request))
        step(now, events or [model.Tick()])
    served = {hold.arc for hold in holds if hold.outcome in SERVED}
    holds.sort(key=lambda hold: (hold.start, hold.arc, hold.end))
    return Replay(tuple(holds), tuple(sorted(runtime.keys() - served)))
