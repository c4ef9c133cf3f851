"""What would keep a booking from its start at its date, by what is known now: told before it is too late to do
something about it.

Looked at are the RCs that are kept for it: whether they are there, who holds them and neither ends nor yields by then,
what is promised before it, and how sharable ones have voted. A vote that is not known is no danger, but does not end
one either; and who is queued is none before it is promised something. From the date on it is told why its ARC waits."""

from __future__ import annotations

from typing import Final, NamedTuple

from zscout.scheduling.model import Arc, ArcState, Claim, Rc, absences
from zscout.scheduling.patterns import no_match
from zscout.scheduling.reason import SHOWN, Reason, ReasonCode, of_rcs
from zscout.scheduling.reservations import Reservation, Reservations, kept_for, order_of, yields
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import HolderSet
from zscout.types import Ns

_PASSING: Final = (ReasonCode.VOTING, ReasonCode.SEARCHING, ReasonCode.NOT_YET)
"""What an ARC waits for that is about to start."""


class Undecided(NamedTuple):
    """That a vote will tell: the one on `proposal`, or one that is out."""

    rc: Rc | None = None
    proposal: HolderSet = frozenset()


def danger(state: SchedulerState, reserved: Reservations, claim: Claim) -> Reason | Undecided | None:
    """Why a booking would not start at its date, or now if that has come; None: nothing is in its way."""
    booking, arc = claim.booking, claim.arc
    if booking.maintenance or arc.hold is not None:
        return None
    date, rcs = max(booking.start, state.now), list(state.rcs_in(claim.kept))
    if len(rcs) < len(booking.needs):
        return no_match(state, arc)
    if absent := [rc for rc in rcs if not rc.present]:
        return of_rcs(ReasonCode.ABSENT, [rc.name for rc in absent], absences(absent))
    held = [
        (rc.name, holder.blocks(arc))
        for rc in rcs
        if not rc.sharable
        for holder in rc.holders.values()
        if not yields(holder, arc, date)
    ]
    if held:
        shown = held[:SHOWN]
        return Reason(ReasonCode.HELD, tuple(rc for rc, _ in shown), tuple(by for _, by in shown), number=len(held))
    unknown: Undecided | None = None
    for rc in rcs:
        before = [one for one in reserved.before(rc, order_of(state, booking)) if _overlaps(state, claim, one, date)]
        for one in before:
            if one.excludes or not rc.sharable:
                return kept_for(rc, one)
        if rc.sharable and (refusal := _refusal(state, rc, arc, before, date)) is not None:
            unknown = unknown or (refusal if isinstance(refusal, Undecided) else None)
            if isinstance(refusal, Reason):
                return refusal
    return _why_it_waits(state, claim) if claim.is_taken and booking.start <= state.now else unknown


def _why_it_waits(state: SchedulerState, claim: Claim) -> Reason | Undecided | None:
    arc, votes = claim.arc, state.votes
    asked = (rc for rc, holders in votes.proposals.values() if arc.id in holders)
    if arc.state is ArcState.DEFERRED or any(rc not in votes.unresponsive for rc in asked):
        return Undecided()
    return arc.reason if arc.reason is not None and arc.reason.code not in _PASSING else None


def _overlaps(state: SchedulerState, claim: Claim, one: Reservation, date: Ns) -> bool:
    """Whether what is reserved keeps out a booking that would begin then."""
    if one.start >= claim.booking.end or one.over() <= date:
        return False
    # Maintenance of lower priority keeps out only who would start in it.
    return not one.excludes or one.start <= date or state.band(claim.booking.priority) <= -one.order[1]


def _refusal(state: SchedulerState, rc: Rc, arc: Arc, before: list[Reservation], date: Ns) -> Reason | Undecided | None:
    """How a sharable RC refuses the booking of `arc` beside those who would be there at some time of it."""
    unknown: Undecided | None = None
    for time in sorted({date, *(one.start for one in before if one.start > date)}):
        parties = {holder.id: holder.blocks(arc) for holder in rc.holders.values() if not yields(holder, arc, time)}
        parties |= {one.arc.id: one.arc.party for one in before if one.start <= time < one.over()}
        together = frozenset((*parties, arc.id))
        answer = state.votes.known(rc.name, together)
        if answer is None:
            unknown = Undecided(rc, together)
        elif not answer.accept:
            shown = tuple(parties.values())[:SHOWN]
            return Reason(ReasonCode.VETOED, (rc.name,), shown, answer.reason, len(parties))
    return unknown
