"""Strategy `priority`: the paper's heuristic, with votes that take their time.

The pass visits queued ARCs in rank order. For each, `a`:

1. An RC of `a` that is absent, or held by one that does not yield to `a`: `a` waits.
2. Every sharable RC that `a` needs must accept `a` beside all who would still hold it when the blockers
   (who hold an exclusive RC that `a` needs) and the candidates (who yield, and hold a sharable RC that `a`
   needs) were gone. Otherwise `a` waits, and nobody is preempted.
3. Reprieve: candidates keep their place in rank order as long as the votes allow. The others are preempted.
4. `a` starts.

A vote that is not known yet leaves the visit open. What an open visit would take or free is *off limits* for
lower ranks, and so is what a visit stopped by that would take or free; all others go on. The pass can be
run again from the top at any time: what a lower rank takes never makes a higher one possible (a lower rank
only displaces those who would have yielded to the higher one as well, and votes are monotone), so an answer
that arrives simply runs the next pass, and the outcome is that of votes given on the spot.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, ArcId, Ns, Rc
from zscout.scheduling.votes import HolderSet, Votes

UNSETTLED = "votes are out"


class Actions(Protocol):
    """What a strategy may do to the floor; each call is carried out at once and told as an effect."""

    def start(self, arc: Arc) -> None: ...
    def displace(self, arc: Arc, by: Arc) -> bool:
        """Takes everything from a running ARC for `by`; True if it is queued again."""
        ...

    def wait(self, arc: Arc, reason: str, *, settled: bool = True) -> None: ...
    def propose(self, rc: Rc, holders: HolderSet) -> None: ...


Strategy: TypeAlias = Callable[[Floor, Votes, Ns, Actions], None]
"""One pass: reads the floor and the votes, and acts."""


@dataclass(frozen=True, slots=True)
class Refused:
    """The visit is over: `reason` is why the ARC goes on waiting."""

    reason: str


@dataclass(frozen=True, slots=True)
class Open:
    """The visit can't be decided before these are answered."""

    questions: list[tuple[Rc, HolderSet]]


@dataclass(frozen=True, slots=True)
class Admitted:
    """The ARC may start once these are displaced."""

    victims: list[Arc]


def run_pass(floor: Floor, votes: Votes, now: Ns, actions: Actions) -> None:
    """One pass over the queue at `now`."""
    order = [(arc.rank, arc) for arc in floor.queued.values()]
    heapq.heapify(order)
    off_limits = 0
    while order:
        _, arc = heapq.heappop(order)
        visit = Visit(floor, votes, now, arc)
        if obstacle := visit.obstacle(off_limits):
            actions.wait(arc, obstacle)
            continue
        if visit.footprint & off_limits:
            off_limits |= visit.footprint
            actions.wait(arc, UNSETTLED, settled=False)
            continue
        match visit.decide():
            case Refused(reason):
                actions.wait(arc, reason)
            case Open(questions) if silent := [ask for ask in questions if votes.silent(ask[0].name)]:
                actions.wait(arc, f"{_list([rc.name for rc, _ in silent])} does not answer")
                for rc, holders in silent:
                    actions.propose(rc, holders)
            case Open(questions):
                off_limits |= visit.footprint
                actions.wait(arc, UNSETTLED, settled=False)
                for rc, holders in questions:
                    actions.propose(rc, holders)
            case Admitted(victims):
                for victim in victims:
                    if actions.displace(victim, by=arc):
                        heapq.heappush(order, (victim.rank, victim))
                actions.start(arc)


