from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Iterable, Mapping
from operator import itemgetter
from typing import TypeAlias

from zscout.scheduling.model import Arc, ArcState, PatternClass, Rank, Rc
from zscout.types import ArcId, Ns

Watched: TypeAlias = Rc | PatternClass


class QueueIndex:
    """The queue by obstacle, so that a pass checks only the ARCs that a change affects.

    - READY, VOTING and DEFERRED: checked by the next pass. Every ARC begins as READY, and stays so under a strategy
      without an index. VOTING and DEFERRED have a *footprint*, the RCs that the ARC would take or free: without changes
      there, another check would end in the same way.
    - WATCHING an RC that alone keeps the ARC out: it is absent, held without preemption, or vetoes. No event elsewhere
      can let the ARC start. An ARC with patterns may, with its class, watch all RCs that its patterns match, while too
      few are usable (`patterns.short`).
    - PARKED before an RC that does not answer: a change within the footprint makes the ARC ready.

    Sorted lists are quick enough: 10,000 ranks move in a few microseconds."""

    def __init__(self, band: Callable[[int], int]) -> None:
        self._band = band
        self.ready: dict[ArcId, Arc] = {}  # READY, VOTING or DEFERRED
        self.parked: dict[ArcId, Arc] = {}
        self.watched = 0  # bits of the RCs with watchers
        self.watched_classes: dict[PatternClass, None] = {}  # classes with watchers
        self.freed = 0  # bits of the RCs that may admit watchers since the last pass
        self.touched = 0  # bits of the RCs with other changes: these affect all ARCs but watchers
        self.unreported = 0  # bits of the RCs with new holders not yet reported to watchers
        self.unreported_classes: dict[PatternClass, None] = {}
        self.contended = 0  # bits of the RCs whose holders may have another upcoming end (`upcoming.py`)
        self.ranks: list[Rank] = []  # of all queued ARCs, best first (`Arc.put_at` computes them)
        self._not_starving: list[tuple[Ns, ArcId]] = []  # queued ARCs, by when they begin to starve
        self.starving: list[tuple[int, Ns, ArcId]] = []  # by band of priorities (negated), then by when they began
        self.starving_version = 0  # grows when an ARC starts or stops starving

    def add(self, arc: Arc) -> None:
        insort(self.ranks, arc.rank)
        insort(self._not_starving, (arc.starves, arc.id))
        self.ready[arc.id] = arc
        arc.move_to(ArcState.READY)

    def remove(self, arc: Arc) -> None:
        del self.ranks[bisect_left(self.ranks, arc.rank)]
        if arc.starving:
            arc.starving = False
            self.starving_version += 1
            del self.starving[bisect_left(self.starving, self._starving_key(arc))]
        else:
            del self._not_starving[bisect_left(self._not_starving, (arc.starves, arc.id))]
        self._leave(arc)

    def mark_starving(self, now: Ns, queued: Mapping[ArcId, Arc]) -> None:
        """Mark the ARCs that have waited for half their patience as starving (`reservations.py`)."""
        count = bisect_right(self._not_starving, now, key=itemgetter(0))
        self.starving_version += count
        for _, arc_id in self._not_starving[:count]:
            queued[arc_id].starving = True
            insort(self.starving, self._starving_key(queued[arc_id]))
        del self._not_starving[:count]

    def next_starving(self, now: Ns) -> Ns | None:
        """When the next ARC begins to starve, if others do: their reservations may then move, and let ARCs pass."""
        coming = bisect_right(self._not_starving, now, key=itemgetter(0))
        return self._not_starving[coming][0] if self.starving and coming < len(self._not_starving) else None

    def _starving_key(self, arc: Arc) -> tuple[int, Ns, ArcId]:
        return -self._band(arc.priority), arc.starves, arc.id

    def sort(self, queued: Mapping[ArcId, Arc], rcs: Iterable[Rc]) -> None:
        """Rebuild the order after changes of ranks and waits; `rcs` are watched. Mark starving ARCs again."""
        self._not_starving = sorted((arc.starves, arc.id) for arc in queued.values())
        for _, _, arc_id in self.starving:
            queued[arc_id].starving = False
        self.starving.clear()
        self.starving_version += 1
        self.ranks = sorted(arc.rank for arc in queued.values())
        watched: list[Watched] = [*rcs, *self.watched_classes]
        for on in watched:
            on.watchers = sorted(queued[rank[-1]].rank for rank in on.watchers)

    def ahead(self, arc: Arc) -> int:
        return bisect_left(self.ranks, arc.rank)

    def watch(self, arc: Arc, on: Watched) -> None:
        if arc.watched is not on:
            self._leave(arc)
            arc.move_to(ArcState.WATCHING)
            arc.watched = on
            insort(on.watchers, arc.rank)
            if isinstance(on, Rc):
                self.watched |= on.bit
            else:
                self.watched_classes[on] = None

    def put(self, arc: Arc, state: ArcState, footprint: int | None = None, masked_obstacles: int = 0) -> None:
        """Put `arc` in this state; not for WATCHING. READY has no footprint."""
        self._leave(arc)
        arc.move_to(state)
        (self.parked if state is ArcState.PARKED else self.ready)[arc.id] = arc
        arc.footprint, arc.masked_obstacles = footprint, masked_obstacles

    def _leave(self, arc: Arc) -> None:
        self.ready.pop(arc.id, None)
        self.parked.pop(arc.id, None)
        arc.footprint = None
        on, arc.watched = arc.watched, None
        if on is not None:
            del on.watchers[bisect_left(on.watchers, arc.rank)]
            if isinstance(on, PatternClass) and not on.watchers:
                del self.watched_classes[on]
                self.unreported_classes.pop(on, None)
            elif isinstance(on, Rc) and not on.watchers:
                self.watched &= ~on.bit
