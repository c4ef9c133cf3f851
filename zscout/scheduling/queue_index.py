"""The queue, indexed by what its ARCs wait for, so that a pass checks only those for whom something changed.

- READY, VOTING and DEFERRED: the next pass checks it. So begins everyone, and so stays everyone under a
  strategy that keeps no index. Of one that is VOTING or DEFERRED the *footprint* is known, all that it would
  take or free: while nothing there has changed, another check would come to the same.
- WATCHING one RC whose situation alone keeps it out: it is absent, or its holder is not preempted for it, or
  it has vetoed. Nothing that happens elsewhere can let this ARC start.
- PARKED before an RC that does not answer: a change within its footprint makes it ready.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Mapping
from operator import itemgetter

from zscout.scheduling.model import Arc, ArcState, Rank, Rc
from zscout.types import ArcId, Ns


class QueueIndex:
    """Whom to check when something changes. Sorted lists: 10,000 ranks move in a few microseconds."""

    def __init__(self, band: Callable[[int], int]) -> None:
        self._band = band
        """Which priorities wait for each other (`SchedulingPolicy.band`)."""
        self.ready: dict[ArcId, Arc] = {}
        """Those that are READY, VOTING or DEFERRED."""
        self.parked: dict[ArcId, Arc] = {}
        self.watching: dict[ArcId, Rc] = {}
        self.footprints: dict[ArcId, int] = {}
        """Bits of the RCs that those VOTING, DEFERRED or PARKED would take or free."""
        self.hidden: dict[ArcId, int] = {}
        """Of those VOTING or DEFERRED: bits of the RCs with an obstacle under what was off limits."""
        self.watched = 0
        """Bits of the RCs that somebody watches."""
        self.freed = 0
        """Bits of the RCs whose watchers may have become possible since the last pass."""
        self.touched = 0
        """Bits of the RCs at which something else has changed: it concerns all but watchers."""
        self.ranks: list[Rank] = []
        """Of all that are queued, best first."""
        self._patient: list[tuple[Ns, ArcId]] = []
        """Those who are not starving, by the time since when they wait."""
        self.starving: list[tuple[int, Ns, ArcId]] = []
        """Those who have waited for too long: by band of priorities (negated), then by the same."""
        self._starving: dict[ArcId, tuple[int, Ns, ArcId]] = {}
        self.starving_version = 0
        """Grows when somebody starves, or does so no more."""

    def add(self, arc: Arc) -> None:
        """A newcomer."""
        insort(self.ranks, arc.rank)
        insort(self._patient, (arc.since, arc.id))
        self.ready[arc.id] = arc
        arc.move_to(ArcState.READY)

    def remove(self, arc: Arc) -> None:
        """It waits no more."""
        del self.ranks[bisect_left(self.ranks, arc.rank)]
        if (entry := self._starving.pop(arc.id, None)) is not None:
            self.starving_version += 1
            del self.starving[bisect_left(self.starving, entry)]
        else:
            del self._patient[bisect_left(self._patient, (arc.since, arc.id))]
        self._leave(arc)

    def mark_starving(self, since: Ns, queued: Mapping[ArcId, Arc]) -> None:
        """Who has waited since then or longer is starving from now on (`reservations.py`)."""
        count = bisect_right(self._patient, since, key=itemgetter(0))
        self.starving_version += count
        for waits_since, arc_id in self._patient[:count]:
            entry = (-self._band(queued[arc_id].priority), waits_since, arc_id)
            self._starving[arc_id] = entry
            insort(self.starving, entry)
        del self._patient[:count]

    def is_starving(self, arc: Arc) -> bool:
        return arc.id in self._starving

    def ahead(self, arc: Arc) -> int:
        """How many of the queued rank above `arc`."""
        return bisect_left(self.ranks, arc.rank)

    def next_watcher(self, rc: Rc, rank: Rank | None) -> Rank | None:
        """The best of the watchers of `rc` below `rank`; of all of them without a rank."""
        at = 0 if rank is None else bisect_right(rc.watchers, rank)
        return rc.watchers[at] if at < len(rc.watchers) else None

    def watch(self, arc: Arc, rc: Rc) -> None:
        """`rc` alone keeps `arc` out."""
        if self.watching.get(arc.id) is not rc:
            self._leave(arc)
            arc.move_to(ArcState.WATCHING)
            self.watching[arc.id] = rc
            insort(rc.watchers, arc.rank)
            self.watched |= rc.bit

    def park(self, arc: Arc, footprint: int) -> None:
        """Nothing but an RC that does not answer keeps `arc` out."""
        self._leave(arc)
        arc.move_to(ArcState.PARKED)
        self.parked[arc.id] = arc
        self.footprints[arc.id] = footprint

    def make_ready(self, arc: Arc) -> None:
        """The next pass checks `arc`, whatever happens."""
        self._leave(arc)
        arc.move_to(ArcState.READY)
        self.ready[arc.id] = arc

    def defer(self, arc: Arc, state: ArcState, footprint: int, hidden: int) -> None:
        """The check of `arc` can't be decided yet; `state` (VOTING or DEFERRED) says why."""
        if arc.id not in self.ready:
            self._leave(arc)
            self.ready[arc.id] = arc
        arc.move_to(state)
        self.footprints[arc.id], self.hidden[arc.id] = footprint, hidden

    def _leave(self, arc: Arc) -> None:
        self.ready.pop(arc.id, None)
        self.parked.pop(arc.id, None)
        if self.footprints.pop(arc.id, None) is not None:
            self.hidden.pop(arc.id, None)
        rc = self.watching.pop(arc.id, None)
        if rc is not None:
            del rc.watchers[bisect_left(rc.watchers, arc.rank)]
            if not rc.watchers:
                self.watched &= ~rc.bit
