"""Who holds what, who waits: the state that a scheduling pass reads and changes.

Sets of RCs are integer bit masks; `needs & ~free == 0` is the whole test for an ARC of exclusive RCs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from zscout.keyexpr import is_pattern, matcher
from zscout.scheduling.model import Arc, ArcId, ClientId, Hold, Need, Ns, Params, Rc, RcName
from zscout.scheduling.policy import DEFAULT, Policy, owner_of
from zscout.scheduling.waits import Waits


class Floor:
    """The RCs, the ARCs and the holds between them. Every change goes through its methods."""

    def __init__(self, policy: Policy = DEFAULT) -> None:
        self.policy = policy
        self.rcs: dict[RcName, Rc] = {}
        self.queued: dict[ArcId, Arc] = {}
        self.running: dict[ArcId, Arc] = {}
        self.present = 0
        """Bits of the RCs that are there."""
        self.sharable = 0
        """Bits of the RCs that vote and take several holders."""
        self.busy = 0
        """Bits of the exclusive RCs that somebody holds."""
        self.waits = Waits()
        self.flexible: dict[ArcId, Arc] = {}
        """Those of the queued that need an RC by pattern."""
        self._matching: dict[Need, list[Rc]] = {}
        self.owners: Counter[str] = Counter()
        """How many ARCs of each owner run."""
        self._by_bit: list[Rc] = []
        self._clients: dict[ClientId, dict[ArcId, Arc]] = {}
        self.turns = 0
        """Counts who was queued or started."""
        self.changes = 0
        """Grows with all that changes who holds what, which RCs are there, and who yields."""

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
        arc.mask = arc.named | self.mask(bound.values())
        arc.rcs = tuple(self.of(arc.mask))

    def params(self, arc: Arc, rc: Rc) -> Params:
        """What an ARC would ask of an RC, whether it is bound to it at present or not."""
        found = arc.needs.get(rc.name)
        if found is None:
            meets = (need for need in arc.slots if rc in self.matching(need))
            found = arc.request.needs[next(meets)]
        return found

    def everywhere(self, arc: Arc) -> int:
        """Bits of all RCs that an ARC could hold."""
        bits = arc.mask
        for need in arc.slots:
            for rc in self.matching(need):
                bits |= rc.bit
        return bits

    def unbind(self, arc: Arc) -> None:
        """There is no RC for some pattern of the ARC."""
        if arc.rcs and not arc.bound:
            return
        arc.bound, arc.mask = {}, arc.named
        arc.needs = {need: params for need, params in arc.request.needs.items() if not is_pattern(need)}
        arc.rcs = tuple(self.of(arc.mask))

    def known(self) -> int:
        """Bits of all RCs that were ever named."""
        return (1 << len(self._by_bit)) - 1

    def mask(self, names: Iterable[RcName]) -> int:
        mask, rcs = 0, self.rcs
        for name in names:
            rc = rcs.get(name) or self.rc(name)
            mask |= rc.bit
        return mask

    def of(self, mask: int) -> Iterator[Rc]:
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
        self.waits.freed |= rc.bit
        self.changes += 1

    def leave(self, name: RcName) -> None:
        rc = self.rc(name)
        rc.present = False
        self.present &= ~rc.bit
        self.waits.freed |= rc.bit
        self.changes += 1

    def enqueue(self, arc: Arc, since: Ns) -> None:
        arc.since, arc.turn = since, self._turn()
        arc.rcs = arc.rcs or tuple(self.of(arc.mask))
        self.queued[arc.id] = arc
        if arc.slots:
            self.flexible[arc.id] = arc
        self._count_wanted(arc, 1)
        self.waits.add(arc)
        self._clients.setdefault(arc.request.client, {})[arc.id] = arc

    def drop(self, arc: Arc) -> None:
        """A queued ARC waits no more, and runs neither."""
        del self.queued[arc.id]
        self.flexible.pop(arc.id, None)
        self._count_wanted(arc, -1)
        self.waits.remove(arc)

    def forget(self, arc: Arc) -> None:
        """An ARC that neither waits nor runs is over for good."""
        arcs = self._clients[arc.request.client]
        del arcs[arc.id]
        if not arcs:
            del self._clients[arc.request.client]

    def arcs_of(self, client: ClientId) -> list[Arc]:
        """The ARCs of one client, first those that wait, each group in the order in which it came there."""
        arcs = self._clients.get(client, {}).values()
        return sorted(arcs, key=lambda arc: (arc.hold is not None, arc.turn))

    def hand_over(self, arc: Arc, to: ClientId, renamed: ArcId) -> None:
        """An ARC goes on under another client, by another name. Its hold stands, or its wait goes on."""
        if arc.hold is None:
            self.drop(arc)
            self._rename(arc, to, renamed)
            self.enqueue(arc, arc.since)
            return
        del self.running[arc.id]
        for rc in arc.rcs:
            del rc.holders[arc.id]
        self._count_out(arc)
        self._rename(arc, to, renamed)
        arc.turn = self._turn()
        self._add_running(arc)
        self._clients.setdefault(to, {})[arc.id] = arc

    def _rename(self, arc: Arc, client: ClientId, name: ArcId) -> None:
        self.forget(arc)
        arc.request, arc.id = replace(arc.request, arc=name, client=client), name
        arc.rank = (*arc.rank[:3], name)

    def start(self, arc: Arc, hold: Hold, now: Ns) -> None:
        self.drop(arc)
        arc.hold, arc.reason, arc.since, arc.turn = hold, "", now, self._turn()
        self._add_running(arc)
        self.waits.stirred |= arc.mask
        self.busy |= arc.mask & ~self.sharable

    def stop(self, arc: Arc) -> Hold:
        """Takes everything from a running ARC; what it was holding is returned."""
        hold = arc.hold
        assert hold is not None, arc.id  # noqa: S101
        del self.running[arc.id]
        self.changes += 1
        self._count_out(arc)
        arc.hold = None
        for rc in arc.rcs:
            del rc.holders[arc.id]
        self.busy &= ~arc.mask
        self.waits.freed |= arc.mask
        return hold

    def overstayed(self, arc: Arc) -> None:
        """A kept hold has had its minimum runtime: from now on it yields to its equals."""
        self.waits.freed |= arc.mask
        self.changes += 1

    def room(self, arc: Arc) -> int | None:
        """How many more ARCs of its owner may run, if `arc` is bound by a quota."""
        quota = self.policy.max_running_per_host
        if quota is None or self.policy.operator(arc.priority):
            return None
        return max(0, quota - self.owners[owner_of(arc.request.client)])

    def _add_running(self, arc: Arc) -> None:
        self.running[arc.id] = arc
        self.changes += 1
        self.owners[owner_of(arc.request.client)] += 1
        for rc in arc.rcs:
            rc.holders[arc.id] = arc

    def _count_wanted(self, arc: Arc, by: int) -> None:
        for rc in self.of(arc.named) if arc.slots else arc.rcs:
            rc.wanted += by

    def _count_out(self, arc: Arc) -> None:
        owner = owner_of(arc.request.client)
        self.owners[owner] -= 1
        if not self.owners[owner]:
            del self.owners[owner]

    def _turn(self) -> int:
        self.turns += 1
        return self.turns

    def validate(self) -> None:
        """Checks every invariant; for tests and simulators. Raises AssertionError that names the breach."""
        check(not self.queued.keys() & self.running.keys(), "an ARC both waits and runs")
        for arc in self.queued.values():
            check(arc.hold is None, f"{arc.id} waits and holds")
        for arc in self.running.values():
            check(arc.hold is not None, f"{arc.id} runs without a hold")
            check(arc.mask & ~self.present == 0, f"{arc.id} holds an absent RC")
            check(arc.bound.keys() == set(arc.slots), f"{arc.id} runs and is not bound")
            for need, rc_name in arc.bound.items():
                check(matcher(need)(rc_name), f"{arc.id} has {rc_name} for {need}")
            check(len(arc.needs) == len(arc.request.needs), f"{arc.id} has one RC for two needs")
            for rc in self.of(arc.mask):
                check(rc.holders.get(arc.id) is arc, f"{arc.id} holds only a part: not {rc.name}")
        busy = 0
        for rc in self.rcs.values():
            for holder in rc.holders:
                check(holder in self.running, f"{rc.name} is held by {holder}, which does not run")
                check(rc.name in self.running[holder].needs, f"{holder} did not ask for {rc.name}")
            if not rc.sharable:
                check(len(rc.holders) <= 1, f"{rc.name} has two holders: {sorted(rc.holders)}")
                busy |= rc.bit if rc.holders else 0
        counted = Counter(owner_of(arc.request.client) for arc in self.running.values())
        check(counted == self.owners, "the owners' ARCs are miscounted")
        wanted = Counter(
            name for arc in self.queued.values() for name in arc.request.needs if name in self.rcs
        )
        for rc in self.rcs.values():
            check(rc.wanted == wanted[rc.name], f"{rc.name} is wanted by {wanted[rc.name]}, not {rc.wanted}")
        flexible = {arc.id for arc in self.queued.values() if arc.slots}
        check(flexible == self.flexible.keys(), "those who wait by pattern are not those known")
        check(busy == self.busy, "the mask of busy RCs is wrong")
        for breach in self.waits.validate(self.queued):
            check(False, breach)
        known = {arc.id for arcs in self._clients.values() for arc in arcs.values()}
        check(known == self.queued.keys() | self.running.keys(), "the clients' ARCs are not those known")


def check(truth: bool, breach: str) -> None:
    if not truth:
        raise AssertionError(breach)
