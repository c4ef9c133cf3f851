"""A dry run of `priority` by its steps, for the bindings of a pass: unknown votes count as yes, and nothing changes.

ARCs with patterns that start in the run may still move to other RCs. If their exclusive RCs keep a lower rank out, they
are rebound along augmenting paths (Kuhn's algorithm), to RCs that are free or were freed in this run. So no ARC waits
if other bindings of the starting ARCs would let it start; for ARCs with one need each, taken in rank order, this gives
the lexicographically best set (a transversal matroid). Running ARCs never move, and a path ends only holds that end for
the ARC itself.

The pass itself tries each ARC's planned binding first, by the usual rules. A binding planned on an unknown vote waits
for it, if another answer could change a binding."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from typing import Any, Final, NamedTuple

from zscout.scheduling.admission import Admissible, AdmissionCheck, judge, judge_bindings
from zscout.scheduling.claim_index import bits
from zscout.scheduling.model import Arc, Hold, PatternClass, Rank, Rc, union
from zscout.scheduling.patterns import choices, class_of, short
from zscout.scheduling.queue_index import Watched
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import HolderSet
from zscout.types import NO_TERM, ArcId, Grant, Need, RcName

MAX_PATHS: Final = 200
"""Searches for paths in a run."""

_versions = itertools.count(-2, -1)
"""Versions of the state in dry runs: negative, so that results cached in a dry run never serve a real state."""


class BindingPlan(NamedTuple):
    bound: Mapping[ArcId, Mapping[Need, RcName]] = {}  # by ARC with patterns that starts
    started: Set[ArcId] = frozenset()
    ended: Set[ArcId] = frozenset()  # running ARCs; some restart on other RCs
    dropped: Set[ArcId] = frozenset()  # ARCs granted at this instant, or in `starting`, that others may end
    mask: int = 0  # bits of the RCs of all `started`
    moved: int = 0  # bits of the RCs of ARCs in both `started` and `ended`
    unknown: Sequence[tuple[Rc, HolderSet]] = ()  # the votes counted as yes on which bindings may depend
    off_limits: int = 0  # bits of the RCs that wait for the `unknown` votes,
    since: Rank | None = None  # closed to this rank and lower ranks


NO_PLAN: Final = BindingPlan()


def dry_run(
    state: SchedulerState, reserved: Reservations | None, starting: Iterable[Arc] = (), ending: Iterable[Arc] = ()
) -> BindingPlan:
    """The plan of a pass of `priority` that follows these starts and ends; NO_PLAN if no ARC has a pattern."""
    by_pattern = state.by_pattern or state.running_by_pattern
    return _DryRun(state, reserved).play(starting, ending) if by_pattern else NO_PLAN


class _DryRun:
    def __init__(self, state: SchedulerState, reserved: Reservations | None) -> None:
        self.state, self.reserved = state, reserved
        self._started: dict[ArcId, Arc] = {}
        self._ended: dict[ArcId, tuple[Arc, Hold, Mapping[Need, RcName]]] = {}
        self._dropped: set[ArcId] = set()
        self._holders: dict[int, dict[ArcId, Arc]] = {}  # by bit: as before the run
        self._heap: list[tuple[Rank, int, Arc, Watched | None]] = []
        self._walked: set[Watched] = set()
        self._movable = 0  # bits of the exclusive RCs that started ARCs have by pattern
        self._paths = 0
        self._failed: dict[PatternClass, int] = {}  # by class: the version in which a member found no path
        self._may_end: dict[int, bool] = {}  # by priority: True if some hold may end for it
        self._presumed: dict[ArcId, tuple[int, list[tuple[Rc, HolderSet]]]] = {}
        """By started ARC: bits of the RCs that it takes and frees, and the votes counted as yes for it."""

    def play(self, starting: Iterable[Arc], ending: Iterable[Arc]) -> BindingPlan:
        state = self.state
        version, busy = state.version, state.busy
        owners = state.running_by_owner.copy(), state.held_by_owner.copy()
        try:
            for victim in ending:
                self._end(victim)
            for arc in starting:
                self._start(arc)
            self._run()
            started = self._started.values()
            bound = {arc.id: arc.bound for arc in started if arc.patterns}
            mask, moved = union(arc.mask for arc in started), self._started.keys() & self._ended.keys()
            plan = BindingPlan(bound, self._started.keys(), self._ended.keys(), frozenset(self._dropped), mask)
            plan = plan._replace(moved=union(self._started[arc].mask for arc in moved))
            return plan._replace(**self._depends()) if self._presumed else plan
        finally:
            for arc in self._started.values():
                arc.hold = None
            for bit, holders in self._holders.items():
                state.rc_of(bit).holders = holders
            for arc, hold, was in self._ended.values():
                arc.hold, arc.like = hold, None
                state.bind(arc, was)
            state.version, state.busy = version, busy
            state.running_by_owner, state.held_by_owner = owners

    def _depends(self) -> dict[str, Any]:
        """The plan's fields for presumed votes on which bindings may depend, and bits of the RCs that these decide."""
        exclusive, started = ~self.state.sharable, self._started.values()
        reach = {arc.id: (arc.mask | class_of(arc).reach) & exclusive for arc in started if arc.patterns}
        found, off_limits = list[tuple[Rc, HolderSet]](), 0
        for arc_id, (mask, votes) in self._presumed.items():
            if any(mask & exclusive & other for other in reach.values()):
                off_limits |= mask & exclusive | reach.get(arc_id, 0)
                found += votes
        before = 0
        while found and off_limits != before:
            before = off_limits
            off_limits |= union(mask for mask in reach.values() if mask & before)
        # Operators don't wait for the votes of others.
        waiting = (
            arc for arc in started if reach.get(arc.id, 0) & off_limits and not self.state.operator(arc.priority)
        )
        since = min((arc.rank for arc in waiting), default=None)
        return {"unknown": found, "off_limits": off_limits, "since": since} if since is not None else {}

    def _run(self) -> None:
        state, index, heap = self.state, self.state.index, self._heap
        heap += [(arc.rank, 0, arc, None) for arc in (*index.ready.values(), *index.parked.values())]
        heapq.heapify(heap)
        self._queue_watchers(index.freed | union(state.rc(name).bit for name in state.votes.invalidated), None)
        last: Rank | None = None
        while heap:
            rank, _, arc, on = heapq.heappop(heap)
            if on is not None and self._is_held(on, arc):
                self._walked.discard(on)
                continue
            # An ARC may be queued twice in the heap; duplicates are adjacent because ranks are unique.
            if rank != last and arc.hold is None:
                self._check(arc)
            last = rank
            if on is not None:
                self._queue_next_watcher(on, rank)

    def _queue_watchers(self, bits: int, rank: Rank | None) -> None:
        for on in self.state.watched_at(bits):
            if on not in self._walked:
                self._walked.add(on)
                self._queue_next_watcher(on, rank)

    def _queue_next_watcher(self, on: Watched, rank: Rank | None) -> None:
        following = self.state.next_watcher(on, rank)
        if following is None:
            self._walked.discard(on)
        else:
            heapq.heappush(self._heap, following)

    def _is_held(self, on: Watched, arc: Arc) -> bool:
        """Return True if no watcher of `on` from `arc` on can start: `on` is held again, and no path frees it."""
        if isinstance(on, Rc):
            held, reach = not on.sharable and bool(on.non_preemptible_holders(arc, self.state.now)), on.bit
        else:
            held, reach = short(self.state, arc), on.reach
        return held and not (reach & self._movable and self._has_paths(arc))

    def _has_paths(self, arc: Arc) -> bool:
        """Return False if no path can free an RC for `arc`: nothing is free or may end, or its class found none."""
        state = self.state
        if arc.like is not None and self._failed.get(arc.like) == state.version:
            return False
        if state.present & ~state.sharable & ~state.busy:
            return True
        if arc.priority not in self._may_end:
            holders = (other for other in state.running.values() if other.id not in self._ended)
            self._may_end[arc.priority] = any(other.preemptible_by(arc, state.now) for other in holders)
        return self._may_end[arc.priority]

    def _check(self, arc: Arc) -> None:
        state = self.state
        if not arc.patterns and state.closed_to(arc):
            return
        verdict = None
        if not arc.patterns:
            verdict = judge(AdmissionCheck(state, arc, presume=True), self.reserved)
        elif not short(state, arc):
            verdict = judge_bindings(state, arc, self.reserved, presume=True)
        found = verdict if isinstance(verdict, Admissible) else None
        if self._movable and (found is None or found.victims) and self._has_paths(arc):
            bound = arc.bound
            if self._start_by_moving(arc, may_preempt=False) or (
                found is None and self._start_by_moving(arc, may_preempt=True)
            ):
                return
            state.bind(arc, bound)
            if arc.like is not None and not (arc.like.reach | arc.named_mask) & state.sharable:
                self._failed[arc.like] = state.version
        if found is not None:
            self._take(arc, found)

    def _take(self, arc: Arc, admissible: Admissible) -> None:
        victims = admissible.victims
        if admissible.presumed:
            self._presumed[arc.id] = union(other.mask for other in (arc, *victims)), admissible.presumed
            for rc, holders in admissible.presumed:
                sharers = (rc.holders[holder] for holder in holders & rc.holders.keys())
                self._drop(sharer for sharer in sharers if sharer.preemptible_by(arc, self.state.now))
        self._drop(victims)
        for victim in victims:
            self._end(victim)
        self._start(arc)
        for victim in victims:
            self._queue_watchers(victim.mask, arc.rank)

    def _end(self, arc: Arc) -> None:
        """End a hold; its ARC may restart on other RCs by its patterns."""
        assert arc.hold is not None  # noqa: S101
        if arc.patterns and not arc.past_min_runtime(self.state.now) and not self.state.is_barred(arc):
            arc.like = arc.like or self.state.class_for(arc)
            heapq.heappush(self._heap, (arc.rank, 0, arc, None))
        if self._started.pop(arc.id, None) is None:
            self._ended[arc.id] = arc, arc.hold, arc.bound
        self._leave(arc)

    def _drop(self, arcs: Iterable[Arc]) -> None:
        """Note which of these ending ARCs were granted at this instant."""
        self._dropped |= {arc.id for arc in arcs if arc.hold is not None and arc.hold.start == self.state.now}

    def _start(self, arc: Arc) -> None:
        self._started[arc.id] = arc
        self._enter(arc)

    def _enter(self, arc: Arc) -> None:
        state = self.state
        arc.hold = state.hold(arc, Grant(NO_TERM, 0), state.now, arc.ends(state.now))
        for rc in arc.rcs:
            self._holders_of(rc)[arc.id] = arc
        state.busy |= arc.mask & ~state.sharable
        self._count(arc, 1)
        if arc.id not in self._ended:
            self._movable |= union(rc.bit for rc, _ in self._moves(arc))

    def _leave(self, arc: Arc) -> None:
        arc.hold = None
        for rc in arc.rcs:
            holders = self._holders_of(rc)
            del holders[arc.id]
            if not holders:  # a moving ARC takes the RC of a victim before the victim ends
                self.state.busy &= ~rc.bit
        self._count(arc, -1)

    def _count(self, arc: Arc, by: int) -> None:
        state = self.state
        state.version = next(_versions)
        state.running_by_owner[arc.owner] += by
        state.held_by_owner[arc.owner] += by * len(arc.rcs)

    def _holders_of(self, rc: Rc) -> dict[ArcId, Arc]:
        if rc.bit not in self._holders:
            self._holders[rc.bit], rc.holders = rc.holders, dict(rc.holders)
        return rc.holders

    def _moves(self, arc: Arc) -> Iterator[tuple[Rc, Need]]:
        """The exclusive RCs that a starting ARC has by pattern and may leave for others, each with its need."""
        if arc.like is not None and arc.claim is None and not arc.request.continues:
            for need, name in arc.bound.items():
                if not (rc := self.state.rc(name)).sharable:
                    yield rc, need

    def _start_by_moving(self, arc: Arc, *, may_preempt: bool) -> bool:
        """Start `arc` by moving others that start in this run to other RCs. With `may_preempt` holds may end for it."""
        state = self.state
        blocking = [
            rc
            for rc in state.rcs_in(arc.named_mask & ~state.sharable & state.busy & ~self._movable)
            if not may_preempt or rc.non_preemptible_holders(arc, state.now)
        ]
        if blocking or self._paths >= MAX_PATHS or arc.named_mask & state.closed_to(arc):
            return False
        self._paths += 1
        paths = _Paths(state, arc, self.reserved, may_preempt=may_preempt)
        for other in self._started.values():
            for rc, need in self._moves(other):
                paths.own(other, need, rc)
        if not paths.add():
            return False
        moved = [(other, other.bound) for other in paths.moved()]
        for other, _ in moved:
            self._leave(other)
        for other, _ in moved:
            state.bind(other, paths.bound(other))
            self._enter(other)
        if arc.patterns:
            state.bind(arc, paths.bound(arc))
        verdict = judge(AdmissionCheck(state, arc, presume=True), self.reserved)
        if isinstance(verdict, Admissible) and (may_preempt or not verdict.victims):
            self._take(arc, verdict)
            return True
        for other, _ in moved:
            self._leave(other)
        for other, was in moved:
            state.bind(other, was)
            self._enter(other)
        return False


