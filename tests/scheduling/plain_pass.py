"""Strategy `priority` as one plain loop over the whole queue: what the indexed pass has to come out as."""

from __future__ import annotations

import heapq
from collections.abc import Mapping

from zscout.scheduling.admission import MAX_BINDINGS, Admissible, AdmissionCheck, Verdict, VotesNeeded, _blamed, judge
from zscout.scheduling.model import Arc
from zscout.scheduling.patterns import Choices, alternatives, no_match
from zscout.scheduling.plan import BindingPlan, dry_run
from zscout.scheduling.priority import VOTING, Priority, _pattern_of
from zscout.scheduling.reason import ReasonCode, of_rcs
from zscout.scheduling.reservations import Inadmissible
from zscout.scheduling.state import Actions, SchedulerState


class PlainPriority(Priority):
    """Checks everyone who waits, in rank order, and keeps nothing for the next pass."""

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        votes = state.votes
        order = [(arc.rank, arc) for arc in state.queued.values()]
        heapq.heapify(order)
        plan = dry_run(state, None)
        off_limits = 0
        for rc, holders in plan.unknown:
            actions.propose(rc, holders)
        while order:
            _, arc = heapq.heappop(order)
            if plan.since is not None and arc.rank >= plan.since:
                off_limits |= plan.off_limits
            check, verdict = judged(state, arc, off_limits, plan)
            match verdict:
                case None:
                    actions.wait(arc, no_match(state, arc))
                case "off limits":
                    off_limits |= check.footprint() | (alternatives(state, arc) if arc.patterns else 0)
                    actions.wait(arc, VOTING, settled=False)
                case Inadmissible(rc, reason):
                    pattern = _pattern_of(arc, rc)
                    if pattern is not None and reason.code is ReasonCode.VETOED:
                        reason = reason._replace(rcs=check.refusing(pattern))
                    actions.wait(arc, reason._replace(pattern=pattern))
                case VotesNeeded(questions) if silent := [
                    one for one in questions if one[0].name in votes.unresponsive
                ]:
                    actions.wait(arc, of_rcs(ReasonCode.SILENT, [rc.name for rc, _ in silent]))
                    for rc, holders in silent:
                        actions.propose(rc, holders)
                case VotesNeeded(questions):
                    off_limits |= check.footprint() | (alternatives(state, arc) if arc.patterns else 0)
                    actions.wait(arc, VOTING, settled=False)
                    for rc, holders in questions:
                        actions.propose(rc, holders)
                case Admissible(victims):
                    for victim in victims:
                        if actions.preempt(victim, by=arc):
                            heapq.heappush(order, (victim.rank, victim))
                    actions.start(arc)


def judged(
    state: SchedulerState, arc: Arc, off_limits: int, plan: BindingPlan
) -> tuple[AdmissionCheck, Verdict | None]:
    """Of its bindings, the planned and then one after the other, the first that nothing but a vote keeps out, else the
    best."""
    check = AdmissionCheck(state, arc)
    if not arc.patterns:
        return check, judge(check, None, off_limits)
    best: Verdict | None = None
    bound: Mapping[str, str] = {}
    without, choices, planned = 0, Choices(state, arc, 0), plan.bound.get(arc.id)
    for _ in range(MAX_BINDINGS):
        if (found := planned or choices.best(without=without)) is None:
            break
        planned = None
        state.bind(arc, found)
        verdict = judge(AdmissionCheck(state, arc), None, off_limits)
        blamed = _blamed(state, arc, verdict, off_limits)
        if best is None or not blamed:
            best, bound = verdict, found
        if not blamed or (found == plan.bound.get(arc.id) and verdict == "off limits"):
            break
        without |= blamed
    state.bind(arc, bound)
    return AdmissionCheck(state, arc), best
