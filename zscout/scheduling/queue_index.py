"""An index of the queue: which ARCs a pass has to check."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Iterable, Mapping
from operator import itemgetter

from zscout.scheduling.model import Arc, ArcState, Rank, Rc
from zscout.types import ArcId, Ns


class QueueIndex:
    """The queue, by what its ARCs wait for, so that a pass checks only those for whom something changed.

    - READY, VOTING and DEFERRED: the next pass checks it. So begins every ARC, and so stays every ARC under a
      strategy that keeps no index. Of one that is VOTING or DEFERRED the *footprint* is known, all that it
      would take or free: while nothing there has changed, another check would come to the same.
    - WATCHING one RC whose situation alone keeps it out: it is absent, or its holder is not preempted for it,
      or it has vetoed. Nothing that happens elsewhere can let this ARC start.
    - PARKED before an RC that does not answer: a change within its footprint makes it ready.

    Sorted lists: 10,000 ranks move in a few microseconds."""

    def __init__(self, band: Callable[[int], int]) -> None:
        self._band = band
        self.ready: dict[ArcId, Arc] = {}
        """Those that are READY, VOTING or DEFERRED."""
        self.parked: dict[ArcId, Arc] = {}
        self.watched = 0
        """Bits of the RCs that somebody watches."""
        self.freed = 0
        """Bits of the RCs whose watchers may have become possible since the last pass."""
        self.touched = 0
        """Bits of the RCs at which something else has changed: it concerns all but watchers."""
        self.retold = 0
        """Bits of the RCs that have been taken by another, which their watchers have not been told."""
        self.ranks: list[Rank] = []
        """Of all that are queued, best first."""
        self._not_starving: list[tuple[Ns, ArcId]] = []
        """Queued ARCs that are not starving, by the time since when they wait."""
        self.starving: list[tuple[int, Ns, ArcId]] = []
        """Those who have waited for too long: by band of priorities (negated), then by the same."""
        self.starving_version = 0
        """Grows when somebody starves, or does so no more."""

    def add(self, arc: Arc) -> None:
        """A newcomer."""
        insort(self.ranks, arc.rank)
        insort(self._not_starving, (arc.since + arc.late, arc.id))
        self.ready[arc.id] = arc
        arc.move_to(ArcState.READY)

    def remove(self, arc: Arc) -> None:
        """It waits no more."""
        del self.ranks[bisect_left(self.ranks, arc.rank)]
        if arc.starving:
            arc.starving = False
            self.starving_version += 1
            del self.starving[bisect_left(self.starving, self._starving_key(arc))]
        else:
            del self._not_starving[bisect_left(self._not_starving, (arc.since + arc.late, arc.id))]
        self._leave(arc)

    def mark_starving(self, since: Ns, queued: Mapping[ArcId, Arc]) -> None:
        """Who has waited since then or longer is starving from now on (`reservations.py`)."""
        count = bisect_right(self._not_starving, since, key=itemgetter(0))
        self.starving_version += count
        for _, arc_id in self._not_starving[:count]:
            queued[arc_id].starving = True
            insort(self.starving, self._starving_key(queued[arc_id]))
        del self._not_starving[:count]

    def _starving_key(self, arc: Arc) -> tuple[int, Ns, ArcId]:
        return -self._band(arc.priority), arc.since + arc.late, arc.id

    def sort(self, queued: Mapping[ArcId, Arc], rcs: Iterable[Rc]) -> None:
        """The ranks of the queued have changed, and since when they count as such; `rcs` are those that are watched.
        Who is starving is to be marked anew."""
        self._not_starving = sorted((arc.since + arc.late, arc.id) for arc in queued.values())
        for _, _, arc_id in self.starving:
            queued[arc_id].starving = False
        self.starving.clear()
        self.starving_version += 1
        self.ranks = sorted(arc.rank for arc in queued.values())
        for rc in rcs:
            rc.watchers = sorted(queued[rank[-1]].rank for rank in rc.watchers)

    def ahead(self, arc: Arc) -> int:
        """How many of the queued rank above `arc`."""
        return bisect_left(self.ranks, arc.rank)

    def watch(self, arc: Arc, rc: Rc) -> None:
        """`rc` alone keeps `arc` out."""
        if arc.watched is not rc:
            self._leave(arc)
            arc.move_to(ArcState.WATCHING)
            arc.watched = rc
            insort(rc.watchers, arc.rank)
            self.watched |= rc.bit

    def put(self, arc: Arc, state: ArcState, footprint: int | None = None, masked_obstacles: int = 0) -> None:
        """`arc` waits in this state, which is not WATCHING. READY is without a footprint."""
        self._leave(arc)
        arc.move_to(state)
        (self.parked if state is ArcState.PARKED else self.ready)[arc.id] = arc
        arc.footprint, arc.masked_obstacles = footprint, masked_obstacles

    def _leave(self, arc: Arc) -> None:
        self.ready.pop(arc.id, None)
        self.parked.pop(arc.id, None)
        arc.footprint = None
        rc, arc.watched = arc.watched, None
        if rc is not None:
            del rc.watchers[bisect_left(rc.watchers, arc.rank)]
            if not rc.watchers:
                self.watched &= ~rc.bit
