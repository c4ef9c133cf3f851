"""Strategy `priority` as one plain loop over the whole queue: what the indexed pass has to come out as."""

from __future__ import annotations

import heapq

from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Ns
from zscout.scheduling.priority import UNSETTLED, Actions
from zscout.scheduling.visit import Admitted, Open, Refused, Visit, listed
from zscout.scheduling.votes import Votes


def run_plain_pass(floor: Floor, votes: Votes, now: Ns, actions: Actions) -> None:
    """Visits everyone who waits, in rank order, and keeps nothing for the next pass."""
    order = [(arc.rank, arc) for arc in floor.queued.values()]
    heapq.heapify(order)
    off_limits = 0
    while order:
        _, arc = heapq.heappop(order)
        visit = Visit(floor, votes, now, arc)
        if obstacle := visit.obstacle(off_limits):
            actions.wait(arc, obstacle)
            continue
        if visit.footprint() & off_limits:
            off_limits |= visit.footprint()
            actions.wait(arc, UNSETTLED, settled=False)
            continue
        match visit.decide():
            case Refused(_, reason):
                actions.wait(arc, reason)
            case Open(questions) if silent := [ask for ask in questions if votes.silent(ask[0].name)]:
                actions.wait(arc, f"{listed([rc.name for rc, _ in silent])} does not answer")
                for rc, holders in silent:
                    actions.propose(rc, holders)
            case Open(questions):
                off_limits |= visit.footprint()
                actions.wait(arc, UNSETTLED, settled=False)
                for rc, holders in questions:
                    actions.propose(rc, holders)
            case Admitted(victims):
                for victim in victims:
                    if actions.displace(victim, by=arc):
                        heapq.heappush(order, (victim.rank, victim))
                actions.start(arc)