class Visit:
    """One look at one queued ARC: who is in its way, what it would take and free, what the RCs say."""

    def __init__(self, floor: Floor, votes: Votes, now: Ns, arc: Arc) -> None:
        self.floor, self.votes, self.now, self.arc = floor, votes, now, arc
        self.firm: list[tuple[Rc, Arc]] = []
        """Exclusive RCs it needs, with holders that do not yield to it."""
        self.blockers: dict[ArcId, Arc] = {}
        self.candidates: dict[ArcId, Arc] = {}
        self.footprint = arc.mask
        """All that the visit would take or free."""
        self._sharables: list[Rc] = []
        if not arc.mask & (floor.busy | floor.sharable):
            return
        for rc in floor.of(arc.mask & floor.busy):
            (holder,) = rc.holders.values()
            if holder.yields_to(arc, now):
                self.blockers[holder.id] = holder
            else:
                self.firm.append((rc, holder))
        self._sharables = list(floor.of(arc.mask & floor.sharable))
        for rc in self._sharables:
            for holder in rc.holders.values():
                if holder.id not in self.blockers and holder.yields_to(arc, now):
                    self.candidates[holder.id] = holder
        for group in (self.blockers, self.candidates):
            for holder in group.values():
                self.footprint |= holder.mask

    def obstacle(self, off_limits: int) -> str:
        """Why the ARC can't start whatever becomes of the visits that are open; empty if it may."""
        if absent := absence(self.floor, self.arc):
            return absent
        if any(not rc.bit & off_limits for rc, _ in self.firm):
            return "needs " + _list([f"{rc.name} (held by {_who(holder)})" for rc, holder in self.firm])
        if not off_limits:
            return ""
        for rc in self._sharables:
            if not rc.bit & off_limits:
                answer = self.votes.known(rc.name, self._firm_holders(rc))
                if answer is not None and not answer.accept:
                    return _veto(rc, answer.reason)
        return ""

    def decide(self) -> Refused | Open | Admitted:
        """Steps 2 and 3, with the votes that are known. Only for a visit without an obstacle."""
        verdict = self._ask([(rc, self._firm_holders(rc)) for rc in self._sharables])
        if verdict is not None:
            return verdict
        kept = {rc.name: self._firm_holders(rc) for rc in self._sharables}
        victims = list(self.blockers.values())
        for candidate in sorted(self.candidates.values(), key=lambda arc: arc.rank):
            shared = [rc for rc in self._sharables if candidate.id in rc.holders]
            beside = [(rc, kept[rc.name] | {candidate.id}) for rc in shared]
            verdict = self._ask(beside)
            match verdict:
                case None:
                    for rc, holders in beside:
                        kept[rc.name] = holders
                case Refused() if self._vetoed(beside):
                    victims.append(candidate)
                case Refused() | Open():
                    return verdict
        return Admitted(sorted(victims, key=lambda arc: arc.rank))

    def refusal(self) -> str:
        """The veto that keeps the ARC out beside those who would stay; empty if none is known."""
        for rc in self._sharables:
            answer = self.votes.known(rc.name, self._firm_holders(rc))
            if answer is None and self.votes.silent(rc.name):
                return f"{rc.name} does not answer"
            if answer is not None and not answer.accept:
                return _veto(rc, answer.reason)
        return ""

    def _firm_holders(self, rc: Rc) -> HolderSet:
        stay = (arc for arc in rc.holders if arc not in self.blockers and arc not in self.candidates)
        return frozenset((*stay, self.arc.id))

    def _vetoed(self, sets: list[tuple[Rc, HolderSet]]) -> bool:
        answers = (self.votes.known(rc.name, holders) for rc, holders in sets)
        return any(answer is not None and not answer.accept for answer in answers)

    def _ask(self, sets: list[tuple[Rc, HolderSet]]) -> Refused | Open | None:
        """None if all RCs accept. A veto settles it whatever else is unknown."""
        unknown: list[tuple[Rc, HolderSet]] = []
        for rc, holders in sets:
            answer = self.votes.known(rc.name, holders)
            if answer is None:
                unknown.append((rc, holders))
            elif not answer.accept:
                return Refused(_veto(rc, answer.reason))
        return Open(unknown) if unknown else None


def absence(floor: Floor, arc: Arc) -> str:
    """Which RCs of `arc` are not there, in words; empty if all are."""
    absent = arc.mask & ~floor.present
    return f"{_list([rc.name for rc in floor.of(absent)])} not on the mesh" if absent else ""


def _who(holder: Arc) -> str:
    return f"{holder.name}, priority {holder.request.priority}"


def _veto(rc: Rc, reason: str) -> str:
    return f"{rc.name} refuses: {reason}" if reason else f"{rc.name} refuses"


def _list(names: list[str]) -> str:
    shown = names[:3]
    return ", ".join(shown) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
