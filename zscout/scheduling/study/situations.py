"""How often a strategy is degenerate: one instant at a time, against the best that could be done there.

A *situation* is an instant at which somebody still waits when the pass is over. What stood before the pass
is given to a core with strategy `optimal`; both outcomes are then compared as the design does: (ARC, RC)
pairs in use by priority, highest first. `Situation.behind`: the strategy's outcome is the lesser one.
"""

from __future__ import annotations

import functools
import itertools
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from zscout.scheduling.core import Core
from zscout.scheduling.effects import Propose
from zscout.scheduling.events import Event, LeadTaken, RcJoined, Standing, Vote, Waiting
from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, Ns, RcName, Term
from zscout.scheduling.priority import Strategy
from zscout.scheduling.workload import WorkloadRc, excess

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
"""What is known of a situation without searching, in the order of `Situation.features`:

- waiting: ARCs in the queue before the pass;
- pressure: RCs that they need, counted for each, by RCs in all;
- mean width: RCs that one of them needs;
- levels: different priorities among them;
- sharable needs: share of what they need that is sharable;
- free before: exclusive RCs that nobody held, by exclusive RCs in all;
- startable: those among them whose exclusive RCs are free, or held by lower priority;
- clashes: pairs of startable ones that need the same exclusive RC;
- narrow first: RCs by which the best-ranked startable one is narrower than the widest that it clashes with;
- unreached: exclusive RCs that a startable one needs and nobody holds after the pass.
"""

TERM: Final = Term(1_000_000_000, "study")


@dataclass(frozen=True, slots=True)
class Situation:
    """One instant: pairs in use after the strategy's pass and after the best one, in all levels together."""

    features: tuple[float, ...]
    used: int
    best: int
    behind: bool

    @property
    def ratio(self) -> float:
        """What is in use by what could be; above 1 where the best set serves higher priorities with fewer."""
        return self.used / self.best if self.best else 1.0


@dataclass(frozen=True, slots=True)
class _Before:
    now: Ns
    running: tuple[Standing, ...]
    queued: tuple[Waiting, ...]
    features: tuple[float, ...]
    within_reach: int
    """Bits of the exclusive RCs that a startable ARC needs."""


class Observer:
    """Looks at the floor before and after each pass, and judges every situation against the best.

    Call `before` and `after` around each pass, and `close` at the end."""

    def __init__(self, rcs: Sequence[WorkloadRc], best: Strategy) -> None:
        self.rcs = rcs
        self.capacity = {rc.name: rc.capacity for rc in rcs if rc.sharable}
        self.best = best
        self.found: list[Situation] = []
        self._before: _Before | None = None
        self._pairs: Counter[int] = Counter()
        self._unreached = 0
        self._waits = False

    def before(self, floor: Floor, now: Ns) -> None:
        if self._before is not None and self._before.now == now:
            return  # votes came: the instant goes on
        self.close()
        running = tuple(
            Standing(arc.request, arc.place, arc.hold.grant, arc.hold.start, arc.hold.end, arc.bound)
            for arc in floor.running.values()
            if arc.hold is not None
        )
        queued = tuple(Waiting(arc.request, arc.place) for arc in floor.queued.values())
        features, within_reach = _features(floor)
        self._before = _Before(now, running, queued, features, within_reach)

    def after(self, floor: Floor) -> None:
        self._pairs = _pairs(floor.running.values())
        self._waits = bool(floor.queued)
        if self._before is not None:
            self._unreached = (self._before.within_reach & ~floor.busy).bit_count()

    def close(self) -> None:
        """Judges the instant that is over."""
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
        batch: list[Event] = [LeadTaken(TERM, before.running, before.queued)]
        while batch:
            batch = votes(core, before.now, batch, self.capacity)
        return _pairs(core.floor.running.values())


def votes(
    core: Core, now: Ns, batch: Iterable[Event], capacity: Mapping[RcName, Mapping[str, Fraction]]
) -> list[Event]:
    """Hands a batch to the core; returns what the sharable RCs answer to what it asks."""
    answers: list[Event] = []
    for effect in core.handle(now, *batch):
        if isinstance(effect, Propose):
            reason = excess(capacity[effect.rc], effect.holders.items())
            answers.append(Vote(effect.proposal, accept=not reason, reason=reason))
    return answers


def _pairs(running: Iterable[Arc]) -> Counter[int]:
    """(ARC, RC) pairs in use by priority."""
    pairs: Counter[int] = Counter()
    for arc in running:
        pairs[arc.request.priority] += arc.mask.bit_count()
    return pairs


def _features(floor: Floor) -> tuple[tuple[float, ...], int]:
    """All of `FEATURES` that are known before the pass, and the RCs within reach. The queue is not empty."""
    queued = sorted(floor.queued.values(), key=lambda arc: arc.rank)
    widths = [arc.mask.bit_count() for arc in queued]
    priorities = {arc.request.priority for arc in queued}
    exclusive = floor.present & ~floor.sharable
    firm = dict.fromkeys(priorities, 0)
    for level in priorities:
        for holder in floor.running.values():
            if holder.request.priority >= level:
                firm[level] |= holder.mask & exclusive
    startable = [arc.mask & exclusive for arc in queued if not arc.mask & firm[arc.request.priority]]
    clashes = sum(bool(one & other) for one, other in itertools.combinations(startable, 2))
    rivals = [mask.bit_count() for mask in startable if mask & startable[0]]
    features = (
        float(len(queued)),
        sum(widths) / len(floor.rcs),
        statistics.fmean(widths),
        float(len(priorities)),
        sum((arc.mask & floor.sharable).bit_count() for arc in queued) / sum(widths),
        (exclusive & ~floor.busy).bit_count() / max(1, exclusive.bit_count()),
        float(len(startable)),
        float(clashes),
        float(max(rivals) - startable[0].bit_count()) if rivals else 0.0,
    )
    return features, functools.reduce(int.__or__, startable, 0)
