"""The state that a scheduling pass reads and changes: holders, queue, votes.

Sets of RCs are integer bit masks: an ARC of exclusive RCs can start if `needs & ~free == 0`."""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left, bisect_right, insort
from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Protocol

from msgspec import structs

from zscout.config.scheduling_policy import DEFAULT, RcQuota, SchedulingPolicy, StrategyName
from zscout.keyexpr import is_pattern, matcher
from zscout.scheduling.claim_index import ClaimIndex, bits
from zscout.scheduling.fair_shares import Shares
from zscout.scheduling.model import Arc, ArcRequest, ArcState, Hold, PatternClass, Rank, Rc, union
from zscout.scheduling.patience import RuntimeMean
from zscout.scheduling.queue_index import QueueIndex, Watched
from zscout.scheduling.reason import Reason
from zscout.scheduling.votes import HolderSet, Votes
from zscout.types import ArcId, ClientId, Grant, Need, Ns, Params, Place, RcName


class SchedulerState:
    """The RCs, the ARCs and their holds. Change them by these methods only."""

    def __init__(self, policy: SchedulingPolicy = DEFAULT, *, adaptive: bool = False) -> None:
        """`adaptive`: preemption has a budget, and shorter ARCs are worth more."""
        self.policy, self.adaptive = policy, adaptive
        self.runtimes = RuntimeMean()
        self.now: Ns = 0
        self.votes = Votes()
        self._ends: list[tuple[Ns, ArcId]] = []
        """A heap of the ends of holds' minimum and longest runtimes. Outdated entries are skipped."""
        self.rcs: dict[RcName, Rc] = {}
        self.queued: dict[ArcId, Arc] = {}
        self.running: dict[ArcId, Arc] = {}
        self.held_back: dict[ArcId, Arc] = {}
        """ARCs that wait but are not considered for now (`ArcState.HELD_BACK`)."""
        self.dates = ClaimIndex()
        self.claims, self.maintenance = self.dates.by_id, self.dates.maintenance
        self._at_place: dict[Place, Arc] = {}
        """By place: the ARC considered or running. Where two clients claim one ARC, only one of them may run it."""
        self.present = 0
        self.unwell = 0  # bits of the present RCs granted to operators only
        self.sharable = 0  # bits of the RCs that vote and take several holders
        self.busy = 0  # bits of the held exclusive RCs
        self.index = QueueIndex(self.band)
        self.by_pattern: dict[ArcId, Arc] = {}  # queued ARCs with patterns
        self.running_by_pattern = 0  # running ARCs with patterns
        self._matching: dict[Need, list[Rc]] = {}
        self._matching_masks: dict[Need, int] = {}
        self.classes: dict[Hashable, PatternClass] = {}
        self.chosen: dict[ArcId, ArcId] = {}
        """By running ARC: the queued ARC that is likely to get one of its RCs for a pattern (`upcoming.py`)."""
        self.running_by_owner: Counter[str] = Counter()
        self.held_by_owner: Counter[str] = Counter()
        self._by_bit: list[Rc] = []
        self._clients: dict[ClientId, dict[ArcId, Arc]] = {}
        self._owners: dict[str, dict[ArcId, Arc]] = {}
        self.entries = 0
        self.demand_version = 0  # grows with each change of `Rc.demand`
        self.version = 0  # grows with each change of holders, present RCs and preemptibility
        self.changed: dict[int, float] = {}
        """By bit of the RCs with such a change: the end of the time that it may affect. `Calendar` empties it."""
        self.shares = Shares(self, policy.fair_shares) if policy.fair_shares is not None else None
        """None where fair shares are off."""

    def rc(self, name: RcName) -> Rc:
        """Return the RC of this name; an unknown RC is added as absent and exclusive."""
        rc = self.rcs.get(name)
        if rc is None:
            rc = self.rcs[name] = Rc(name, 1 << len(self._by_bit))
            self._by_bit.append(rc)
            self._matching.clear()
            self._matching_masks.clear()
            for like in self.classes.values():
                self._find_matches(like, self.queued[like.members[0][-1]])
        return rc

    def rc_of(self, bit: int) -> Rc:
        return self._by_bit[bit.bit_length() - 1]

    def matching(self, need: Need) -> list[Rc]:
        found = self._matching.get(need)
        if found is None:
            matches = matcher(need)
            found = self._matching[need] = [rc for rc in self.rcs.values() if matches(rc.name)]
        return found

    def matching_mask(self, need: Need) -> int:
        mask = self._matching_masks.get(need)
        if mask is None:
            mask = self._matching_masks[need] = union(rc.bit for rc in self.matching(need))
        return mask

    def bind(self, arc: Arc, bound: Mapping[Need, RcName]) -> None:
        """Bind the patterns of an ARC that does not run; if `bound` is empty, unbind them."""
        if arc.bound == bound and arc.rcs:
            return
        wanted, unbound = arc.request.needs, () if bound else arc.patterns
        arc.bound = bound
        arc.needs = {bound.get(need, need): params for need, params in wanted.items() if need not in unbound}
        arc.mask = arc.named_mask | self.mask(bound.values())
        arc.rcs = tuple(self.rcs_in(arc.mask))

    def new_arc(self, request: ArcRequest, place: Place) -> Arc:
        """Return an ARC that is neither queued nor running yet. The policy's `max_runtime` (`max_booking` for a booked
        ARC) caps its minimum runtime, also for rank and reservations."""
        longest = self.policy.max_booking if request.booking in self.claims else self.policy.max_runtime
        request = request if longest is None else request.at_most(longest)
        patterns = tuple(filter(is_pattern, request.needs))
        named = self.mask(need for need in request.needs if need not in patterns)
        arc = Arc(request, place, named, patterns, named, since=self.now, patience=self.patience)
        if patterns:
            self.bind(arc, {})
        return arc

    @property
    def patience(self) -> Ns:
        """The patience of an ARC that is queued now; 0 where none is ever due."""
        fixed = self.policy.patience
        return self.runtimes.patience(self.now) if fixed == "runtimes" else fixed or 0

    def params(self, arc: Arc, rc: Rc) -> Params:
        if rc.name in arc.needs:
            return arc.needs[rc.name]
        return arc.request.needs[next(need for need in arc.patterns if rc in self.matching(need))]

    def possible_sharables(self, arc: Arc) -> Iterator[Rc]:
        matching = union(map(self.matching_mask, arc.patterns))
        return self.rcs_in((arc.mask | matching) & self.sharable)

    def mask(self, names: Iterable[RcName]) -> int:
        return union(self.rc(name).bit for name in names)

    def rcs_in(self, mask: int) -> Iterator[Rc]:
        while mask:
            low = mask & -mask
            yield self._by_bit[low.bit_length() - 1]
            mask ^= low

    def watched_at(self, bits: int) -> list[Watched]:
        """The RCs and classes whose watchers a change of these RCs may affect."""
        classes = [like for like in self.index.watched_classes if like.reach & bits]
        return [*self.rcs_in(bits & self.index.watched), *classes]

    def next_watcher(self, on: Watched, rank: Rank | None) -> tuple[Rank, int, Arc, Watched] | None:
        """The heap entry of the best watcher of `on` below `rank` (None: of all); None: there is no such watcher."""
        at = 0 if rank is None else bisect_right(on.watchers, rank)
        if at == len(on.watchers):
            return None
        return on.watchers[at], on.bit if isinstance(on, Rc) else -1, self.queued[on.watchers[at][-1]], on

    def arc(self, arc: ArcId) -> Arc | None:
        return self.running.get(arc) or self.queued.get(arc) or self.held_back.get(arc)

    def all_arcs(self) -> Iterator[Arc]:
        for arcs in (self.queued, self.held_back, self.running):
            yield from arcs.values()

    def join(self, name: RcName, *, sharable: bool, host: str = "") -> None:
        rc = self.rc(name)
        rc.host = host
        if self.shares is not None and not rc.present:
            self.shares.count_absent(rc, self.queued.values(), 1)
        rc.present, rc.sharable, rc.absence = True, sharable, ""
        self.present |= rc.bit
        self.sharable = self.sharable | rc.bit if sharable else self.sharable & ~rc.bit
        self.index.freed |= rc.bit
        self._note_change(rc.bit)

    def leave(self, name: RcName) -> None:
        rc = self.rc(name)
        if self.shares is not None and rc.present:
            self.shares.count_absent(rc, self.queued.values(), -1)
        rc.present, rc.unwell = False, ""
        self.present &= ~rc.bit
        self.unwell &= ~rc.bit
        self.index.freed |= rc.bit
        self._note_change(rc.bit)

    def set_unwell(self, name: RcName, why: str) -> None:
        rc = self.rc(name)
        rc.unwell = why
        unwell = self.unwell | rc.bit if why and rc.present else self.unwell & ~rc.bit
        if unwell != self.unwell:
            self.unwell = unwell
            self.index.freed |= rc.bit
            self._note_change(rc.bit)

    def open_to(self, priority: int) -> int:
        """Bits of the RCs that a request of this priority may be granted."""
        return self.present & ~self.unwell if self.unwell and not self.operator(priority) else self.present

    def closed_to(self, arc: Arc) -> int:
        """Bits of its RCs that are absent or, unless it continues their holder, unwell and not granted to it."""
        closed = arc.mask & ~self.open_to(arc.priority)
        if closed & self.present and (continued := self.continued(arc)) is not None:
            closed &= ~(continued.mask & self.present)
        return closed

    def is_free(self, arc: Arc) -> bool:
        """Return True if a new ARC starts at once: no queue, quota or pattern; exclusive, free, unbooked RCs."""
        if self.queued or self.held_back or arc.patterns or arc.place in self._at_place:
            return False
        if arc.mask & self.dates.claimed:
            return False
        bound = self.policy.max_running_per_host is not None or self.policy.rc_quotas
        return not bound and not self.closed_to(arc) and not arc.mask & (self.busy | self.sharable)

    def enter(self, arc: Arc) -> None:
        """Register a new ARC that starts without being queued."""
        arc.rcs = tuple(self.rcs_in(arc.mask))
        self._register(arc)
        self._at_place[arc.place] = arc

    def enqueue(self, arc: Arc, since: Ns) -> None:
        arc.since, arc.entry = since, self._next_entry()
        arc.rcs = arc.rcs or tuple(self.rcs_in(arc.mask))
        self._register(arc)
        if not self._is_first(arc):
            arc.move_to(ArcState.HELD_BACK)
            self.held_back[arc.id] = arc
            return
        self.queued[arc.id] = arc
        if self.shares is not None:
            self._reposition(arc, self.shares)
        if arc.patterns:
            self.by_pattern[arc.id] = arc
            self._classify(arc)
        self._count_demand(arc, 1)
        self.index.add(arc)
        self.index.contended |= self._wanted_mask(arc)

    def dequeue(self, arc: Arc) -> None:
        if self.held_back.pop(arc.id, None) is not None:
            arc.held_back = None
            return
        del self.queued[arc.id]
        self.index.contended |= self._wanted_mask(arc)
        self._count_demand(arc, -1)
        self.index.remove(arc)
        if arc.patterns:
            del self.by_pattern[arc.id]
            self._declassify(arc)

    def _wanted_mask(self, arc: Arc) -> int:
        """Bits of the RCs that a queued ARC names or that match its patterns."""
        return arc.named_mask if arc.like is None else arc.named_mask | arc.like.reach

    def _classify(self, arc: Arc) -> None:
        like = arc.like = self.classes.setdefault(self._class_key(arc), self.class_for(arc))
        insort(like.members, arc.rank)

    def class_for(self, arc: Arc) -> PatternClass:
        """Return the class of an ARC with patterns: the present one, or a new one that is not kept."""
        like = self.classes.get(self._class_key(arc))
        if like is None:
            like = PatternClass()
            self._find_matches(like, arc)
        return like

    def _declassify(self, arc: Arc) -> None:
        like, arc.like = arc.like, None
        if like is not None:
            del like.members[bisect_left(like.members, arc.rank)]
            if not like.members:
                del self.classes[self._class_key(arc)]

    def _class_key(self, arc: Arc) -> Hashable:
        return frozenset(arc.patterns), arc.named_mask, arc.priority, self.policy.barred.get(arc.owner, ())

    def _find_matches(self, like: PatternClass, arc: Arc) -> None:
        taken = arc.named_mask | self.barred(arc)
        like.masks = {need: self.matching_mask(need) & ~taken for need in arc.patterns}
        like.reach = union(like.masks.values())
        like.usable_of, like.choices = -1, {}

    def hold_back(self, arc: Arc, until: Ns, rcs: tuple[RcName, ...]) -> None:
        """Consider a queued ARC no more before `until`, unless one of `rcs` joins."""
        self.dequeue(arc)
        arc.move_to(ArcState.HELD_BACK)
        arc.held_back = until, rcs
        self.held_back[arc.id] = arc

    def readmit(self, rc: RcName | None = None) -> None:
        """Queue the ARCs whose pause is over, or that were held back for `rc`."""
        for arc in list(self.held_back.values()):
            if arc.held_back is not None and (arc.held_back[0] <= self.now or rc in arc.held_back[1]):
                self.consider_again(arc)

    def _is_first(self, arc: Arc) -> bool:
        return self._at_place.setdefault(arc.place, arc) is arc

    def at_place(self, place: Place) -> Arc | None:
        return self._at_place.get(place)

    def put_before(self, arc: Arc, other: Arc) -> None:
        """Give new `arc` the place of queued `other`, which is held back until `arc` has ended."""
        self._at_place[arc.place] = arc
        self.consider_again(other)

    def leave_place(self, arc: Arc) -> None:
        """Free the place of an ended or moved ARC, and consider the other ARCs that claim it."""
        if self._at_place.get(arc.place) is arc:
            del self._at_place[arc.place]
            for other in [
                waiting
                for waiting in self.held_back.values()
                if waiting.place == arc.place and waiting.held_back is None
            ]:
                self.consider_again(other)

    def consider_again(self, arc: Arc) -> None:
        self.dequeue(arc)
        self.enqueue(arc, arc.since)

    def forget(self, arc: Arc) -> None:
        arc.move_to(ArcState.ENDED)
        self._unregister(arc)
        self.leave_place(arc)

    def voter(self, arc: ArcId) -> Arc | None:
        return self.arc(arc) or (self.claims[arc].arc if arc in self.claims else None)

    def _register(self, arc: Arc) -> None:
        self._clients.setdefault(arc.request.client, {})[arc.id] = arc
        self._owners.setdefault(arc.owner, {})[arc.id] = arc

    def _unregister(self, arc: Arc) -> None:
        for known, of in ((self._clients, arc.request.client), (self._owners, arc.owner)):
            del known[of][arc.id]
            if not known[of]:
                del known[of]

    def arcs_of(self, client: ClientId) -> Collection[Arc]:
        return self._clients.get(client, {}).values()

    def arcs_of_owner(self, owner: str) -> Collection[Arc]:
        return self._owners.get(owner, {}).values()

    def hand_over(self, arc: Arc, to: ClientId, renamed: ArcId) -> None:
        if arc.hold is None:
            self.dequeue(arc)
            self._rename(arc, to, renamed)
            self.enqueue(arc, arc.since)
            return
        self._remove_running(arc)
        self._rename(arc, to, renamed)
        arc.entry = self._next_entry()
        self._add_running(arc)
        for end in (arc.hold.end, arc.hold.last):
            if end is not None and end > self.now:
                heapq.heappush(self._ends, (end, arc.id))
        self._register(arc)

    def _rename(self, arc: Arc, client: ClientId, name: ArcId) -> None:
        self._unregister(arc)
        who = arc.request.who
        if who is not None and who.host:
            who = structs.replace(who, host="")  # from now on the new client's host
        arc.take(structs.replace(arc.request, arc=name, client=client, who=who))

    def start(self, arc: Arc, hold: Hold) -> None:
        if arc.state is not ArcState.NEW:
            self.dequeue(arc)
        arc.move_to(ArcState.RUNNING)
        arc.waited = self.now - arc.since
        arc.hold, arc.reason, arc.since, arc.entry = hold, None, self.now, self._next_entry()
        self._add_running(arc)
        heapq.heappush(self._ends, (hold.end, arc.id))
        if hold.last is not None:
            heapq.heappush(self._ends, (hold.last, arc.id))
        self.index.touched |= arc.mask
        self.busy |= arc.mask & ~self.sharable

    def stop(self, arc: Arc) -> Hold:
        hold = arc.hold
        assert hold is not None, arc.id  # noqa: S101
        self._remove_running(arc)
        arc.hold = None
        arc.waits.clear()
        if arc.claim is not None:
            self.dates.put(arc.claim)
        self.busy &= ~arc.mask
        self.index.freed |= arc.mask
        self.index.contended |= arc.mask
        return hold

    def retime(self, arc: Arc, hold: Hold) -> None:
        before, arc.hold = arc.known_end(), hold
        for end in (hold.end, hold.last):
            if end is not None:
                heapq.heappush(self._ends, (end, arc.id))
        self.index.freed |= arc.mask
        self.index.contended |= arc.mask
        self._note_change(arc.mask, max(before, arc.known_end()))

    def set_begin_within(self, name: RcName, begin_within: Ns | None) -> None:
        rc = self.rc(name)
        if rc.begin_within != begin_within:
            rc.begin_within = begin_within
            self.index.freed |= rc.bit
            self._note_change(rc.bit)

    def expired_arcs(self) -> Iterator[Arc]:
        """Yield the running ARCs whose minimum or longest runtime is over, once each. The caller may end ARCs."""
        while self._ends and self._ends[0][0] <= self.now:
            at, arc_id = heapq.heappop(self._ends)
            arc = self.running.get(arc_id)
            if arc is not None and arc.hold is not None and at in (arc.hold.end, arc.hold.last):
                yield arc

    def next_end(self) -> Ns | None:
        while self._ends:
            at, arc_id = self._ends[0]
            arc = self.running.get(arc_id)
            if arc is not None and arc.hold is not None and at in (arc.hold.end, arc.hold.last):
                return at
            heapq.heappop(self._ends)
        return None

    def next_starving(self) -> Ns | None:
        is_kept = self.adaptive and self.policy.patience is not None
        return self.index.next_starving(self.now) if is_kept else None

    def min_runtime_over(self, arc: Arc) -> None:
        """Note that equal priorities may preempt this kept hold from now on."""
        self.index.freed |= arc.mask
        self._note_change(arc.mask, 0)

    def _note_change(self, mask: int, until: float = math.inf) -> None:
        self.version += 1
        for bit in bits(mask):
            self.changed[bit] = max(until, self.changed.get(bit, 0))

    def operator(self, priority: int) -> bool:
        return priority >= self.policy.operator_priority

    def band(self, priority: int) -> int:
        """The band of a priority. ARCs of one band respect each other's reservations."""
        alone = self.policy.promise == "equals" or self.operator(priority)
        return priority if alone else self.policy.operator_priority - 1

    def order_groups(self) -> None:
        if self.shares is not None and self.shares.order():
            self._reposition_all(self.shares)

    def take_policy(self, policy: SchedulingPolicy) -> None:
        charged, same = self.charged(), policy.fair_shares == self.policy.fair_shares
        patient = policy.patience == self.policy.patience
        if policy.operator_priority != self.policy.operator_priority:
            self.index.freed |= self.unwell
            self._note_change(self.unwell)
        for arc in self.by_pattern.values():  # the set of barred RCs may have changed
            self.index.put(arc, ArcState.READY)
            self._declassify(arc)
        self.policy = policy
        for arc in self.by_pattern.values():
            self._classify(arc)
        if not patient:
            for arc in self.all_arcs():
                arc.patience = self.patience
        if same:
            if not patient:
                self._reposition_all(self.shares)
            return
        self.shares = None if policy.fair_shares is None else Shares(self, policy.fair_shares)
        if self.shares is not None:
            self.shares.restore(charged)
            for arc in self.queued.values():
                self.shares.count_waiting(arc, 1)
            for arc in self.running.values():
                self.shares.hold(arc)
            self.shares.order()
        self._reposition_all(self.shares)

    def _reposition_all(self, shares: Shares | None) -> None:
        for arc in self.queued.values():
            self._reposition(arc, shares)
        self.index.sort(self.queued, self.rcs_in(self.index.watched))
        for like in self.classes.values():
            like.members = sorted(self.queued[rank[-1]].rank for rank in like.members)
        for rc in self.rcs.values():
            rc.demand = sorted(self.queued[rank[-1]].rank for rank in rc.demand)
        self.demand_version += 1

    def _reposition(self, arc: Arc, shares: Shares | None) -> None:
        arc.put_at(0 if shares is None else shares.position(arc))
        fair = self.policy.fair_shares if self.policy.patience is not None else None
        arc.late = max(0, fair.patience - arc.patience) if arc.position and fair is not None else 0

    def charged(self) -> dict[str, float]:
        return {} if self.shares is None else self.shares.charged()

    def last(self, arc: Arc, start: Ns, end: Ns) -> Ns | None:
        """When `max_runtime` ends a hold, but not before its booking is over; None: never."""
        limit = self.policy.max_runtime
        if limit is None:
            return None
        return max(start + limit, end) if arc.request.booking else start + limit

    def hold(
        self, arc: Arc, grant: Grant, start: Ns, end: Ns, protected_from: Ns | None = None, runtime: Ns | None = None
    ) -> Hold:
        """A hold granted to `arc` at `start`. `protected_from`: as its RCs reported it, if the hold was recovered."""
        policy = self.policy
        budget = round(policy.preempt_budget * (arc.request.min_runtime if runtime is None else runtime))
        below: int | None = policy.operator_priority
        waited = arc.waited if arc.state is ArcState.RUNNING else start - arc.since
        if policy.preempt != "always" or (policy.promise == "all" and arc.starving):
            protected_from = start
        elif not self.adaptive:
            below, protected_from = None, 0
        elif protected_from is not None:
            arc.lost = max(0, start + budget - protected_from)
        else:
            is_due = 0 < arc.patience <= waited - arc.unproven_wait
            protected_from = start if is_due else start + max(0, budget - arc.lost)
        return Hold(grant, start, end, below, self.last(arc, start, end), protected_from, runtime=runtime)

    def quota_left(self, arc: Arc) -> int | None:
        quota = self.policy.max_running_per_host
        if quota is None or self.operator(arc.priority):
            return None
        return max(0, quota - self.running_by_owner[arc.owner] + (self.continued(arc) is not None))

    def rc_quota(self, arc: Arc, starting: Mapping[str, int] = MappingProxyType({})) -> RcQuota | None:
        """The RC quota that `arc` would exceed; `starting`: by owner, the number of RCs of ARCs about to start."""
        quotas = self.policy.rc_quotas.get(arc.owner, ())
        ends = len(continued.rcs) if quotas and (continued := self.continued(arc)) is not None else 0
        for quota in quotas:
            held = sum(self.held_by_owner[owner] + starting.get(owner, 0) for owner in quota.owners) - ends
            if held + len(arc.request.needs) > quota.rcs:
                return quota
        return None

    def continued(self, arc: Arc) -> Arc | None:
        """The running ARC that `arc` continues and replaces when it starts: quotas don't count it."""
        if arc.request.continues:
            for rc in self.rcs_in(arc.mask & ~self.sharable):
                for holder in rc.holders.values():
                    if arc.request.continues_from(holder.request) and holder.preemptible_by(arc, self.now):
                        return holder
        return None

    def barred(self, arc: Arc) -> int:
        """Bits of the RCs that the patterns of `arc` may not be bound to."""
        patterns = self.policy.barred.get(arc.owner, ()) if arc.patterns else ()
        return union(map(self.matching_mask, patterns))

    def is_barred(self, arc: Arc) -> bool:
        patterns = self.policy.barred.get(arc.owner, ()) if self.policy.barred else ()
        return any(matcher(pattern)(need) for pattern in patterns for need in arc.request.needs if not is_pattern(need))

    def _add_running(self, arc: Arc) -> None:
        self.running[arc.id] = arc
        self.running_by_pattern += bool(arc.patterns)
        self._note_change(arc.mask, arc.known_end())
        if arc.claim is not None:
            self.dates.put(arc.claim)
        self.running_by_owner[arc.owner] = self.running_by_owner.get(arc.owner, 0) + 1
        self.held_by_owner[arc.owner] = self.held_by_owner.get(arc.owner, 0) + len(arc.rcs)
        for rc in arc.rcs:
            rc.holders[arc.id] = arc
        if self.shares is not None:
            self.shares.hold(arc)

    def _remove_running(self, arc: Arc) -> None:
        if self.shares is not None:
            self.shares.end(arc)
        del self.running[arc.id]
        self.running_by_pattern -= bool(arc.patterns)
        self._note_change(arc.mask, arc.known_end())
        self.running_by_owner[arc.owner] -= 1
        self.held_by_owner[arc.owner] -= len(arc.rcs)
        if not self.running_by_owner[arc.owner]:
            del self.running_by_owner[arc.owner], self.held_by_owner[arc.owner]
        for rc in arc.rcs:
            del rc.holders[arc.id]

    def _count_demand(self, arc: Arc, by: int) -> None:
        for rc in self.rcs_in(arc.named_mask) if arc.patterns else arc.rcs:
            if by > 0:
                insort(rc.demand, arc.rank)
            else:
                del rc.demand[bisect_left(rc.demand, arc.rank)]
            self.demand_version += 1
        if self.shares is not None:
            self.shares.count_waiting(arc, by)

    def _next_entry(self) -> int:
        self.entries += 1
        return self.entries


class Actions(Protocol):
    """The actions of a strategy. Each changes the state at once and becomes an effect."""

    def start(self, arc: Arc) -> None: ...
    def preempt(self, arc: Arc, by: Arc) -> bool: ...

    def wait(self, arc: Arc, reason: Reason, *, settled: bool = True) -> None: ...
    def propose(self, rc: Rc, holders: HolderSet) -> bool:
        """Return False if this proposal is already open, or the RC is unresponsive and not due."""
        ...

    def run_again(self) -> None:
        """Request another pass at once: the strategy needs more time, but other events come first."""
        ...


class Strategy(Protocol):
    """Decides which ARCs run. A strategy with state serves one core only."""

    name: StrategyName

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        """One pass over the state."""

    def log_line(self) -> str:
        """A line for the log about the passes since the last call; mostly empty."""
        return ""
