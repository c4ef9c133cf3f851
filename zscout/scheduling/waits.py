"""The queue, indexed by what its ARCs wait for, so that a pass looks only at whom something has changed for.

A queued ARC is in exactly one of three states:

- *open*: the next pass looks at it whatever happens. So begins everyone, and so stays who waits for votes
  or for another's open visit, and everyone under a strategy that keeps no index.
- *watching* one RC (`Arc.watched`) whose situation alone keeps it out: it is absent, or its holder does not
  yield, or it has vetoed. Nothing that happens elsewhere can let this ARC start.
- *asleep* before a silent RC: anything that stirs within its footprint wakes it.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Mapping
from operator import itemgetter

from zscout.scheduling.model import Arc, ArcId, Ns, Rank, Rc


class Waits:
    """Whom to look at when something changes. Sorted lists: 10,000 ranks move in a few microseconds."""

    def __init__(self) -> None:
        self.open: dict[ArcId, Arc] = {}
        self.asleep: dict[ArcId, Arc] = {}
        self.watched = 0
        """Bits of the RCs that somebody watches."""
        self.freed = 0
        """Bits of the RCs whose watchers may have become possible since the last pass."""
        self.stirred = 0
        """Bits of the RCs at which something else has changed: it concerns those asleep or open."""
        self.ranks: list[Rank] = []
        """Of all that are queued, best first."""
        self._patient: list[tuple[Ns, ArcId]] = []
        """Those who wait and are not owed yet, by the time since when they do."""
        self.owed_changes = 0
        """Grows when somebody is owed, or is so no more."""
        self.owed: list[tuple[int, Ns, ArcId]] = []
        """The others: by band of priorities (negated), then by the same."""

    def add(self, arc: Arc) -> None:
        """A newcomer, open."""
        insort(self.ranks, arc.rank)
        insort(self._patient, (arc.since, arc.id))
        self.open[arc.id] = arc

    def remove(self, arc: Arc) -> None:
        """It waits no more."""
        del self.ranks[bisect_left(self.ranks, arc.rank)]
        if arc.owed:
            arc.owed = False
            self.owed_changes += 1
            del self.owed[bisect_left(self.owed, _claim(arc))]
        else:
            del self._patient[bisect_left(self._patient, (arc.since, arc.id))]
        self._leave(arc)

    def ripen(self, since: Ns, queued: Mapping[ArcId, Arc]) -> None:
        """Who has waited since then or longer is owed from now on."""
        ripe = bisect_right(self._patient, since, key=itemgetter(0))
        self.owed_changes += ripe
        for _, arc_id in self._patient[:ripe]:
            arc = queued[arc_id]
            arc.owed = True
            insort(self.owed, _claim(arc))
        del self._patient[:ripe]

    def ahead(self, arc: Arc) -> int:
        """How many of the queued rank above `arc`."""
        return bisect_left(self.ranks, arc.rank)

    def after(self, rc: Rc, rank: Rank | None) -> Rank | None:
        """The best of the watchers of `rc` below `rank`; of all of them without a rank."""
        at = 0 if rank is None else bisect_right(rc.watchers, rank)
        return rc.watchers[at] if at < len(rc.watchers) else None

    def watch(self, arc: Arc, rc: Rc) -> None:
        """`rc` alone keeps `arc` out."""
        if arc.watched is not rc:
            self._leave(arc)
            arc.watched = rc
            insort(rc.watchers, arc.rank)
            self.watched |= rc.bit

    def sleep(self, arc: Arc, footprint: int) -> None:
        """`arc` waits for nobody but a silent RC; whatever happens within `footprint` concerns it."""
        self._leave(arc)
        arc.footprint = footprint
        self.asleep[arc.id] = arc

    def reopen(self, arc: Arc, footprint: int = 0, *, hidden: int = 0, asked: bool = False) -> None:
        """The next pass looks at `arc`: briefly, if nothing has changed within `footprint`."""
        if arc.id not in self.open:
            self._leave(arc)
            self.open[arc.id] = arc
        arc.footprint, arc.hidden, arc.asked = footprint, hidden, asked

    def _leave(self, arc: Arc) -> None:
        self.open.pop(arc.id, None)
        self.asleep.pop(arc.id, None)
        rc, arc.watched = arc.watched, None
        arc.footprint = 0
        if rc is not None:
            del rc.watchers[bisect_left(rc.watchers, arc.rank)]
            if not rc.watchers:
                self.watched &= ~rc.bit

    def validate(self, queued: dict[ArcId, Arc]) -> list[str]:
        """Breaches of the three states, in words; for tests."""
        found = []
        if self.ranks != sorted(arc.rank for arc in queued.values()):
            found.append("the ranks are not those of the queue")
        if self._patient != sorted((arc.since, arc.id) for arc in queued.values() if not arc.owed):
            found.append("the patient are not those of the queue")
        if self.owed != sorted(_claim(arc) for arc in queued.values() if arc.owed):
            found.append("the owed are not those of the queue")
        for arc in queued.values():
            states = (arc.id in self.open) + (arc.id in self.asleep) + (arc.watched is not None)
            if states != 1:
                found.append(f"{arc.id} is in {states} states of waiting")
            if arc.watched is not None and arc.rank not in arc.watched.watchers:
                found.append(f"{arc.watched.name} does not know that {arc.id} watches it")
        return found


def _claim(arc: Arc) -> tuple[int, Ns, ArcId]:
    return -arc.band, arc.since, arc.id