class _Paths:
    """A matching of needs and exclusive RCs, for the ARCs that start in a dry run and the ARC to add."""

    def __init__(self, state: SchedulerState, arc: Arc, reserved: Reservations | None, *, may_preempt: bool) -> None:
        self._state, self._arc, self._reserved = state, arc, reserved
        self._owner: dict[int, tuple[Arc, Need]] = {}
        self._bound: dict[ArcId, dict[Need, RcName]] = {}
        self._free = state.present & ~state.sharable & ~state.busy
        self._own = 0  # bits of the RCs that only `arc` may take, by preempting their holders
        if may_preempt:
            for rc in state.rcs_in(state.busy):
                for holder in rc.holders.values():
                    if holder.preemptible_by(arc, state.now):
                        self._own |= rc.bit
                        self._free |= holder.mask & ~state.sharable if rc.bit & arc.named_mask else 0
            self._own &= ~self._free
        self._seen = 0

    def own(self, arc: Arc, need: Need, rc: Rc) -> None:
        self._owner[rc.bit] = arc, need

    def add(self) -> bool:
        """Find separate RCs for all needs of the ARC; others keep theirs or move. Return False if impossible."""
        state, arc = self._state, self._arc
        wanted: dict[Need, int] = {rc.name: rc.bit for rc in state.rcs_in(arc.named_mask & ~state.sharable)}
        for need, mask in class_of(arc).masks.items() if arc.patterns else ():
            if mask & state.sharable:
                rc = choices(state, arc, self._reserved).first(mask)
                if rc is None or not rc.sharable or rc.name in self.bound(arc).values():
                    return False
                self._bound.setdefault(arc.id, {})[need] = rc.name
            else:
                wanted[need] = mask
        for need in wanted:
            self._seen = 0
            if not self._place(arc, need, wanted):
                return False
        return True

    def moved(self) -> list[Arc]:
        found = {arc.id: arc for arc, _ in self._owner.values()}
        return [arc for arc in found.values() if arc is not self._arc and arc.id in self._bound]

    def bound(self, arc: Arc) -> Mapping[Need, RcName]:
        kept = {} if arc is self._arc else arc.bound
        return {**kept, **{need: rc for need, rc in self._bound.get(arc.id, {}).items() if need in arc.patterns}}

    def _place(self, arc: Arc, need: Need, wanted: Mapping[Need, int]) -> bool:
        mask = wanted[need] if arc is self._arc else class_of(arc).masks[need] & ~self._own
        mask &= self._state.open_to(arc.priority) & ~self._seen & ~self._kept_from(arc, mask)
        if free := mask & self._free:
            rc = min(self._state.rcs_in(free), key=lambda rc: (rc.wanted, rc.bit))
            self._free &= ~rc.bit
            self._give(rc, arc, need)
            return True
        for bit in bits(mask & union(self._owner)):
            if not bit & self._seen:
                self._seen |= bit
                if self._place(*self._owner[bit], wanted):
                    self._give(self._state.rc_of(bit), arc, need)
                    return True
        left = mask & self._own & ~union(self._owner)
        if arc is not self._arc or not left:
            return False
        rc = min(self._state.rcs_in(left), key=lambda rc: (max(arc.priority for arc in rc.holders.values()), rc.bit))
        self._give(rc, arc, need)
        return True

    def _kept_from(self, arc: Arc, mask: int) -> int:
        """Bits of the RCs in `mask` that are reserved for others."""
        if (reserved := self._reserved) is None:
            return 0
        rcs = self._state.rcs_in(mask & reserved.bits)
        return union(rc.bit for rc in rcs if reserved.reserves(rc, arc))

    def _give(self, rc: Rc, arc: Arc, need: Need) -> None:
        self._owner[rc.bit] = arc, need
        self._bound.setdefault(arc.id, {})[need] = rc.name
