"""Strategy `priority` as one plain loop over the whole queue: what the indexed pass has to come out as."""

from __future__ import annotations

import heapq
from collections.abc import Mapping

from zscout.scheduling.model import Arc
from zscout.scheduling.patterns import Choices, no_match
from zscout.scheduling.priority import (
    MAX_BINDINGS,
    VOTING,
    Admissible,
    AdmissionCheck,
    Pass,
    Priority,
    VotesNeeded,
    _pattern_of,
    _Verdict,
)
from zscout.scheduling.reason import ReasonCode, of_rcs
from zscout.scheduling.reservations import Inadmissible
from zscout.scheduling.state import Actions, SchedulerState


class PlainPriority(Priority):
    """Checks everyone who waits, in rank order, and keeps nothing for the next pass."""

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        votes = state.votes
        order = [(arc.rank, arc) for arc in state.queued.values()]
        heapq.heapify(order)
        one_pass = Pass(state, actions)
        while order:
            _, arc = heapq.heappop(order)
            check, verdict = judged(one_pass, arc)
            match verdict:
                case None:
                    actions.wait(arc, no_match(state, arc))
                case "off limits":
                    one_pass.off_limits |= check.footprint()
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
                    one_pass.off_limits |= check.footprint()
                    actions.wait(arc, VOTING, settled=False)
                    for rc, holders in questions:
                        actions.propose(rc, holders)
                case Admissible(victims):
                    for victim in victims:
                        if actions.preempt(victim, by=arc):
                            heapq.heappush(order, (victim.rank, victim))
                    actions.start(arc)


def judged(one_pass: Pass, arc: Arc) -> tuple[AdmissionCheck, _Verdict | None]:
    """Of its bindings, one after the other, the first that nothing but a vote keeps out, else the best."""
    state, check = one_pass.state, AdmissionCheck(one_pass.state, arc)
    if not arc.patterns:
        return check, one_pass._verdict(arc, check)
    best: _Verdict | None = None
    bound: Mapping[str, str] = {}
    without, choices = 0, Choices(state, arc, 0)
    for _ in range(MAX_BINDINGS):
        if (found := choices.best(without=without)) is None:
            break
        state.bind(arc, found)
        verdict = one_pass._verdict(arc, AdmissionCheck(state, arc))
        blamed = one_pass._blamed(arc, verdict)
        if best is None or not blamed:
            best, bound = verdict, found
        if not blamed:
            break
        without |= blamed
    state.bind(arc, bound)
    return AdmissionCheck(state, arc), best
