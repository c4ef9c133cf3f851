"""Steps 3a to 3c of `priority`: whether a queued ARC may start, on whose votes, and which holds end for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Final, Literal, TypeAlias

from zscout.config.scheduling_policy import RcQuota
from zscout.scheduling.model import Arc, Rc, absences, union
from zscout.scheduling.patterns import choices
from zscout.scheduling.reason import SHOWN, SHOWN_CHOICES, Reason, ReasonCode, base, of_rcs
from zscout.scheduling.reservations import Inadmissible, Reservations
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import Answer, HolderSet
from zscout.types import ArcId, Need, RcName

MAX_BINDINGS: Final = 16


@dataclass(frozen=True, slots=True)
class VotesNeeded:
    proposals: list[tuple[Rc, HolderSet]]


@dataclass(frozen=True, slots=True)
class Admissible:
    victims: list[Arc]
    presumed: list[tuple[Rc, HolderSet]]  # the unknown votes that were counted as yes


Verdict: TypeAlias = Inadmissible | VotesNeeded | Admissible | RcQuota | Literal["off limits", "over quota"]


class AdmissionCheck:
    """The obstacles of a queued ARC, its footprint, and the votes on it."""

    def __init__(self, state: SchedulerState, arc: Arc, *, presume: bool = False) -> None:
        """`presume` counts the unknown votes of RCs that answer as yes."""
        self.state, self.arc, self.presume = state, arc, presume
        self._presumed: list[tuple[Rc, HolderSet]] = []
        self.votes, self.now = state.votes, state.now
        self.non_preemptible: list[tuple[Rc, Arc]] = []
        self.exclusive_victims: dict[ArcId, Arc] = {}  # preemptible holders of its exclusive RCs: they end if it starts
        self._sharables: list[Rc] = []
        for rc in arc.rcs:
            if rc.sharable:
                self._sharables.append(rc)
                continue
            for holder in rc.holders.values():
                if holder.preemptible_by(arc, self.now):
                    self.exclusive_victims[holder.id] = holder
                else:
                    self.non_preemptible.append((rc, holder))

    def footprint(self) -> int:
        return union(arc.mask for arc in (self.arc, *self.exclusive_victims.values(), *self._preemptible_sharers()))

    def obstacle(self, off_limits: int) -> Inadmissible | None:
        """An RC that alone keeps the ARC out; holders and vetoes of RCs `off_limits` don't count. Prefers a hold likely
        to last, to save checks."""
        if closed := self.state.closed_to(self.arc):
            rcs = list(self.state.rcs_in(closed))
            absent = [rc for rc in rcs if not rc.present]
            code = ReasonCode.ABSENT if absent else ReasonCode.UNWELL
            rcs = absent or rcs
            why = rcs[0].absence or rcs[0].unwell if len(rcs) == 1 else absences(rcs)
            return Inadmissible(rcs[0], of_rcs(code, [rc.name for rc in rcs], why))
        lasting: tuple[int, float, int] | None = None
        for number, (rc, holder) in enumerate(self.non_preemptible):
            if not off_limits or not rc.bit & off_limits:
                lasting = max(lasting or (holder.priority, -1.0, 0), (holder.priority, holder.known_end(), number))
        if lasting is not None:
            return Inadmissible(self.non_preemptible[lasting[2]][0], self._held())
        if off_limits:
            for rc in self._sharables:
                if not rc.bit & off_limits and (answer := self._answer(rc)) is not None and not answer.accept:
                    return self._vetoed(rc, answer)
        return None

    def _held(self) -> Reason:
        """The reason with the holders in its way: of named RCs, and of all choices for each unmet pattern."""
        arc, number = self.arc, len(self.non_preemptible)
        if not arc.patterns:
            shown = self.non_preemptible[:SHOWN]
            rcs, parties = tuple(rc.name for rc, _ in shown), tuple(holder.blocks(arc) for _, holder in shown)
            return Reason(ReasonCode.HELD, rcs, parties, self._preferred(), number)
        bound = {rc: need for need, rc in arc.bound.items()}
        held = [(rc, holder, "") for rc, holder in self.non_preemptible if rc.name not in bound]
        known = union(rc.bit for rc, _, _ in held)
        for rc, _ in self.non_preemptible:
            if rc.bit & known:
                continue
            need = bound[rc.name]
            # `fg/*` and `fg/*#2` have the same choices: keep the unmet patterns of such a group.
            unmet = (bound[rc.name] for rc, _ in self.non_preemptible if rc.name in bound)
            needs = [other for other in dict.fromkeys(unmet) if base(other) == base(need)]
            for choice in sorted(self.state.matching(need), key=attrgetter("name")):
                if choice.present and not choice.sharable and not choice.bit & (known | arc.named_mask):
                    known |= choice.bit
                    holders = choice.non_preemptible_holders(arc, self.now)[:1]
                    held += [(choice, holder, needs.pop(0) if len(needs) > 1 else needs[0]) for holder in holders]
        first = held[:SHOWN_CHOICES]
        return Reason(
            ReasonCode.HELD,
            tuple(rc.name for rc, _, _ in first),
            tuple(holder.blocks(arc) for _, holder, _ in first),
            self._preferred(),
            len(held),
            patterns=tuple(need for _, _, need in first),
        )

    def _preferred(self) -> str:
        """The group that fair shares prefer, if a holder of it is in the way for this reason alone."""
        shares = self.state.shares
        return "" if shares is None else shares.preferred(self.arc, (holder for _, holder in self.non_preemptible))

    def masked_obstacles(self) -> int:
        """Bits of the RCs that keep the ARC out now, off limits or not."""
        vetoing = (rc.bit for rc in self._sharables if (answer := self._answer(rc)) is not None and not answer.accept)
        return union(rc.bit for rc, _ in self.non_preemptible) | union(vetoing)

    def decide(self) -> Inadmissible | VotesNeeded | Admissible:
        """Steps 3b and 3c with the known votes, for a check without an obstacle."""
        kept = {rc.name: self._with_non_preemptible(rc) for rc in self._sharables}
        verdict = self._votes_on([(rc, kept[rc.name]) for rc in self._sharables])
        if verdict is not None:
            return verdict
        victims = list(self.exclusive_victims.values())
        for sharer in self._preemptible_sharers():
            shared = [rc for rc in self._sharables if sharer.id in rc.holders]
            beside = [(rc, kept[rc.name] | {sharer.id}) for rc in shared]
            verdict = self._votes_on(beside)
            match verdict:
                case None:
                    for rc, holders in beside:
                        kept[rc.name] = holders
                case Inadmissible():
                    victims.append(sharer)
                case VotesNeeded():
                    return verdict
        return Admissible(sorted(victims, key=lambda arc: arc.rank), self._presumed)

    def refusal(self) -> Reason | None:
        """The reason if an RC vetoes the ARC, else if an RC does not answer; None if neither is so."""
        unresponsive = None
        for rc in self._sharables:
            answer = self._answer(rc)
            if answer is not None and not answer.accept:
                return self._vetoed(rc, answer).reason
            if answer is None and not unresponsive and rc.name in self.votes.unresponsive:
                unresponsive = of_rcs(ReasonCode.SILENT, [rc.name])
        return unresponsive

    def _vetoed(self, rc: Rc, answer: Answer) -> Inadmissible:
        beside = rc.non_preemptible_holders(self.arc, self.now)
        parties = tuple(holder.blocks(self.arc) for holder in beside[:SHOWN])
        return Inadmissible(rc, Reason(ReasonCode.VETOED, (rc.name,), parties, answer.reason, len(beside)))

    def refusing(self, pattern: Need) -> tuple[RcName, ...]:
        """The choices for a pattern that are known to refuse the ARC, the bound RC first."""
        bound = self.arc.bound[pattern]
        found = [bound]
        for rc in self.state.matching(pattern):
            if rc.present and rc.sharable and rc.name != bound and not rc.bit & self.arc.named_mask:
                answer = self._answer(rc)
                found += [rc.name] if answer is not None and not answer.accept else []
        return tuple(found[:SHOWN_CHOICES])

    def _answer(self, rc: Rc) -> Answer | None:
        return self.votes.known(rc.name, self._with_non_preemptible(rc))

    def _with_non_preemptible(self, rc: Rc) -> HolderSet:
        return frozenset((*(holder.id for holder in rc.non_preemptible_holders(self.arc, self.now)), self.arc.id))

    def _preemptible_sharers(self) -> list[Arc]:
        found = {
            holder.id: holder
            for rc in self._sharables
            for holder in rc.holders.values()
            if holder.id not in self.exclusive_victims and holder.preemptible_by(self.arc, self.now)
        }
        return sorted(found.values(), key=lambda arc: arc.rank)

    def _votes_on(self, sets: list[tuple[Rc, HolderSet]]) -> Inadmissible | VotesNeeded | None:
        """None if all RCs accept these sets. One veto decides, whatever else is unknown."""
        unknown: list[tuple[Rc, HolderSet]] = []
        for rc, holders in sets:
            answer = self.votes.known(rc.name, holders)
            if answer is None:
                presume = self.presume and rc.name not in self.votes.unresponsive
                (self._presumed if presume else unknown).append((rc, holders))
            elif not answer.accept:
                return self._vetoed(rc, answer)
        return VotesNeeded(unknown) if unknown else None


def judge(check: AdmissionCheck, reserved: Reservations | None, off_limits: int = 0) -> Verdict:
    """The verdict of the first step that keeps the ARC out, or the victims that end when it starts."""
    state, arc = check.state, check.arc
    obstacle = check.obstacle(off_limits)
    if obstacle is not None:
        return obstacle
    if state.quota_left(arc) == 0:
        return "over quota"
    if (quota := state.rc_quota(arc)) is not None:
        return quota
    conflict = reserved.conflict(arc) if reserved is not None else None
    if conflict is not None:
        return conflict
    if off_limits and check.footprint() & off_limits:
        return "off limits"
    return check.decide()


def judge_bindings(
    state: SchedulerState,
    arc: Arc,
    reserved: Reservations | None,
    off_limits: int = 0,
    planned: Mapping[Need, RcName] | None = None,
    *,
    presume: bool = False,
) -> Verdict | None:
    """Bind an ARC with patterns, `planned` first, then the best bindings, until it may start or only votes keep it out;
    else by the first. Return the verdict on this binding; None: there is no binding."""
    without, found = 0, choices(state, arc, reserved)
    best: tuple[Mapping[Need, RcName], Verdict] | None = None
    for _ in range(MAX_BINDINGS):
        is_planned = planned is not None
        bound = planned or found.best(without=without)
        if bound is None:
            break
        planned = None
        state.bind(arc, bound)
        verdict = judge(AdmissionCheck(state, arc, presume=presume), reserved, off_limits)
        blamed = _blamed(state, arc, verdict, off_limits)
        if best is None or not blamed:
            best = arc.bound, verdict
        # A planned binding waits for the votes of others: a different binding might be in the way of a lower rank.
        if not blamed or (is_planned and verdict == "off limits"):
            break
        without |= blamed
    state.bind(arc, best[0] if best else {})
    return best[1] if best else None


def _blamed(state: SchedulerState, arc: Arc, verdict: Verdict, off_limits: int) -> int:
    """Bits of the RCs bound to its patterns that keep the ARC out, where other choices might not."""
    unresponsive = state.votes.unresponsive
    match verdict:
        case Inadmissible(rc, _, proposal) if proposal is None or rc.name in unresponsive:
            bits = rc.bit
        case "off limits":
            bits = off_limits
            bits |= union(rc.bit for rc in arc.rcs if any(holder.mask & bits for holder in rc.holders.values()))
        case VotesNeeded(proposals):
            bits = sum(rc.bit for rc, _ in proposals if rc.name in unresponsive)
        case _:
            bits = 0
    return bits & arc.mask & ~arc.named_mask
