"""Who could start in a pass at all, whatever a strategy does, and who might have to end for them.

Most of a busy fleet is settled: who runs, and could only have to give way to ARCs that can't start, stays;
who needs what such a one holds waits. The others are the candidates.

The index of the queue gives whom to look at: all but watchers, the watchers of RCs at which something was
freed, and, where somebody who runs may have to end, the watchers of what it holds. All others wait for an RC
that keeps them out by itself and at which nothing has changed.
"""

from __future__ import annotations

import heapq
from collections import Counter

from zscout.config.scheduling_policy import owner_of
from zscout.scheduling.model import Arc, Rank, Rc
from zscout.scheduling.patterns import bind_all
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.state import SchedulerState
from zscout.types import ArcId


def candidates(
    state: SchedulerState, reserved: Reservations | None = None, limit: int | None = None
) -> list[Arc] | None:
    """Those who might start, best-ranked first, then those who might have to end; None: more than `limit`
    might start."""
    if state.by_pattern:
        bind_all(state, reserved)
    return _Search(state, reserved).run(limit)


class _Search:
    def __init__(self, state: SchedulerState, reserved: Reservations | None) -> None:
        self.state, self.votes, self.reserved = state, state.votes, reserved
        self.preemptible: dict[ArcId, Arc] = {}
        """Who runs and might have to end."""
        self._heap: list[tuple[Rank, int, Arc, Rc | None]] = []
        """Who is next, by itself or as a watcher of an RC."""
        self._called = 0
        """Bits of the RCs whose watchers come."""
        self._started: Counter[str] = Counter()
        """ARCs of each owner that might start, where there is a quota."""
        self._shared_taken = 0
        """Sharable RCs at which one passes those starving: whether a second could as well was not asked."""

    def run(self, limit: int | None) -> list[Arc] | None:
        index = self.state.index
        for arc in (*index.ready.values(), *index.parked.values()):
            self._heap.append((arc.rank, 0, arc, None))
        heapq.heapify(self._heap)
        freed = index.freed
        for name in self.votes.invalidated:
            freed |= self.state.rc(name).bit
        self._call_watchers(freed, None)
        found: list[Arc] = []
        last: Rank | None = None
        while self._heap:
            rank, _, arc, rc = heapq.heappop(self._heap)
            # One may come by several ways, but then at once: ranks are unique.
            if rank != last and self._might_start(arc):
                found.append(arc)
                if limit is not None and len(found) > limit:
                    return None
                self._note_preemptible(arc)
            last = rank
            if rc is not None:
                self._call_next_watcher(rc, rank)
        return [*found, *self.preemptible.values()]

    def _call_watchers(self, bits: int, rank: Rank | None) -> None:
        """The watchers of these RCs come, those below `rank`."""
        new = bits & self.state.index.watched & ~self._called
        self._called |= new
        for rc in self.state.rcs_in(new):
            self._call_next_watcher(rc, rank)

    def _call_next_watcher(self, rc: Rc, rank: Rank | None) -> None:
        following = self.state.index.next_watcher(rc, rank)
        if following is not None:
            heapq.heappush(self._heap, (following, rc.bit, self.state.queued[following[3]], rc))

    def _might_start(self, arc: Arc) -> bool:
        if arc.mask & ~self.state.present or arc.unbound:
            return False
        for rc in arc.rcs:
            if rc.sharable:
                if self._refused(rc, arc):
                    return False
            elif any(self._stays(holder, arc) for holder in rc.holders.values()):
                return False
        return not self._reserved_for_other(arc) and self._within_quota(arc)

    def _stays(self, holder: Arc, arc: Arc) -> bool:
        return holder.id not in self.preemptible and not holder.preemptible_by(arc, self.state.now)

    def _refused(self, rc: Rc, arc: Arc) -> bool:
        """Whether an RC has vetoed the ARC beside those who stay in any case, or is silent about that."""
        stay = (holder.id for holder in rc.holders.values() if self._stays(holder, arc))
        answer = self.votes.known(rc.name, frozenset((*stay, arc.id)))
        return self.votes.silent(rc.name) if answer is None else not answer.accept

    def _reserved_for_other(self, arc: Arc) -> bool:
        """Whether what it would take is kept for another."""
        reserved = self.reserved
        if reserved is None or not arc.mask & reserved.bits:
            return False
        shared = arc.mask & reserved.bits & self.state.sharable
        if shared & self._shared_taken or reserved.conflict(arc) is not None:
            return True
        if not self.state.index.is_starving(arc):
            self._shared_taken |= shared
        return False

    def _within_quota(self, arc: Arc) -> bool:
        quota_left = self.state.quota_left(arc)
        if quota_left is not None:
            owner = owner_of(arc.request.client)
            self._started[owner] += 1
            return self._started[owner] <= quota_left
        return True

    def _note_preemptible(self, arc: Arc) -> None:
        """Notes who might have to end for `arc`."""
        for rc in arc.rcs:
            for holder in rc.holders.values():
                if holder.id not in self.preemptible and holder.preemptible_by(arc, self.state.now):
                    self.preemptible[holder.id] = holder
                    self._call_watchers(holder.mask, arc.rank)
