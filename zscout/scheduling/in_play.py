"""Who could start in a pass at all, whatever a strategy does, and who might have to end for them.

Most of a busy fleet is settled: who runs, and could only have to give way to ARCs that can't start, stays;
who needs what such a one holds waits. The others are *in play*.

The index of waiting ARCs (`waits.py`) tells whom to look at: those who are open or asleep, the watchers of
RCs at which something was freed, and, where somebody who runs may have to end, the watchers of what he holds.
All others wait for an RC that keeps them out by itself and at which nothing has changed.
"""

from __future__ import annotations

import heapq
from collections import Counter

from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, ArcId, Ns, Rank, Rc
from zscout.scheduling.patterns import bind_all
from zscout.scheduling.policy import owner_of
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.votes import Votes


def in_play(
    floor: Floor, votes: Votes, now: Ns, reserved: Reservations | None = None, limit: int | None = None
) -> list[Arc] | None:
    """Those who might start, best-ranked first, then those who might have to end; None: more than `limit`
    might start."""
    if floor.flexible:
        bind_all(floor, votes, now, reserved)
    return _Search(floor, votes, now, reserved).run(limit)


class _Search:
    def __init__(self, floor: Floor, votes: Votes, now: Ns, reserved: Reservations | None) -> None:
        self.floor, self.votes, self.now, self.reserved = floor, votes, now, reserved
        self.movable: dict[ArcId, Arc] = {}
        """Who runs and might have to end."""
        self._coming: list[tuple[Rank, int, Arc, Rc | None]] = []
        """Heap of who is next, by himself or as a watcher of an RC."""
        self._walked = 0
        """Bits of the RCs whose watchers come."""
        self._started: Counter[str] = Counter()
        """ARCs of each owner that might start, where there is a quota."""
        self._passing = 0
        """Sharable RCs at which one passes those who are owed: if a second could as well was not asked."""

    def run(self, limit: int | None) -> list[Arc] | None:
        waits = self.floor.waits
        for arc in (*waits.open.values(), *waits.asleep.values()):
            self._coming.append((arc.rank, 0, arc, None))
        heapq.heapify(self._coming)
        freed = waits.freed
        for name in self.votes.forgotten:
            freed |= self.floor.rc(name).bit
        self._call(freed, None)
        found: list[Arc] = []
        last: Rank | None = None
        while self._coming:
            rank, _, arc, rc = heapq.heappop(self._coming)
            # One may come by several ways, but then at once: ranks are unique.
            if rank != last and self._might_start(arc):
                found.append(arc)
                if limit is not None and len(found) > limit:
                    return None
                self._move_aside(arc)
            last = rank
            if rc is not None:
                self._walk_on(rc, rank)
        return [*found, *self.movable.values()]

    def _call(self, bits: int, rank: Rank | None) -> None:
        """The watchers of these RCs come, those below `rank`."""
        new = bits & self.floor.waits.watched & ~self._walked
        self._walked |= new
        for rc in self.floor.of(new):
            self._walk_on(rc, rank)

    def _walk_on(self, rc: Rc, rank: Rank | None) -> None:
        following = self.floor.waits.after(rc, rank)
        if following is not None:
            heapq.heappush(self._coming, (following, rc.bit, self.floor.queued[following[3]], rc))

    def _might_start(self, arc: Arc) -> bool:
        if arc.mask & ~self.floor.present or arc.unbound:
            return False
        for rc in arc.rcs:
            if rc.sharable:
                if self._refused(rc, arc):
                    return False
            elif any(self._stays(holder, arc) for holder in rc.holders.values()):
                return False
        return not self._held_back(arc) and self._within_quota(arc)

    def _stays(self, holder: Arc, arc: Arc) -> bool:
        return holder.id not in self.movable and not holder.yields_to(arc, self.now)

    def _refused(self, rc: Rc, arc: Arc) -> bool:
        """Whether an RC has vetoed the ARC beside those who stay in any case, or is silent about that."""
        stay = (holder.id for holder in rc.holders.values() if self._stays(holder, arc))
        answer = self.votes.known(rc.name, frozenset((*stay, arc.id)))
        return self.votes.silent(rc.name) if answer is None else not answer.accept

    def _held_back(self, arc: Arc) -> bool:
        """Whether what it would take is kept for another."""
        reserved = self.reserved
        if reserved is None or not arc.mask & reserved.bits:
            return False
        shared = arc.mask & reserved.bits & self.floor.sharable
        if shared & self._passing or reserved.bar(arc) is not None:
            return True
        if not arc.owed:
            self._passing |= shared
        return False

    def _within_quota(self, arc: Arc) -> bool:
        room = self.floor.room(arc)
        if room is not None:
            owner = owner_of(arc.request.client)
            self._started[owner] += 1
            return self._started[owner] <= room
        return True

    def _move_aside(self, arc: Arc) -> None:
        """Notes who might have to end for `arc`."""
        for rc in arc.rcs:
            for holder in rc.holders.values():
                if holder.id not in self.movable and holder.yields_to(arc, self.now):
                    self.movable[holder.id] = holder
                    self._call(holder.mask, arc.rank)
