"""One look at one queued ARC: steps 1 to 3 of the strategy `priority`, for whoever else needs them too."""

from __future__ import annotations

import math
from dataclasses import dataclass

from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, ArcId, Ns, Rc
from zscout.scheduling.policy import owner_of
from zscout.scheduling.votes import HolderSet, Votes

SHOWN = 3
"""How many RCs a reason names; it counts the rest."""


@dataclass(frozen=True, slots=True)
class Refused:
    """The visit is over: `rc` keeps the ARC out as long as its situation is this; `reason` says so."""

    rc: Rc
    reason: str


@dataclass(frozen=True, slots=True)
class Open:
    """The visit can't be decided before these are answered."""

    questions: list[tuple[Rc, HolderSet]]


@dataclass(frozen=True, slots=True)
class Admitted:
    """The ARC may start once these are displaced."""

    victims: list[Arc]


class Visit:
    """Who is in the way of a queued ARC, what it would take and free, what the RCs say."""

    def __init__(self, floor: Floor, votes: Votes, now: Ns, arc: Arc) -> None:
        self.floor, self.votes, self.now, self.arc = floor, votes, now, arc
        self.firm: list[tuple[Rc, Arc]] = []
        """Exclusive RCs it needs, with holders that do not yield to it."""
        self.blockers: dict[ArcId, Arc] = {}
        self._sharables: list[Rc] = []
        for rc in arc.rcs:
            if rc.sharable:
                self._sharables.append(rc)
                continue
            for holder in rc.holders.values():
                if holder.yields_to(arc, now):
                    self.blockers[holder.id] = holder
                else:
                    self.firm.append((rc, holder))

    def footprint(self) -> int:
        """All that the visit would take or free, as bits."""
        bits = self.arc.mask
        for holder in (*self.blockers.values(), *self._candidates()):
            bits |= holder.mask
        return bits

    def obstacle(self, off_limits: int) -> str:
        """Why the ARC can't start whatever becomes of the visits that are open; empty if it may."""
        refused = self.obstacle_outside(off_limits)
        return refused.reason if refused is not None else ""

    def obstacle_outside(self, off_limits: int) -> Refused | None:
        """The same with an RC that keeps the ARC out by itself: of several, one that will do so for long, so
        that the ARC is not looked at in vain."""
        for rc in self.arc.rcs:
            if not rc.present:
                return Refused(rc, absence(self.floor, self.arc))
        lasting: tuple[int, float, int] | None = None
        for number, (rc, holder) in enumerate(self.firm):
            if not off_limits or not rc.bit & off_limits:
                end = math.inf if holder.request.keep or holder.hold is None else holder.hold.end
                lasting = max(lasting or (holder.priority, -1.0, 0), (holder.priority, end, number))
        if lasting is not None:
            held = [f"{rc.name} (held by {_who(holder)})" for rc, holder in self.firm[:SHOWN]]
            return Refused(self.firm[lasting[2]][0], "needs " + _counted(held, len(self.firm)))
        if off_limits:
            for rc in self._sharables:
                if not rc.bit & off_limits and (veto := self._veto(rc)) is not None:
                    return veto
        return None

    def hidden(self) -> int:
        """Bits of the RCs that keep the ARC out as things stand."""
        bits = 0
        for rc, _ in self.firm:
            bits |= rc.bit
        for rc in self._sharables:
            if self._veto(rc) is not None:
                bits |= rc.bit
        return bits

    def decide(self) -> Refused | Open | Admitted:
        """Steps 2 and 3, with the votes that are known. Only for a visit without an obstacle."""
        verdict = self._ask([(rc, self._firm_holders(rc)) for rc in self._sharables])
        if verdict is not None:
            return verdict
        kept = {rc.name: self._firm_holders(rc) for rc in self._sharables}
        victims = list(self.blockers.values())
        for candidate in self._candidates():
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
        """The veto that keeps the ARC out beside those who would stay, before the silence of an RC that does
        not answer; empty if there is neither."""
        silent = ""
        for rc in self._sharables:
            answer = self.votes.known(rc.name, self._firm_holders(rc))
            if answer is None and self.votes.silent(rc.name):
                silent = silent or f"{rc.name} does not answer"
            if answer is not None and not answer.accept:
                return _veto(rc, answer.reason)
        return silent

    def _veto(self, rc: Rc) -> Refused | None:
        """The veto of `rc` against the ARC beside those who would stay."""
        answer = self.votes.known(rc.name, self._firm_holders(rc))
        return None if answer is None or answer.accept else Refused(rc, _veto(rc, answer.reason))

    def _firm_holders(self, rc: Rc) -> HolderSet:
        stay = [name for name, holder in rc.holders.items() if not holder.yields_to(self.arc, self.now)]
        return frozenset((*stay, self.arc.id))

    def _candidates(self) -> list[Arc]:
        """In rank order, those who yield and hold a sharable RC that it needs."""
        found = {
            holder.id: holder
            for rc in self._sharables
            for holder in rc.holders.values()
            if holder.id not in self.blockers and holder.yields_to(self.arc, self.now)
        }
        return sorted(found.values(), key=lambda arc: arc.rank)

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
                return Refused(rc, _veto(rc, answer.reason))
        return Open(unknown) if unknown else None


def absence(floor: Floor, arc: Arc) -> str:
    """Which RCs of `arc` are not there, in words; empty if all are."""
    absent = [rc.name for rc in arc.rcs if not rc.present]
    return f"{listed(absent)} not on the mesh" if absent else ""


def over_quota(floor: Floor, arc: Arc) -> str:
    """That its owner has no room for `arc`, in words."""
    owner, quota = owner_of(arc.request.client), floor.policy.max_running_per_host
    return f"host {owner} has {quota} ARCs running, its quota"


def listed(names: list[str]) -> str:
    """The first names, and how many more there are."""
    return _counted(names[:SHOWN], len(names))


def _who(holder: Arc) -> str:
    return f"{holder.name}, priority {holder.priority}"


def _veto(rc: Rc, reason: str) -> str:
    return f"{rc.name} refuses: {reason}" if reason else f"{rc.name} refuses"


def _counted(shown: list[str], count: int) -> str:
    return ", ".join(shown) + (f" and {count - SHOWN} more" if count > SHOWN else "")
