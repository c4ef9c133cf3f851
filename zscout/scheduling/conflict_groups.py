"""The ARCs that a pass could change, in groups that are decided separately.

Most of a busy fleet is settled: a running ARC that no startable ARC could preempt stays, and an ARC that needs its
exclusive RCs waits. The others are undecided. The queue index gives the candidates: all but watchers, the watchers of
freed RCs, and, where a running ARC may have to end, the watchers of its RCs.

Undecided ARCs that share no RC, even indirectly, are decided separately: a slow voter delays only its own group."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter
from typing import Final, Literal, TypeAlias

from zscout.scheduling.model import Arc, Rank, Rc, union
from zscout.scheduling.packing import PackingItem, PackingProblem
from zscout.scheduling.patterns import alternatives, bind_all
from zscout.scheduling.plan import NO_PLAN, BindingPlan, dry_run
from zscout.scheduling.queue_index import Watched
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.state import Actions, SchedulerState
from zscout.scheduling.votes import HolderSet
from zscout.types import ArcId, Ns

SCALE: Final = 1 << 32
"""Makes densities whole numbers."""


def undecided_arcs(
    state: SchedulerState, reserved: Reservations | None = None, limit: int | None = None, plan: BindingPlan = NO_PLAN
) -> tuple[list[Arc], int] | None:
    """The queued ARCs that might start, best-ranked first, then the running ARCs that might end; and bits of the RCs of
    ARCs that wait for a vote on a reservation. None: more than `limit` could start. ARCs are bound as planned, the
    others to the remaining RCs as far as possible."""
    if state.by_pattern:
        bind_all(state, reserved, plan.mask)
    search = _Search(state, reserved, plan)
    found = search.run(limit)
    return None if found is None else (found, search.awaiting_votes)


class _Search:
    def __init__(self, state: SchedulerState, reserved: Reservations | None, plan: BindingPlan) -> None:
        self.state, self.votes, self.reserved, self.plan = state, state.votes, reserved, plan
        self.preemptible: dict[ArcId, Arc] = {}  # running ARCs that might have to end
        self._heap: list[
            tuple[Rank, int, Arc, Watched | None]
        ] = []  # candidates, each by itself or as a watcher of an RC
        self._walked: set[Watched] = set()
        self._started: Counter[str] = Counter()  # by owner with a quota: ARCs that might start
        self._taken: Counter[str] = Counter()  # by owner with a quota: RCs of these ARCs
        self.awaiting_votes = 0  # bits of the RCs of ARCs that wait for a vote on a reservation
        self._shared_taken = 0  # bits of sharable RCs where an ARC passed the starving ARCs; a second isn't checked

    def run(self, limit: int | None) -> list[Arc] | None:
        index = self.state.index
        self._heap = [(arc.rank, 0, arc, None) for arc in (*index.ready.values(), *index.parked.values())]
        heapq.heapify(self._heap)
        self._queue_watchers(index.freed | union(self.state.rc(name).bit for name in self.votes.invalidated), None)
        found: list[Arc] = []
        last: Rank | None = None
        while self._heap:
            rank, _, arc, on = heapq.heappop(self._heap)
            if arc.like is not None and rank != last:
                self.state.bind(arc, self.plan.bound.get(arc.id) or arc.like.bound(arc))
            # An ARC may be queued twice in the heap; duplicates are adjacent because ranks are unique.
            if rank != last and self._might_start(arc):
                found.append(arc)
                if limit is not None and len(found) > limit:
                    return None
                self._note_preemptible(arc)
            last = rank
            if on is not None:
                self._queue_next_watcher(on, rank)
        return [*found, *self.preemptible.values()]

    def _queue_watchers(self, bits: int, rank: Rank | None) -> None:
        for on in self.state.watched_at(bits):
            if on not in self._walked:
                self._walked.add(on)
                self._queue_next_watcher(on, rank)

    def _queue_next_watcher(self, on: Watched, rank: Rank | None) -> None:
        following = self.state.next_watcher(on, rank)
        if following is not None:
            heapq.heappush(self._heap, following)

    def _might_start(self, arc: Arc) -> bool:
        if self.state.closed_to(arc) or (arc.patterns and not arc.bound):
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
        """Return True if an RC is unresponsive, or vetoed the ARC beside the holders that stay."""
        stay = (holder.id for holder in rc.holders.values() if self._stays(holder, arc))
        answer = self.votes.known(rc.name, frozenset((*stay, arc.id)))
        return rc.name in self.votes.unresponsive if answer is None else not answer.accept

    def _reserved_for_other(self, arc: Arc) -> bool:
        reserved = self.reserved
        if reserved is None or not arc.mask & reserved.bits:
            return False
        shared = arc.mask & reserved.bits & self.state.sharable
        conflict = reserved.conflict(arc)
        if conflict is not None and conflict.proposal and conflict.rc.name not in self.votes.unresponsive:
            self.awaiting_votes |= arc.mask
        if shared & self._shared_taken or conflict is not None:
            return True
        if not arc.starving:
            self._shared_taken |= shared
        return False

    def _within_quota(self, arc: Arc) -> bool:
        quota_left = self.state.quota_left(arc)
        if quota_left is not None:
            self._started[arc.owner] += 1
        if quota_left is not None and self._started[arc.owner] > quota_left:
            return False
        if arc.owner in self.state.policy.rc_quotas:
            if self.state.rc_quota(arc, self._taken) is not None:
                return False
            self._taken[arc.owner] += len(arc.request.needs)
        return True

    def _note_preemptible(self, arc: Arc) -> None:
        for rc in arc.rcs:
            for holder in rc.holders.values():
                if holder.id not in self.preemptible and holder.preemptible_by(arc, self.state.now):
                    self.preemptible[holder.id] = holder
                    self._queue_watchers(holder.mask, arc.rank)


def conflict_groups(
    state: SchedulerState, reserved: Reservations | None = None, limit: int | None = None, plan: BindingPlan = NO_PLAN
) -> list[ConflictGroup]:
    """The groups with a choice, best-ranked first; none if more than `limit` ARCs could start. A single ARC, or a
    single queued ARC without sharable RCs, leaves no choice: `priority` starts it."""
    arcs, awaiting_votes = undecided_arcs(state, reserved, limit, plan) or ((), 0)
    return [
        ConflictGroup(state, members, reserved, plan, awaiting_votes)
        for members in split(arcs)
        if len(members) > 1
        and (sum(arc.hold is None for arc in members) > 1 or any(arc.mask & state.sharable for arc in members))
    ]


Decision: TypeAlias = int | Literal["open", "left"]
"""The set of a group. `left`: `priority` decides; `open`: undecided, and off limits for now."""


def take_all(
    state: SchedulerState,
    reserved: Reservations | None,
    plan: BindingPlan,
    decided: Sequence[tuple[ConflictGroup, Decision]],
    actions: Actions,
) -> tuple[int, BindingPlan]:
    """Take these sets. Return the bits off limits to the following pass of `priority`, and its plan. A group is left to
    that pass if the pass would end a hold granted at this instant to an ARC of the group, or might after a veto; all
    groups are, if no group has such an ARC."""
    held = union(group.off_limits for group, chosen in decided if chosen == "open")
    taken = [(group, chosen) for group, chosen in decided if isinstance(chosen, int)]
    while taken and plan is not NO_PLAN:
        changes = [group.changes(chosen) for group, chosen in taken]
        starting = [arc for starting, _ in changes for arc in starting]
        after = dry_run(state, reserved, starting, [arc for _, ending in changes for arc in ending])
        if not after.dropped:
            plan = after
            break
        kept = [(group, chosen) for group, chosen in taken if not any(arc.id in after.dropped for arc in group.arcs)]
        taken = kept if len(kept) < len(taken) else []
    for group, chosen in taken:
        group.take(chosen, actions, plan)
    return held, plan


def split(arcs: Iterable[Arc]) -> list[list[Arc]]:
    """Split the ARCs into groups without a common RC, each in rank order; the best-ranked group first."""
    members = sorted(arcs, key=attrgetter("rank"))
    if _one_group(members):
        return [members]
    root = list(range(len(members)))

    def find(number: int) -> int:
        while root[number] != number:
            root[number] = root[root[number]]
            number = root[number]
        return number

    first: dict[int, int] = {}  # by bit: the first ARC that needs the RC
    for number, arc in enumerate(members):
        mask = arc.mask
        while mask:
            bit = mask & -mask
            mask ^= bit
            root[find(first.setdefault(bit, number))] = find(number)
    groups: dict[int, list[Arc]] = {}
    for number, arc in enumerate(members):
        groups.setdefault(find(number), []).append(arc)
    # Groups and members are in rank order by construction.
    return list(groups.values())


def _level_key(arc: Arc, first: set[ArcId], last: int, now: Ns) -> tuple[int, int]:
    """Sort key of levels, best first, by priority. A protected hold counts at least as the highest priority that can't
    end it. Among equals the ARCs in `first` and holds within their minimum runtime precede; the others follow by
    position, holds that yield with the position `last`."""
    if (below := arc.protected_below(now)) is not None:
        return min(-arc.priority, 1 - below), 0
    if arc.past_min_runtime(now) if arc.hold is not None else arc.id not in first:
        position = arc.position if arc.hold is None else last
        return -arc.priority, 2 + position if first or last else 1
    return -arc.priority, 1


def density(runtime: Ns) -> int:
    """The worth of each RC of an ARC with this minimum runtime: more if it is short, as others wait less behind it."""
    return max(1, SCALE // math.isqrt(runtime))


def _one_group(arcs: Sequence[Arc]) -> bool:
    """Return True if a quick look shows a single group: the usual case."""
    mask, rest = 0, list(arcs)
    for _ in range(3):
        others = []
        for arc in rest:
            if mask and not arc.mask & mask:
                others.append(arc)
            else:
                mask |= arc.mask
        if not others:
            return True
        rest = others
    return False


class ConflictGroup:
    def __init__(
        self,
        state: SchedulerState,
        arcs: list[Arc],
        reserved: Reservations | None = None,
        plan: BindingPlan = NO_PLAN,
        awaiting_votes: int = 0,
    ) -> None:
        """`awaiting_votes`: bits of the RCs that open votes may give to others."""
        self.state, self.votes = state, state.votes
        now = state.now
        first = {arc.id for arc in arcs if reserved is not None and reserved.goes_first(arc)}
        last = max((arc.position for arc in arcs if arc.hold is None), default=0)
        keyed = sorted((_level_key(arc, first, last, now), arc.rank, arc) for arc in arcs)
        self.arcs = [arc for _, _, arc in keyed]
        self.mask = union(arc.mask for arc in arcs)  # all RCs that they need or hold
        keys = [key for key, _, _ in keyed]
        levels = {key: level for level, key in enumerate(dict.fromkeys(keys))}
        exclusive = ~state.sharable
        self.items = [
            PackingItem(
                mask=arc.mask & exclusive,
                width=arc.mask.bit_count(),
                level=levels[key],
                running=arc.hold is not None,
                past_min_runtime=arc.past_min_runtime(now),
                density=density(arc.request.min_runtime) if state.adaptive else 1,
            )
            for arc, key in zip(self.arcs, keys, strict=True)
        ]
        self.planned: int | None = None
        """The planned set as bits of item numbers. None: there is no plan, as no ARC has patterns."""
        self.moves = False
        """True if `priority` would restart an ARC on other RCs, perhaps of this group: no set expresses that."""
        self.waits = bool(self.mask & (plan.off_limits | awaiting_votes))
        """True while open votes decide about its bindings or its RCs."""
        if plan is not NO_PLAN:
            stay = (arc.id in plan.started if arc.hold is None else arc.id not in plan.ended for arc in self.arcs)
            self.planned = sum(1 << number for number, stays in enumerate(stay) if stays)
            moved = plan.started & plan.ended
            self.moves = bool(self.mask & plan.moved) or any(arc.id in moved for arc in self.arcs)
        self._number = {arc.id: number for number, arc in enumerate(self.arcs)}
        self.sharables = list(state.rcs_in(self.mask & state.sharable))
        vetoes = {rc.name: set(self._vetoes(rc)) for rc in self.sharables}
        self.nogoods = set().union(*vetoes.values())  # sets ruled out by vetoes, as in `PackingProblem`
        self._contended = {name for name, nogoods in vetoes.items() if nogoods}
        """The sharable RCs that vetoed some set of these ARCs."""

    def problem(self) -> PackingProblem:
        return PackingProblem(self.items, sorted(self.nogoods))

    def missing_votes(self, chosen: int) -> list[tuple[Rc, HolderSet]] | None:
        """The proposals to make before the set can be taken. None: a veto, now in `nogoods`, rules it out."""
        proposals: list[tuple[Rc, HolderSet]] = []
        ruled_out = False
        for rc in self.sharables:
            holders = frozenset(self._holders(rc, chosen))
            # Present holders are accepted; an RC that can no longer carry them reports that.
            if holders <= rc.holders.keys():
                continue
            answer = self.votes.known(rc.name, holders)
            if answer is None and rc.name not in self.votes.unresponsive:
                proposals.append((rc, self._probe(rc, holders) if rc.name in self._contended else holders))
            elif answer is None or not answer.accept:
                # A silent RC counts as a veto of the shortest ranked prefix without an answer.
                ranked, accepted = self._ranked(rc, holders)
                self.nogoods.add(self._bits(frozenset(ranked[: accepted + 1]) if answer is None else holders))
                ruled_out = True
        return None if ruled_out else proposals

    @property
    def off_limits(self) -> int:
        """Bits of the RCs that it may take once its votes are in."""
        waiting = (arc for arc in self.arcs if arc.patterns and arc.hold is None)
        return self.mask | union(alternatives(self.state, arc) for arc in waiting)

    def flickers(self, chosen: int) -> bool:
        """Return True if the set would end a hold that another plan granted at this instant."""
        holds = [arc.hold for arc in self.changes(chosen)[1]]
        return self.planned is not None and any(hold and hold.start == self.state.now for hold in holds)

    def changes(self, chosen: int) -> tuple[list[Arc], list[Arc]]:
        """The queued ARCs in the set, and the running ARCs outside it."""
        taken = [chosen >> number & 1 for number in range(len(self.arcs))]
        starting = [arc for arc, is_taken in zip(self.arcs, taken, strict=True) if is_taken and arc.hold is None]
        ending = [arc for arc, is_taken in zip(self.arcs, taken, strict=True) if not is_taken and arc.hold is not None]
        return starting, ending

    def take(self, chosen: int, actions: Actions, plan: BindingPlan) -> None:
        starting, ending = self.changes(chosen)
        for arc in starting:
            if arc.patterns:
                self.state.bind(arc, plan.bound[arc.id])
        for victim in ending:
            actions.preempt(victim, by=self._taker(victim, starting))
        for arc in starting:
            actions.start(arc)

    def _vetoes(self, rc: Rc) -> Iterator[int]:
        """The vetoes of `rc` on these ARCs as bits of item numbers; its other holders stay."""
        for holders in self.votes.vetoed(rc.name):
            if all(self._may_hold(rc, arc) for arc in holders) and (nogood := self._bits(holders)):
                yield nogood

    def _may_hold(self, rc: Rc, arc: ArcId) -> bool:
        number = self._number.get(arc)
        return arc in rc.holders if number is None else bool(self.arcs[number].mask & rc.bit)

    def _probe(self, rc: Rc, holders: HolderSet) -> HolderSet:
        """Propose half of the ARCs not accepted yet: a veto of few ARCs rules out far more sets than a veto of many."""
        ranked, accepted = self._ranked(rc, holders)
        return frozenset(ranked[: (accepted + len(ranked) + 1) // 2])

    def _ranked(self, rc: Rc, holders: HolderSet) -> tuple[list[ArcId], int]:
        """The present holders of `rc`, then the others by rank; and how many of these are accepted (not all)."""
        newcomers = (arc.id for arc in self.arcs if arc.id in holders and arc.id not in rc.holders)
        ranked = [*(holders & rc.holders.keys()), *newcomers]
        accepted = len(ranked) - 1
        while accepted and not self._accepted(rc, frozenset(ranked[:accepted])):
            accepted -= 1
        return ranked, accepted

    def _accepted(self, rc: Rc, holders: HolderSet) -> bool:
        return holders <= rc.holders.keys() or self.votes.accepts(rc.name, holders)

    def _holders(self, rc: Rc, chosen: int) -> Iterator[ArcId]:
        for holder in rc.holders:
            if holder not in self._number:
                yield holder
        for number, arc in enumerate(self.arcs):
            if chosen >> number & 1 and arc.mask & rc.bit:
                yield arc.id

    def _bits(self, holders: HolderSet) -> int:
        return sum(1 << self._number[arc] for arc in holders if arc in self._number)

    def _taker(self, victim: Arc, starting: list[Arc]) -> Arc:
        """The taker of the hold: the best newcomer that needs its exclusive RCs, else its sharable RCs, else any."""
        entitled = [arc for arc in starting if victim.preemptible_by(arc, self.state.now)] or starting
        exclusive = ~self.state.sharable
        for mask in (victim.mask & exclusive, victim.mask):
            for arc in entitled:
                if arc.mask & mask:
                    return arc
        return entitled[0]
