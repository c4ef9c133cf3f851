"""Strategy `priority` as one plain loop over the whole queue: what the indexed pass has to come out as."""

from __future__ import annotations

import heapq

from zscout.scheduling.priority import VOTING, Admissible, AdmissionCheck, Priority, VotesNeeded
from zscout.scheduling.reason import ReasonCode, of_rcs
from zscout.scheduling.reservations import Inadmissible
from zscout.scheduling.state import Actions, SchedulerState


class PlainPriority(Priority):
    """Checks everyone who waits, in rank order, and keeps nothing for the next pass."""

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        votes = state.votes
        order = [(arc.rank, arc) for arc in state.queued.values()]
        heapq.heapify(order)
        off_limits = 0
        while order:
            _, arc = heapq.heappop(order)
            check = AdmissionCheck(state, arc)
            if (obstacle := check.obstacle(off_limits)) is not None:
                actions.wait(arc, obstacle.reason)
                continue
            if check.footprint() & off_limits:
                off_limits |= check.footprint()
                actions.wait(arc, VOTING, settled=False)
                continue
            match check.decide():
                case Inadmissible(_, reason):
                    actions.wait(arc, reason)
                case VotesNeeded(questions) if silent := [
                    one for one in questions if one[0].name in votes.unresponsive
                ]:
                    actions.wait(arc, of_rcs(ReasonCode.SILENT, [rc.name for rc, _ in silent]))
                    for rc, holders in silent:
                        actions.propose(rc, holders)
                case VotesNeeded(questions):
                    off_limits |= check.footprint()
                    actions.wait(arc, VOTING, settled=False)
                    for rc, holders in questions:
                        actions.propose(rc, holders)
                case Admissible(victims):
                    for victim in victims:
                        if actions.preempt(victim, by=arc):
                            heapq.heappush(order, (victim.rank, victim))
                    actions.start(arc)
