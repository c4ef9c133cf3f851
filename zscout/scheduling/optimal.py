"""Strategy `optimal`: in each pass the best set of ARCs that could hold their RCs together.

The set's value is the vector of (ARC, RC) pairs in use by priority, highest first (`packing.py`). ARCs that
share no RC, not even by way of others, are decided apart: so a slow voter stops nobody who has nothing to do
with it, and the cost is that of the parts.

Votes are asked as late as can be: the best set is sought as if every vote that is not known were a yes, and
only what that set needs is asked. A veto rules that set of holders out, and every larger one; then the next
best is sought. While votes are out nothing changes in that part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, ArcId, Ns, Rc
from zscout.scheduling.packing import Item, Packing, order, pack
from zscout.scheduling.priority import UNSETTLED, Actions, Visit, absence
from zscout.scheduling.votes import HolderSet, Votes

NODES = 200_000
"""Steps of search in one part of one pass: the best set found by then is taken, never less than what the
heuristic finds."""

Packer = Callable[[Sequence[Item], Iterable[int]], Packing]


def run_pass(floor: Floor, votes: Votes, now: Ns, actions: Actions, packer: Packer | None = None) -> None:
    """One pass at `now`. `packer` finds the best set of one part; exact search within NODES by default."""
    contenders: list[Arc] = list(floor.running.values())
    for arc in floor.queued.values():
        if absent := absence(floor, arc):
            actions.wait(arc, absent)
        else:
            contenders.append(arc)
    for part in parts(contenders):
        if any(arc.hold is None for arc in part):
            Part(floor, votes, now, part).decide(actions, packer or _exact)


def _exact(items: Sequence[Item], barred: Iterable[int]) -> Packing:
    return pack(items, barred, nodes=NODES)


def parts(arcs: Iterable[Arc]) -> list[list[Arc]]:
    """The ARCs, parted so that no two parts have an RC in common; best-ranked part first."""
    found: list[tuple[int, list[Arc]]] = []
    for arc in arcs:
        mask, members = arc.mask, [arc]
        apart = []
        for other_mask, others in found:
            if other_mask & mask:
                mask |= other_mask
                members += others
            else:
                apart.append((other_mask, others))
        found = [*apart, (mask, members)]
    ranked = [sorted(members, key=lambda arc: arc.rank) for _, members in found]
    return sorted(ranked, key=lambda members: members[0].rank)


@dataclass(slots=True)
class _Choice:
    """A set that might be taken, and what has to be asked about it first."""

    chosen: set[ArcId]
    questions: list[tuple[Rc, HolderSet]]


class Part:
    """ARCs that are decided together, in rank order."""

    def __init__(self, floor: Floor, votes: Votes, now: Ns, arcs: list[Arc]) -> None:
        self.floor, self.votes, self.now = floor, votes, now
        levels = {
            priority: level
            for level, priority in enumerate(sorted({arc.request.priority for arc in arcs}, reverse=True))
        }
        exclusive = ~floor.sharable
        pairs = [
            (
                Item(
                    mask=arc.mask & exclusive,
                    width=arc.mask.bit_count(),
                    level=levels[arc.request.priority],
                    standing=arc.hold is not None,
                    spent=arc.overstays(now),
                ),
                arc,
            )
            for arc in arcs
        ]
        pairs.sort(key=lambda pair: order(pair[0]))
        self.items = [item for item, _ in pairs]
        self.arcs = [arc for _, arc in pairs]
        shared = 0
        for arc in arcs:
            shared |= arc.mask & floor.sharable
        self.sharables = list(floor.of(shared))

    def decide(self, actions: Actions, packer: Packer) -> None:
        choice = self._choose(packer)
        if choice.questions:
            for arc in self.arcs:
                if arc.hold is None:
                    actions.wait(arc, UNSETTLED, settled=False)
        else:
            self._take(choice.chosen, actions)
        # A silent RC is asked as well, so that it can show that it is back; nobody waits for it.
        for rc, holders in (*choice.questions, *self._silent):
            actions.propose(rc, holders)

    def _choose(self, packer: Packer) -> _Choice:
        """The best set that no known veto rules out, and the votes that it still needs."""
        barred = [self._bits(holders) for rc in self.sharables for holders in self._vetoed(rc)]
        self._silent: list[tuple[Rc, HolderSet]] = []
        while True:
            packing = packer(self.items, barred)
            chosen = {arc.id for number, arc in enumerate(self.arcs) if packing.chosen >> number & 1}
            questions: list[tuple[Rc, HolderSet]] = []
            ruled_out = False
            for rc in self.sharables:
                holders = frozenset(arc.id for arc in self.arcs if arc.id in chosen and arc.mask & rc.bit)
                # Who holds it now has been accepted; an RC that can't carry its holders says so itself.
                if holders <= rc.holders.keys():
                    continue
                answer = self.votes.known(rc.name, holders)
                if answer is None and not self.votes.silent(rc.name):
                    questions.append((rc, holders))
                elif answer is None or not answer.accept:
                    ruled_out = True
                    barred.append(self._bits(holders))
                    if answer is None:
                        self._silent.append((rc, holders))
            if not ruled_out:
                return _Choice(chosen, questions)

    def _vetoed(self, rc: Rc) -> list[HolderSet]:
        here = {arc.id for arc in self.arcs}
        return [holders for holders in self.votes.vetoed(rc.name) if holders <= here]

    def _bits(self, holders: HolderSet) -> int:
        return sum(1 << number for number, arc in enumerate(self.arcs) if arc.id in holders)

    def _take(self, chosen: set[ArcId], actions: Actions) -> None:
        ranked = sorted(self.arcs, key=lambda arc: arc.rank)
        starting = [arc for arc in ranked if arc.hold is None and arc.id in chosen]
        for victim in [arc for arc in ranked if arc.hold is not None and arc.id not in chosen]:
            actions.displace(victim, by=self._taker(victim, starting))
        for arc in starting:
            actions.start(arc)
        for arc in ranked:
            if arc.id in self.floor.queued:
                actions.wait(arc, self._reason(arc))

    def _taker(self, victim: Arc, starting: list[Arc]) -> Arc:
        """For whom a hold is taken away: the best-ranked newcomer that needs one of its exclusive RCs, else
        one of its sharable ones, else the best-ranked of all."""
        entitled = [arc for arc in starting if victim.yields_to(arc, self.now)] or starting
        exclusive = ~self.floor.sharable
        for mask in (victim.mask & exclusive, victim.mask):
            for arc in entitled:
                if arc.mask & mask:
                    return arc
        return entitled[0]

    def _reason(self, arc: Arc) -> str:
        visit = Visit(self.floor, self.votes, self.now, arc)
        return visit.obstacle(0) or visit.refusal() or "would take the place of a set that uses more"
