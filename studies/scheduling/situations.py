"""How often a strategy is degenerate: each instant compared with the best result possible there.

A *situation* is an instant after whose pass an ARC still waits. The state before the pass is given to a core with
strategy `optimal`, and both outcomes are compared as in the design: (ARC, RC) pairs in use by priority, highest first.
`Situation.behind`: the strategy's outcome is worse.
"""

from __future__ import annotations

import functools
import itertools
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from zscout.scheduling.capacity import excess
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import Arc, ArcStatus, LeadTaken, Propose, RcJoined, RecoveredHold, Requested, Vote
from zscout.scheduling.state import SchedulerState, Strategy
from zscout.simulation.workload import WorkloadRc
from zscout.types import Ns, Term

FEATURES: Final = (
    "waiting",
    "pressure",
    "mean width",
    "levels",
    "sharable needs",
    "free before",
    "startable",
    "clashes",
    "narrow first",
    "unreached",
)
"""Features of a situation that need no search, in the order of `Situation.features`:

- waiting: ARCs in the queue before the pass;
- pressure: sum of the RCs that they need, divided by the number of RCs;
- mean width: mean number of RCs that they need;
- levels: number of different priorities among them;
- sharable needs: share of sharable RCs in their needs;
- free before: share of exclusive RCs without a holder;
- startable: waiting ARCs whose exclusive RCs are free, or held by lower priority;
- clashes: pairs of startable ARCs that need the same exclusive RC;
- narrow first: RCs by which the best-ranked startable ARC is narrower than the widest ARC that it clashes with;
- unreached: exclusive RCs that a startable ARC needs, without a holder after the pass.
"""

TERM: Final = Term(1_000_000_000, "study")


@dataclass(frozen=True, slots=True)
class Situation:
    """An instant: pairs in use after the strategy's pass and after the best pass, of all levels together."""

    features: tuple[float, ...]
    used: int
    best: int
    behind: bool

    @property
    def ratio(self) -> float:
        """Pairs in use divided by the best; above 1 if the best set serves higher priorities with fewer pairs."""
        return self.used / self.best if self.best else 1.0


@dataclass(frozen=True, slots=True)
class _Before:
    now: Ns
    running: tuple[RecoveredHold, ...]
    queued: tuple[Requested, ...]
    features: tuple[float, ...]
    within_reach: int
    """Bits of the exclusive RCs that a startable ARC needs."""


class Observer:
    """Compares every situation with the best. Call `before` and `after` around each pass, and `close` at the end."""

    def __init__(self, rcs: Sequence[WorkloadRc], best: Strategy) -> None:
        self.rcs = rcs
        self.capacity = {rc.name: rc.capacity for rc in rcs if rc.sharable}
        self.best = best
        self.found: list[Situation] = []
        self._before: _Before | None = None
        self._pairs: Counter[int] = Counter()
        self._unreached = 0
        self._waits = False

    def before(self, state: SchedulerState, now: Ns) -> None:
        if self._before is not None and self._before.now == now:
            return  # after votes: still the same instant
        self.close()
        running = tuple(
            RecoveredHold(arc.request, arc.place, arc.hold.grant, arc.hold.start, arc.hold.end, arc.bound)
            for arc in state.running.values()
            if arc.hold is not None
        )
        queued = tuple(Requested(arc.request, arc.place) for arc in state.queued.values())
        features, within_reach = _features(state)
        self._before = _Before(now, running, queued, features, within_reach)

    def after(self, state: SchedulerState) -> None:
        self._pairs = _pairs(state.running.values())
        self._waits = bool(state.queued)
        if self._before is not None:
            self._unreached = (self._before.within_reach & ~state.busy).bit_count()

    def close(self) -> None:
        """Judge the instant that is over."""
        before, self._before = self._before, None
        if before is None or not self._waits:
            return
        best = self._pairs_at_best(before)
        levels = sorted({*best, *self._pairs}, reverse=True)
        behind = [self._pairs[level] for level in levels] < [best[level] for level in levels]
        features = (*before.features, float(self._unreached))
        self.found.append(Situation(features, self._pairs.total(), best.total(), behind))

    def _pairs_at_best(self, before: _Before) -> Counter[int]:
        core = Core(self.best)
        core.handle(before.now, *(RcJoined(rc.name, rc.sharable) for rc in self.rcs))
        lead = LeadTaken(TERM, before.running, before.queued)
        for _ in play_instant(core, before.now, [lead], self._vote):
            pass
        return _pairs(core.status(0).running)

    def _vote(self, asked: Propose) -> Vote:
        reason = excess(self.capacity[asked.rc], asked.holders.items())
        return Vote(asked.proposal, accept=not reason, reason=reason)


def _pairs(running: Iterable[Arc | ArcStatus]) -> Counter[int]:
    """(ARC, RC) pairs in use by priority."""
    pairs: Counter[int] = Counter()
    for arc in running:
        pairs[arc.request.priority] += len(arc.needs)
    return pairs


def _features(state: SchedulerState) -> tuple[tuple[float, ...], int]:
    """All of `FEATURES` that are known before the pass, and the RCs within reach. The queue is not empty."""
    queued = sorted(state.queued.values(), key=lambda arc: arc.rank)
    widths = [arc.mask.bit_count() for arc in queued]
    priorities = {arc.request.priority for arc in queued}
    exclusive = state.present & ~state.sharable
    firm = dict.fromkeys(priorities, 0)
    for level in priorities:
        for holder in state.running.values():
            if holder.request.priority >= level:
                firm[level] |= holder.mask & exclusive
    startable = [arc.mask & exclusive for arc in queued if not arc.mask & firm[arc.request.priority]]
    clashes = sum(bool(first & second) for first, second in itertools.combinations(startable, 2))
    rivals = [mask.bit_count() for mask in startable if mask & startable[0]]
    features = (
        float(len(queued)),
        sum(widths) / len(state.rcs),
        statistics.fmean(widths),
        float(len(priorities)),
        sum((arc.mask & state.sharable).bit_count() for arc in queued) / sum(widths),
        (exclusive & ~state.busy).bit_count() / max(1, exclusive.bit_count()),
        float(len(startable)),
        float(clashes),
        float(max(rivals) - startable[0].bit_count()) if rivals else 0.0,
    )
    return features, functools.reduce(int.__or__, startable, 0)
