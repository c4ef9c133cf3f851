"""One check of one queued ARC: steps 3a to 3c of `priority.py`, for the other strategies too."""

from __future__ import annotations

import math
from dataclasses import dataclass

from zscout.scheduling.model import Arc, Rc
from zscout.scheduling.reason import SHOWN, Reason, ReasonCode, of_rcs
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import Answer, HolderSet
from zscout.types import ArcId


@dataclass(frozen=True, slots=True)
class Inadmissible:
    """`rc` keeps the ARC out as long as its situation is this; `reason` says so."""

    rc: Rc
    reason: Reason


@dataclass(frozen=True, slots=True)
class VotesNeeded:
    """The check can't be decided before these are answered."""

    questions: list[tuple[Rc, HolderSet]]


@dataclass(frozen=True, slots=True)
class Admissible:
    """The ARC may start once these are preempted."""

    victims: list[Arc]


class AdmissionCheck:
    """Who is in the way of a queued ARC, what it would take and free, what the RCs vote."""

    def __init__(self, state: SchedulerState, arc: Arc) -> None:
        self.state, self.arc = state, arc
        self.votes, self.now = state.votes, state.now
        self.firm: list[tuple[Rc, Arc]] = []
        """Exclusive RCs it needs, with holders that are not preempted for it."""
        self.blockers: dict[ArcId, Arc] = {}
        """The holders of the others."""
        self._sharables: list[Rc] = []
        for rc in arc.rcs:
            if rc.sharable:
                self._sharables.append(rc)
                continue
            for holder in rc.holders.values():
                if holder.preemptible_by(arc, self.now):
                    self.blockers[holder.id] = holder
                else:
                    self.firm.append((rc, holder))

    def footprint(self) -> int:
        """All that the ARC would take or free, as bits."""
        bits = self.arc.mask
        for holder in (*self.blockers.values(), *self._candidates()):
            bits |= holder.mask
        return bits

    def obstacle(self, off_limits: int) -> Inadmissible | None:
        """What keeps the ARC out whatever becomes of what is `off_limits`, with an RC that does so by itself:
        of several, one that will do so for long, so that the ARC is not checked in vain."""
        for rc in self.arc.rcs:
            if not rc.present:
                absent = [rc.name for rc in self.arc.rcs if not rc.present]
                return Inadmissible(rc, of_rcs(ReasonCode.ABSENT, absent))
        lasting: tuple[int, float, int] | None = None
        for number, (rc, holder) in enumerate(self.firm):
            if not off_limits or not rc.bit & off_limits:
                end = math.inf if holder.request.keep or holder.hold is None else holder.hold.end
                lasting = max(lasting or (holder.priority, -1.0, 0), (holder.priority, end, number))
        if lasting is not None:
            shown = self.firm[:SHOWN]
            rcs, parties = tuple(rc.name for rc, _ in shown), tuple(holder.party for _, holder in shown)
            reason = Reason(ReasonCode.HELD, rcs, parties, number=len(self.firm))
            return Inadmissible(self.firm[lasting[2]][0], reason)
        if off_limits:
            for rc in self._sharables:
                if not rc.bit & off_limits and (answer := self._answer(rc)) is not None and not answer.accept:
                    return _vetoed(rc, answer)
        return None

    def hidden(self) -> int:
        """Bits of the RCs that keep the ARC out as things stand."""
        bits = 0
        for rc, _ in self.firm:
            bits |= rc.bit
        for rc in self._sharables:
            if (answer := self._answer(rc)) is not None and not answer.accept:
                bits |= rc.bit
        return bits

    def decide(self) -> Inadmissible | VotesNeeded | Admissible:
        """Steps 3b and 3c, with the votes that are known. Only for a check without an obstacle."""
        kept = {rc.name: self._firm_holders(rc) for rc in self._sharables}
        verdict = self._ask([(rc, kept[rc.name]) for rc in self._sharables])
        if verdict is not None:
            return verdict
        victims = list(self.blockers.values())
        for candidate in self._candidates():
            shared = [rc for rc in self._sharables if candidate.id in rc.holders]
            beside = [(rc, kept[rc.name] | {candidate.id}) for rc in shared]
            verdict = self._ask(beside)
            match verdict:
                case None:
                    for rc, holders in beside:
                        kept[rc.name] = holders
                case Inadmissible():
                    victims.append(candidate)
                case VotesNeeded():
                    return verdict
        return Admissible(sorted(victims, key=lambda arc: arc.rank))

    def refusal(self) -> Reason | None:
        """The veto that keeps the ARC out beside those who would stay, before the silence of an RC that does
        not answer; None if there is neither."""
        silent = None
        for rc in self._sharables:
            answer = self._answer(rc)
            if answer is not None and not answer.accept:
                return _vetoed(rc, answer).reason
            if answer is None and not silent and self.votes.silent(rc.name):
                silent = of_rcs(ReasonCode.SILENT, [rc.name])
        return silent

    def _answer(self, rc: Rc) -> Answer | None:
        """What `rc` votes on the ARC beside those who would stay."""
        return self.votes.known(rc.name, self._firm_holders(rc))

    def _firm_holders(self, rc: Rc) -> HolderSet:
        """The ARC beside those who would stay."""
        stay = [name for name, holder in rc.holders.items() if not holder.preemptible_by(self.arc, self.now)]
        return frozenset((*stay, self.arc.id))

    def _candidates(self) -> list[Arc]:
        """In rank order, those who may be preempted and hold a sharable RC that it needs."""
        found = {
            holder.id: holder
            for rc in self._sharables
            for holder in rc.holders.values()
            if holder.id not in self.blockers and holder.preemptible_by(self.arc, self.now)
        }
        return sorted(found.values(), key=lambda arc: arc.rank)

    def _ask(self, sets: list[tuple[Rc, HolderSet]]) -> Inadmissible | VotesNeeded | None:
        """None if all RCs accept. A veto settles it whatever else is unknown."""
        unknown: list[tuple[Rc, HolderSet]] = []
        for rc, holders in sets:
            answer = self.votes.known(rc.name, holders)
            if answer is None:
                unknown.append((rc, holders))
            elif not answer.accept:
                return _vetoed(rc, answer)
        return VotesNeeded(unknown) if unknown else None


def _vetoed(rc: Rc, answer: Answer) -> Inadmissible:
    return Inadmissible(rc, Reason(ReasonCode.VETOED, (rc.name,), detail=answer.reason))
