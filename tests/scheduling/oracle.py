"""Strategy `priority` a second time: slow, obvious, and written from the design's text alone.

Votes are answered at once, nothing is remembered between visits, and every set is built anew. Whatever the
real core does faster has to come out as this does.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from zscout.lab.replay import HoldRecord, Replay
from zscout.lab.workload import Arrival, Workload, WorkloadRc
from zscout.scheduling.capacity import excess
from zscout.scheduling.model import ArcRequest, Outcome
from zscout.types import Ns, RcName


@dataclass(eq=False)
class Contender:
    """An ARC that was asked for; `start` is None while it waits."""

    request: ArcRequest
    place: int
    start: Ns | None = None

    @property
    def rank(self) -> tuple[int, Ns, int]:
        return (-self.request.priority, self.request.min_runtime, self.place)

    def end(self) -> Ns:
        """When its minimum runtime is over; only of a running one."""
        assert self.start is not None
        return self.start + self.request.min_runtime

    def past_min_runtime(self, now: Ns) -> bool:
        return self.request.keep and now >= self.end()


class Oracle:
    """All contenders, and the holds that are over."""

    def __init__(self, rcs: Iterable[WorkloadRc]) -> None:
        self.rcs: dict[RcName, WorkloadRc] = {rc.name: rc for rc in rcs}
        self.contenders: list[Contender] = []
        self.holds: list[HoldRecord] = []
        self.arrivals = 0

    def instant(self, now: Ns, asked: list[ArcRequest]) -> None:
        """First what ends, then what was asked, then one pass."""
        for one in self.running():
            if not one.request.keep and one.end() <= now:
                self.finish(one, now)
        for request in asked:
            self.arrivals += 1
            self.contenders.append(Contender(request, self.arrivals))
        self.run_pass(now)

    def running(self) -> list[Contender]:
        return [one for one in self.contenders if one.start is not None]

    def finish(self, one: Contender, now: Ns) -> None:
        self.close(one, now, Outcome.COMPLETED)
        self.contenders.remove(one)

    def close(self, one: Contender, now: Ns, outcome: Outcome) -> None:
        assert one.start is not None
        rcs = tuple(sorted(one.request.needs))
        self.holds.append(HoldRecord(one.request.arc, one.start, now, outcome, rcs))
        one.start = None

    def run_pass(self, now: Ns) -> None:
        visited: list[Contender] = []
        while True:
            queued = [one for one in self.contenders if one.start is None and one not in visited]
            if not queued:
                return
            first = min(queued, key=lambda one: one.rank)
            visited.append(first)
            self.visit(first, now)

    def visit(self, a: Contender, now: Ns) -> None:
        victims = self.victims(a, now)
        if victims is None:
            return
        for victim in victims:
            if victim.past_min_runtime(now):
                self.finish(victim, now)
            else:
                self.close(victim, now, Outcome.PREEMPTED)
        a.start = now

    def victims(self, a: Contender, now: Ns) -> list[Contender] | None:
        """Whom `a` would preempt; None when it has to wait (steps 1 to 3)."""
        if any(name not in self.rcs for name in a.request.needs):
            return None
        exclusive = {name for name in a.request.needs if not self.rcs[name].sharable}
        sharable = {name for name in a.request.needs if self.rcs[name].sharable}
        running = self.running()

        def may_displace(other: Contender) -> bool:
            if other.past_min_runtime(now):
                return a.request.priority >= other.request.priority
            return a.request.priority > other.request.priority

        blockers = [one for one in running if exclusive & set(one.request.needs)]
        if not all(may_displace(one) for one in blockers):
            return None
        candidates = [
            one for one in running if one not in blockers and sharable & set(one.request.needs) and may_displace(one)
        ]
        stay = [one for one in running if one not in blockers and one not in candidates]
        if not self.accepted(sharable, [*stay, a]):
            return None
        kept: list[Contender] = []
        for candidate in sorted(candidates, key=lambda one: one.rank):
            if self.accepted(sharable, [*stay, a, *kept, candidate]):
                kept.append(candidate)
        return blockers + [one for one in candidates if one not in kept]

    def accepted(self, sharable: set[RcName], together: list[Contender]) -> bool:
        """Whether each of these RCs would carry those of `together` that need it."""
        return all(
            not excess(
                self.rcs[name].capacity,
                [(one.request.arc, one.request.needs[name]) for one in together if name in one.request.needs],
            )
            for name in sharable
        )


def play(workload: Workload, *, one_by_one: bool = False) -> Replay:
    """Plays a workload to its end.

    `one_by_one` runs a pass after each single arrival, where otherwise all of one instant share one. A kept
    hold ends when nothing else is left to come, but not before its minimum runtime is over."""
    oracle = Oracle(workload.rcs)
    # `sorted` is stable: what asks at one instant asks in the order of the workload.
    arrivals: list[Arrival] = sorted(workload.arrivals, key=lambda arrival: arrival.at)
    now: Ns = 0
    while arrivals or oracle.running():
        running = oracle.running()
        # A kept hold's minimum runtime is an event too: from then on equal priority may displace it.
        times = [one.end() for one in running if not one.past_min_runtime(now)]
        times += [arrival.at for arrival in arrivals[:1]]
        if times:
            now = min(times)
        else:
            for one in running:
                oracle.finish(one, now)
        asked = [arrival.request for arrival in arrivals if arrival.at == now]
        arrivals = arrivals[len(asked) :]
        if one_by_one and asked:
            for request in asked:
                oracle.instant(now, [request])
        else:
            oracle.instant(now, asked)
    served = {hold.arc for hold in oracle.holds if hold.outcome is Outcome.COMPLETED}
    unserved = {arrival.request.arc for arrival in workload.arrivals} - served
    holds = sorted(oracle.holds, key=lambda hold: (hold.start, hold.arc, hold.end))
    return Replay(tuple(holds), tuple(sorted(unserved)))
