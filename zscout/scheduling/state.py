"""Who holds what, who waits, what is known of votes: the state that a scheduling pass reads and changes.

Sets of RCs are integer bit masks; `needs & ~free == 0` is the whole test for an ARC of exclusive RCs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from zscout.config.scheduling_policy import DEFAULT, SchedulingPolicy, owner_of
from zscout.keyexpr import is_pattern, matcher
from zscout.scheduling.model import Arc, ArcState, Hold, Rc
from zscout.scheduling.queue_index import QueueIndex
from zscout.scheduling.reason import Party
from zscout.scheduling.votes import Votes
from zscout.types import ArcId, ClientId, Need, Ns, Params, RcName


class SchedulerState:
    """The RCs, the ARCs and the holds between them. Every change goes through its methods."""

    def __init__(self, policy: SchedulingPolicy = DEFAULT) -> None:
        self.policy = policy
        self.now: Ns = 0
        """The instant of the latest batch of events."""
        self.votes = Votes()
        self.rcs: dict[RcName, Rc] = {}
        self.queued: dict[ArcId, Arc] = {}
        self.running: dict[ArcId, Arc] = {}
        self.present = 0
        """Bits of the RCs that are there."""
        self.sharable = 0
        """Bits of the RCs that vote and take several holders."""
        self.busy = 0
        """Bits of the exclusive RCs that somebody holds."""
        self.index = QueueIndex(policy.band)
        self.by_pattern: dict[ArcId, Arc] = {}
        """Those of the queued that need an RC by pattern."""
        self._matching: dict[Need, list[Rc]] = {}
        self.running_by_owner: Counter[str] = Counter()
        """How many ARCs of each owner run."""
        self._by_bit: list[Rc] = []
        self._clients: dict[ClientId, dict[ArcId, Arc]] = {}
        self.entries = 0
        """Counts who was queued or started."""
        self.version = 0
        """Grows with all that changes who holds what, which RCs are there, and who is preemptible."""

    def rc(self, name: RcName) -> Rc:
        """The RC of this name, made known (absent, exclusive) if it was not."""
        rc = self.rcs.get(name)
        if rc is None:
            rc = self.rcs[name] = Rc(name, 1 << len(self._by_bit))
            self._by_bit.append(rc)
            self._matching.clear()
        return rc

    def matching(self, need: Need) -> list[Rc]:
        """The RCs that meet a pattern, as far as they are known, present or not."""
        found = self._matching.get(need)
        if found is None:
            matches = matcher(need)
            found = self._matching[need] = [rc for rc in self.rcs.values() if matches(rc.name)]
        return found

    def bind(self, arc: Arc, bound: Mapping[Need, RcName]) -> None:
        """Gives the patterns of an ARC that does not run these RCs, one for each."""
        if arc.bound == bound:
            return
        wanted = arc.request.needs
        arc.bound = bound
        arc.needs = {bound.get(need, need): params for need, params in wanted.items()}
        arc.mask = arc.named_mask | self.mask(bound.values())
        arc.rcs = tuple(self.rcs_in(arc.mask))

    def params(self, arc: Arc, rc: Rc) -> Params:
        """What an ARC would ask of an RC, whether it is bound to it at present or not."""
        found = arc.needs.get(rc.name)
        if found is None:
            meets = (need for need in arc.patterns if rc in self.matching(need))
            found = arc.request.needs[next(meets)]
        return found

    def possible_mask(self, arc: Arc) -> int:
        """Bits of all RCs that an ARC could hold."""
        bits = arc.mask
        for need in arc.patterns:
            for rc in self.matching(need):
                bits |= rc.bit
        return bits

    def unbind(self, arc: Arc) -> None:
        """There is no RC for some pattern of the ARC."""
        if arc.rcs and not arc.bound:
            return
        arc.bound, arc.mask = {}, arc.named_mask
        arc.needs = {need: params for need, params in arc.request.needs.items() if not is_pattern(need)}
        arc.rcs = tuple(self.rcs_in(arc.mask))

    def all_rcs(self) -> int:
        """Bits of all RCs that were ever named."""
        return (1 << len(self._by_bit)) - 1

    def mask(self, names: Iterable[RcName]) -> int:
        mask, rcs = 0, self.rcs
        for name in names:
            rc = rcs.get(name) or self.rc(name)
            mask |= rc.bit
        return mask

    def rcs_in(self, mask: int) -> Iterator[Rc]:
        """The RCs of a mask, in the order in which they became known."""
        while mask:
            low = mask & -mask
            yield self._by_bit[low.bit_length() - 1]
            mask ^= low

    def arc(self, arc: ArcId) -> Arc | None:
        return self.running.get(arc) or self.queued.get(arc)

    def join(self, name: RcName, *, sharable: bool) -> None:
        rc = self.rc(name)
        rc.present, rc.sharable = True, sharable
        self.present |= rc.bit
        self.sharable = self.sharable | rc.bit if sharable else self.sharable & ~rc.bit
        self.index.freed |= rc.bit
        self.version += 1

    def leave(self, name: RcName) -> None:
        rc = self.rc(name)
        rc.present = False
        self.present &= ~rc.bit
        self.index.freed |= rc.bit
        self.version += 1

    def enqueue(self, arc: Arc, since: Ns) -> None:
        arc.since, arc.entry = since, self._next_entry()
        arc.rcs = arc.rcs or tuple(self.rcs_in(arc.mask))
        self.queued[arc.id] = arc
        if arc.patterns:
            self.by_pattern[arc.id] = arc
        self._count_demand(arc, 1)
        self.index.add(arc)
        self._clients.setdefault(arc.request.client, {})[arc.id] = arc

    def dequeue(self, arc: Arc) -> None:
        """A queued ARC waits no more, and runs neither."""
        del self.queued[arc.id]
        self.by_pattern.pop(arc.id, None)
        self._count_demand(arc, -1)
        self.index.remove(arc)

    def forget(self, arc: Arc) -> None:
        """An ARC that neither waits nor runs is over for good."""
        arc.move_to(ArcState.ENDED)
        self._forget_client(arc)

    def _forget_client(self, arc: Arc) -> None:
        arcs = self._clients[arc.request.client]
        del arcs[arc.id]
        if not arcs:
            del self._clients[arc.request.client]

    def arcs_of(self, client: ClientId) -> list[Arc]:
        """The ARCs of one client, first those that wait, each group in the order in which it came there."""
        arcs = self._clients.get(client, {}).values()
        return sorted(arcs, key=lambda arc: (arc.hold is not None, arc.entry))

    def hand_over(self, arc: Arc, to: ClientId, renamed: ArcId) -> None:
        """An ARC goes on under another client, by another name. Its hold stands, or its wait goes on."""
        if arc.hold is None:
            self.dequeue(arc)
            self._rename(arc, to, renamed)
            self.enqueue(arc, arc.since)
            return
        del self.running[arc.id]
        for rc in arc.rcs:
            del rc.holders[arc.id]
        self._uncount_owner(arc)
        self._rename(arc, to, renamed)
        arc.entry = self._next_entry()
        self._add_running(arc)
        self._clients.setdefault(to, {})[arc.id] = arc

    def _rename(self, arc: Arc, client: ClientId, name: ArcId) -> None:
        self._forget_client(arc)
        arc.request, arc.id = replace(arc.request, arc=name, client=client), name
        arc.rank = (*arc.rank[:3], name)
        arc.party = Party(name, arc.request.name, arc.priority)

    def start(self, arc: Arc, hold: Hold) -> None:
        self.dequeue(arc)
        arc.move_to(ArcState.RUNNING)
        arc.hold, arc.reason, arc.since, arc.entry = hold, None, self.now, self._next_entry()
        self._add_running(arc)
        self.index.touched |= arc.mask
        self.busy |= arc.mask & ~self.sharable

    def stop(self, arc: Arc) -> Hold:
        """Takes everything from a running ARC; what it was holding is returned."""
        hold = arc.hold
        assert hold is not None, arc.id  # noqa: S101
        del self.running[arc.id]
        self.version += 1
        self._uncount_owner(arc)
        arc.hold = None
        for rc in arc.rcs:
            del rc.holders[arc.id]
        self.busy &= ~arc.mask
        self.index.freed |= arc.mask
        return hold

    def min_runtime_over(self, arc: Arc) -> None:
        """A kept hold has had its minimum runtime: from now on its equals may preempt it."""
        self.index.freed |= arc.mask
        self.version += 1

    def quota_left(self, arc: Arc) -> int | None:
        """How many more ARCs of its owner may run, if `arc` is bound by a quota."""
        quota = self.policy.max_running_per_host
        if quota is None or self.policy.operator(arc.priority):
            return None
        return max(0, quota - self.running_by_owner[owner_of(arc.request.client)])

    def _add_running(self, arc: Arc) -> None:
        self.running[arc.id] = arc
        self.version += 1
        self.running_by_owner[owner_of(arc.request.client)] += 1
        for rc in arc.rcs:
            rc.holders[arc.id] = arc

    def _count_demand(self, arc: Arc, by: int) -> None:
        for rc in self.rcs_in(arc.named_mask) if arc.patterns else arc.rcs:
            rc.demand += by

    def _uncount_owner(self, arc: Arc) -> None:
        owner = owner_of(arc.request.client)
        self.running_by_owner[owner] -= 1
        if not self.running_by_owner[owner]:
            del self.running_by_owner[owner]

    def _next_entry(self) -> int:
        self.entries += 1
        return self.entries
