"""What a pass could change at all, in parts that can be decided apart.

Those in play (`in_play.py`) that share no RC, not even by way of others, are decided apart: so a slow voter
stops nobody who has nothing to do with it, and the cost is that of the parts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter

from zscout.scheduling.floor import Floor
from zscout.scheduling.in_play import in_play
from zscout.scheduling.model import Arc, ArcId, Ns, Rc
from zscout.scheduling.packing import Item, Problem
from zscout.scheduling.priority import Actions
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.votes import HolderSet, Votes


def parts_in_play(
    floor: Floor, votes: Votes, now: Ns, reserved: Reservations | None = None, limit: int | None = None
) -> list[Part]:
    """The parts in which there is a choice, best-ranked first; none if more than `limit` ARCs could start.

    One newcomer is no choice where nobody has to end for it, or those have to whose exclusive RCs it needs:
    `priority` starts it, as any strategy would."""
    arcs = in_play(floor, votes, now, reserved, limit)
    return [
        Part(floor, votes, now, members, reserved)
        for members in apart(arcs or ())
        if len(members) > 1
        and (
            sum(arc.hold is None for arc in members) > 1 or any(arc.mask & floor.sharable for arc in members)
        )
    ]


def apart(arcs: Iterable[Arc]) -> list[list[Arc]]:
    """The ARCs in groups that have no RC in common, each in rank order; the best-ranked group first."""
    members = sorted(arcs, key=attrgetter("rank"))
    if _hang_together(members):
        return [members]
    leader = list(range(len(members)))

    def find(number: int) -> int:
        while leader[number] != number:
            leader[number] = leader[leader[number]]
            number = leader[number]
        return number

    first: dict[int, int] = {}
    """By bit: the first that needs the RC."""
    for number, arc in enumerate(members):
        mask = arc.mask
        while mask:
            bit = mask & -mask
            mask ^= bit
            leader[find(first.setdefault(bit, number))] = find(number)
    groups: dict[int, list[Arc]] = {}
    for number, arc in enumerate(members):
        groups.setdefault(find(number), []).append(arc)
    # Each begins with its best-ranked, and they were met in that order.
    return list(groups.values())


def _grade(arc: Arc, first: set[ArcId], now: Ns) -> tuple[int, int]:
    """What sorts ARCs into levels, the best smallest: first their priority. A shielded hold counts for more,
    as only those above its shield may end it. Where some are to go `first`, they go before their equals, but
    not before those who run: equals are not displaced."""
    if arc.hold is not None and arc.hold.shield is not None and arc.shielded(now):
        return min(-arc.priority, 1 - arc.hold.shield), 0
    if arc.hold is not None:
        later = bool(first) and arc.overstays(now)
    else:
        later = bool(first) and arc.id not in first
    return -arc.priority, 2 if later else 1


def _hang_together(arcs: Sequence[Arc]) -> bool:
    """Whether a few looks are enough to see that there is one group only: the usual case."""
    mask, rest = 0, list(arcs)
    for _ in range(3):
        apart = []
        for arc in rest:
            if mask and not arc.mask & mask:
                apart.append(arc)
            else:
                mask |= arc.mask
        if not apart:
            return True
        rest = apart
    return False


class Part:
    """ARCs that are decided together, and what the RCs have said about them."""

    def __init__(
        self, floor: Floor, votes: Votes, now: Ns, arcs: list[Arc], reserved: Reservations | None = None
    ) -> None:
        self.floor, self.votes, self.now = floor, votes, now
        first = {arc.id for arc in arcs if reserved is not None and reserved.first(arc)}
        graded = sorted((_grade(arc, first, now), arc.rank, arc) for arc in arcs)
        self.arcs = [arc for _, _, arc in graded]
        """Best first."""
        self.mask = 0
        """All that they need or hold."""
        for arc in arcs:
            self.mask |= arc.mask
        grades = [grade for grade, _, _ in graded]
        levels = {grade: level for level, grade in enumerate(dict.fromkeys(grades))}
        exclusive = ~floor.sharable
        self.items = [
            Item(
                mask=arc.mask & exclusive,
                width=arc.mask.bit_count(),
                level=levels[grade],
                standing=arc.hold is not None,
                spent=arc.overstays(now),
            )
            for arc, grade in zip(self.arcs, grades, strict=True)
        ]
        self._number = {arc.id: number for number, arc in enumerate(self.arcs)}
        self.sharables = list(floor.of(self.mask & floor.sharable))
        vetoes = {rc.name: set(self._vetoes(rc)) for rc in self.sharables}
        self.barred = set().union(*vetoes.values())
        """Sets that vetoes rule out, as `Problem` has them."""
        self._short = {name for name, bars in vetoes.items() if bars}
        """RCs that have not enough for all."""

    def problem(self) -> Problem:
        return Problem(self.items, sorted(self.barred))

    def ask(self, chosen: int) -> list[tuple[Rc, HolderSet]] | None:
        """What has to be asked before this set can be taken. None: a veto, now in `barred`, rules it out."""
        questions: list[tuple[Rc, HolderSet]] = []
        ruled_out = False
        for rc in self.sharables:
            holders = frozenset(self._holders(rc, chosen))
            # Who holds it now has been accepted; an RC that can't carry its holders says so itself.
            if holders <= rc.holders.keys():
                continue
            answer = self.votes.known(rc.name, holders)
            if answer is None and not self.votes.silent(rc.name):
                questions.append((rc, self._probe(rc, holders) if rc.name in self._short else holders))
            elif answer is None or not answer.accept:
                # Who was not asked in time is taken to refuse, from the first that it was not asked about.
                ranked, accepted = self._ranked(rc, holders)
                self.barred.add(self._bits(frozenset(ranked[: accepted + 1]) if answer is None else holders))
                ruled_out = True
        return None if ruled_out else questions

    def take(self, chosen: int, actions: Actions) -> None:
        """Carries the set out: ends who has to end, starts who is to start."""
        taken = [chosen >> number & 1 for number in range(len(self.arcs))]
        starting = [arc for arc, one in zip(self.arcs, taken, strict=True) if one and arc.hold is None]
        ending = [arc for arc, one in zip(self.arcs, taken, strict=True) if not one and arc.hold is not None]
        for victim in ending:
            actions.displace(victim, by=self._taker(victim, starting))
        for arc in starting:
            actions.start(arc)

    def _vetoes(self, rc: Rc) -> Iterator[int]:
        """The vetoes of `rc` that bear on these ARCs. Who else holds it stays."""
        for holders in self.votes.vetoed(rc.name):
            if all(arc in self._number or arc in rc.holders for arc in holders) and (
                bar := self._bits(holders)
            ):
                yield bar

    def _probe(self, rc: Rc, holders: HolderSet) -> HolderSet:
        """What to ask an RC that is short: half of those whom it has not accepted yet, beside the others.

        A veto of few rules out far more sets than one of many; in a few rounds all are asked."""
        ranked, accepted = self._ranked(rc, holders)
        return frozenset(ranked[: (accepted + len(ranked) + 1) // 2])

    def _ranked(self, rc: Rc, holders: HolderSet) -> tuple[list[ArcId], int]:
        """Those who hold `rc` already, then the others by rank; and how many of these it has accepted.

        Not all of `holders` are accepted."""
        newcomers = (arc.id for arc in self.arcs if arc.id in holders and arc.id not in rc.holders)
        ranked = [*(holders & rc.holders.keys()), *newcomers]
        accepted = len(ranked) - 1
        while accepted and not self._accepted(rc, frozenset(ranked[:accepted])):
            accepted -= 1
        return ranked, accepted

    def _accepted(self, rc: Rc, holders: HolderSet) -> bool:
        answer = self.votes.known(rc.name, holders)
        return holders <= rc.holders.keys() or (answer is not None and answer.accept)

    def _holders(self, rc: Rc, chosen: int) -> Iterator[ArcId]:
        """Who would hold `rc`."""
        for holder in rc.holders:
            if holder not in self._number:
                yield holder
        for number, arc in enumerate(self.arcs):
            if chosen >> number & 1 and arc.mask & rc.bit:
                yield arc.id

    def _bits(self, holders: HolderSet) -> int:
        return sum(1 << self._number[arc] for arc in holders if arc in self._number)

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
