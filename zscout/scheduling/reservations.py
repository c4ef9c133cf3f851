"""Bounded waiting: an ARC that has waited for the fleet's patience is *due*, and nobody may pass it any more.

Shortest-first starves, and so does the larger set of ARCs where it is preferred to a smaller one. The remedy
is that of batch schedulers, reservation with conservative backfill (Mu'alem and Feitelson, IEEE TPDS 12(6),
2001), on distinct RCs instead of many equal processors, and with a date: what is reserved is the time from
which the ARC is due, so that until then nobody is held back who would be over by then. Minimum runtimes are
exact, so reservations are.

Half its patience ahead, an ARC is *owed* its RCs. In the order of priority, then of waiting, each of the owed
is given the earliest time, from when it is due, at which its RCs are free of those who hold them and do not
yield, and of those who were owed before it. An ARC of equal or lower priority that shares an RC with it may
start only if it is over by then, or if the RC is sharable and accepts it beside everyone concerned.

`docs/scheduling.md` states the promise that follows, and what else was tried.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, Ns, Rc
from zscout.scheduling.policy import owner_of
from zscout.scheduling.votes import HolderSet, Votes

MAX_OWED: Final = 16
"""ARCs that are kept a place at one time; those owed after them follow as these start."""


class Claim(NamedTuple):
    """An RC is kept for `creditor` from `start` on."""

    creditor: Arc
    start: Ns


class Bar(NamedTuple):
    """An ARC would be in the way of a claim at `rc`, unless a vote that is not known yet says otherwise."""

    rc: Rc
    creditor: Arc
    ask: HolderSet | None = None

    @property
    def reason(self) -> str:
        return f"{self.rc.name} is kept for {self.creditor.name}, whose time to wait is over before this ends"


def reservations(
    floor: Floor, votes: Votes, now: Ns, patience: Ns, last: Reservations | None
) -> Reservations:
    """What is kept at `now`: the `last` that was found, if nothing has changed that it depends on."""
    floor.waits.ripen(now - patience // 2, floor.queued)
    if last is not None and last.go_on(now):
        return last
    return Reservations(floor, votes, now, patience)


def _inputs(floor: Floor, votes: Votes) -> tuple[int, int, int]:
    return floor.changes, votes.changes, floor.waits.owed_changes


class Reservations:
    """What is kept for whom at one instant: for those of `floor.waits.owed`."""

    def __init__(self, floor: Floor, votes: Votes, now: Ns, patience: Ns) -> None:
        """`patience` in ns."""
        self._floor, self._votes, self._now = floor, votes, now
        self._patience = patience
        self.claims: dict[int, list[Claim]] = {}
        """By bit of the RC, the first owed first; of an exclusive RC only the first."""
        self.bits = 0
        """RCs with claims."""
        self._free: dict[int, Ns] = {}
        """By bit: when those owed before are done with the RC."""
        self._made_of = _inputs(floor, votes)
        for _, _, arc in floor.waits.owed[:MAX_OWED]:
            self._reserve(floor.queued[arc])

    def go_on(self, now: Ns) -> bool:
        """Goes on to `now`. False: something has changed since this was found.

        Time alone changes nothing: who is to start later is kept the same place, and nobody could be over
        before one that is due already."""
        self._now = now
        return self._made_of == _inputs(self._floor, self._votes)

    def _reserve(self, arc: Arc) -> None:
        rcs = self._rcs(arc)
        if not all(rc.present for rc in rcs):
            return
        start = max(self._within_quota(arc), *(self._free_from(rc, arc) for rc in rcs))
        if math.isinf(start):
            return
        claim = Claim(arc, max(int(start), self.due(arc)))
        for rc in rcs:
            claims = self.claims.setdefault(rc.bit, [])
            if rc.sharable or not claims:
                claims.append(claim)
            self._free[rc.bit] = max(self._free.get(rc.bit, 0), claim.start + arc.request.min_runtime)
            self.bits |= rc.bit

    def _rcs(self, arc: Arc) -> list[Rc]:
        """What it is to have: of those that meet a pattern, the one that has room for it first. An RC that is
        not there stands for a pattern that none is left for."""
        rcs = list(self._floor.of(arc.named)) if arc.slots else list(arc.rcs)
        for need in arc.slots:
            left = [rc for rc in self._floor.matching(need) if rc.present and rc not in rcs]
            nothing = Rc(need, 0)
            rcs.append(min(left, key=lambda rc: (self._free_from(rc, arc), rc.bit), default=nothing))
        return rcs

    def _within_quota(self, arc: Arc) -> float:
        """When its owner has room for `arc`."""
        if self._floor.room(arc) != 0:
            return self._now
        owner = owner_of(arc.request.client)
        own = (one for one in self._floor.running.values() if owner_of(one.request.client) == owner)
        return min(math.inf if one.hold is None or one.request.keep else one.hold.end for one in own)

    def _free_from(self, rc: Rc, arc: Arc) -> float:
        """When `rc` has room for `arc` at the latest; infinite where nobody can tell."""
        firm = [holder for holder in rc.holders.values() if not holder.yields_to(arc, self._now)]
        if rc.sharable:
            sharing = (claim.creditor.id for claim in self.claims.get(rc.bit, ()))
            if self._accepts(rc, frozenset((*(holder.id for holder in firm), *sharing, arc.id))):
                return self._now
            alone = self._votes.known(rc.name, frozenset((arc.id,)))
            if self._votes.silent(rc.name) or (alone is not None and not alone.accept):
                return math.inf
        start: float = self._free.get(rc.bit, self._now)
        for holder in firm:
            start = max(start, _end(holder, arc))
        return start

    def due(self, arc: Arc) -> Ns:
        """When its patience is over."""
        return arc.since + self._patience

    def first(self, arc: Arc) -> bool:
        """Whether `arc` goes before those of its equals that could start as well. Of exclusive RCs, nobody is
        left who could take any; but of several that a sharable RC accepts beside `arc`, each by itself, it
        may not accept all."""
        return arc.owed and bool(arc.mask & self._floor.sharable) and self.due(arc) <= self._now

    def bar(self, arc: Arc) -> Bar | None:
        """What `arc` would be in the way of if it started now."""
        if not arc.mask & self.bits:
            return None
        for rc in self._floor.of(arc.mask & self.bits):
            before: list[Arc] = []
            bars: Claim | None = None
            for claim in self.claims[rc.bit]:
                if claim.creditor is arc:
                    break
                before.append(claim.creditor)
                if bars is None and self._delays(arc, claim):
                    bars = claim
            if bars is None:
                continue
            if not rc.sharable:
                return Bar(rc, bars.creditor)
            together = frozenset((*rc.holders, arc.id, *(one.id for one in before)))
            if not self._accepts(rc, together):
                known = self._votes.known(rc.name, together)
                asked = known is None and not self._votes.silent(rc.name)
                return Bar(rc, bars.creditor, together if asked else None)
        return None

    def keeps(self, rc: Rc, arc: Arc) -> bool:
        """Whether `rc`, exclusive, is kept for another who goes before `arc`."""
        claims = self.claims.get(rc.bit, ())
        return any(claim.creditor is not arc and self._delays(arc, claim) for claim in claims)

    def _delays(self, arc: Arc, claim: Claim) -> bool:
        """Whether `arc`, started now, would hold what the claim is for when it begins, and must not."""
        return arc.band <= claim.creditor.band and self._now + arc.request.min_runtime > claim.start

    def changed(self, earlier: Reservations) -> int:
        """Bits of the RCs at which other claims stand now than then."""
        bits = 0
        for bit in self.claims.keys() | earlier.claims.keys():
            if self.claims.get(bit) != earlier.claims.get(bit):
                bits |= bit
        return bits

    def _accepts(self, rc: Rc, holders: HolderSet) -> bool:
        answer = self._votes.known(rc.name, holders)
        return answer is not None and answer.accept


def _end(holder: Arc, arc: Arc) -> float:
    """When a holder is gone, or yields. What a higher priority keeps has no end that is known."""
    if holder.hold is None or (holder.request.keep and holder.priority > arc.priority):
        return math.inf
    return holder.hold.end
