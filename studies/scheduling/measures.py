"""Measures of a replayed workload: RCs in use, waits, preemptions, work thrown away."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from zscout.scheduling.model import Outcome
from zscout.simulation.replay import SERVED, HoldRecord, Replay
from zscout.simulation.workload import Workload
from zscout.types import ArcId, Ns, RcName


@dataclass(frozen=True, slots=True)
class Measures:
    """One run. Times in ns, shares from 0 to 1. An ARC's wait lasts until the start of the hold that it completes,
    because work in a hold that was taken away must be done again."""

    in_use: float
    """Mean share of held RCs until the last request, or until the last end if all ask at once."""
    first: float
    """Share of the RCs that are held after the first instant."""
    waits: tuple[Ns, ...]
    """Waits of the served ARCs, in the order of the workload."""
    unserved: int
    preemptions: int
    thrown_away: float
    """RC-time in holds that were taken away, divided by all held RC-time."""
    end: Ns
    """When the last hold ends."""


def measure(workload: Workload, played: Replay) -> Measures:
    arrivals = workload.arrivals
    asked = {arrival.request.arc: arrival.at for arrival in arrivals}
    served: dict[ArcId, Ns] = {}
    held = wasted = preemptions = 0
    for hold in played.holds:
        work = (hold.end - hold.start) * len(hold.rcs)
        held += work
        if hold.outcome in SERVED:
            served[hold.arc] = hold.start
        elif hold.outcome is Outcome.PREEMPTED:
            wasted += work
            preemptions += 1
    begin, last = min(asked.values(), default=0), max(asked.values(), default=0)
    end = max((hold.end for hold in played.holds), default=begin)
    until = last if last > begin else end
    busy = sum(
        max(0, min(stop, until) - max(start, begin))
        for spans in spans_in_use(played.holds).values()
        for start, stop in spans
    )
    return Measures(
        in_use=busy / ((until - begin) * len(workload.rcs)) if until > begin else 0.0,
        first=len({rc for hold in played.holds if hold.start <= begin < hold.end for rc in hold.rcs})
        / len(workload.rcs),
        waits=tuple(served[arc] - at for arc, at in asked.items() if arc in served),
        unserved=len(played.unserved),
        preemptions=preemptions,
        thrown_away=wasted / held if held else 0.0,
        end=end,
    )


def spans_in_use(holds: Iterable[HoldRecord]) -> dict[RcName, list[tuple[Ns, Ns]]]:
    """The spans in which each RC has a holder, in order; spans neither overlap nor touch."""
    found: defaultdict[RcName, list[tuple[Ns, Ns]]] = defaultdict(list)
    for hold in sorted(holds, key=lambda hold: hold.start):
        for rc in hold.rcs:
            spans = found[rc]
            if spans and spans[-1][1] >= hold.start:
                spans[-1] = (spans[-1][0], max(spans[-1][1], hold.end))
            else:
                spans.append((hold.start, hold.end))
    return found


@dataclass(frozen=True, slots=True)
class Curve:
    """A run over time: the numbers of held RCs and of waiting ARCs from each of `times` (ns) on."""

    times: tuple[Ns, ...]
    used: tuple[int, ...]
    waiting: tuple[int, ...]


def curve(workload: Workload, played: Replay) -> Curve:
    changes: defaultdict[Ns, list[int]] = defaultdict(lambda: [0, 0])
    for spans in spans_in_use(played.holds).values():
        for start, stop in spans:
            changes[start][0] += 1
            changes[stop][0] -= 1
    for arrival in workload.arrivals:
        changes[arrival.at][1] += 1
    for hold in played.holds:
        changes[hold.start][1] -= 1
        if hold.outcome not in SERVED:
            changes[hold.end][1] += 1
    times = sorted(changes)
    return Curve(
        tuple(times),
        tuple(itertools.accumulate(changes[time][0] for time in times)),
        tuple(itertools.accumulate(changes[time][1] for time in times)),
    )


def percentile(values: Sequence[float], share: float) -> float:
    """The smallest of `values` that `share` (0 to 1) of them do not exceed; 0 if there are none."""
    ordered = sorted(values)
    if not ordered:
        return 0.0
    return ordered[min(len(ordered) - 1, max(0, -int(-share * len(ordered) // 1) - 1))]
