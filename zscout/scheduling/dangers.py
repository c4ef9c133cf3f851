"""Threats to a booking's start at its date, found early enough to act on.

The RCs kept for it are checked for presence, for holders that neither end nor yield by the date, for earlier promises,
and for votes. An unknown vote neither causes nor ends a danger; a queued ARC without a promise causes none. After the
date, the danger is the reason why its ARC waits."""

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
"""Reasons of an ARC that is about to start."""


class Undecided(NamedTuple):
    """A vote decides: the vote on `proposal` or, without `rc`, one in progress."""

    rc: Rc | None = None
    proposal: HolderSet = frozenset()


def danger(state: SchedulerState, reserved: Reservations, claim: Claim) -> Reason | Undecided | None:
    """The reason why a booking would miss its date or can't start now; None: there is none."""
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
        before = [
            promise
            for promise in reserved.before(rc, order_of(state, booking), date, booking.end)
            if _overlaps(state, claim, promise, date)
        ]
        for promise in before:
            if promise.excludes or not rc.sharable:
                return kept_for(rc, promise)
        if rc.sharable and (refusal := _refusal(state, rc, arc, before, date)) is not None:
            unknown = unknown or (refusal if isinstance(refusal, Undecided) else None)
            if isinstance(refusal, Reason):
                return refusal
    return _why_it_waits(state, claim) if claim.is_taken and booking.start <= state.now else unknown


def _why_it_waits(state: SchedulerState, claim: Claim) -> Reason | Undecided | None:
    arc, votes = claim.arc, state.votes
    proposed = (rc for rc, holders in votes.proposals.values() if arc.id in holders)
    if arc.state is ArcState.DEFERRED or any(rc not in votes.unresponsive for rc in proposed):
        return Undecided()
    return arc.reason if arc.reason is not None and arc.reason.code not in _PASSING else None


def _overlaps(state: SchedulerState, claim: Claim, promise: Reservation, date: Ns) -> bool:
    """Return True if the promise keeps out a booking that begins at `date`."""
    if promise.start >= claim.booking.end or promise.over() <= date:
        return False
    # Maintenance of lower priority keeps out only bookings that start during it.
    return not promise.excludes or promise.start <= date or state.band(claim.booking.priority) <= -promise.order[1]


def _refusal(state: SchedulerState, rc: Rc, arc: Arc, before: list[Reservation], date: Ns) -> Reason | Undecided | None:
    """The refusal of `arc` by a sharable RC beside the holders expected at any time of the booking."""
    unknown: Undecided | None = None
    for time in sorted({date, *(promise.start for promise in before if promise.start > date)}):
        parties = {holder.id: holder.blocks(arc) for holder in rc.holders.values() if not yields(holder, arc, time)}
        parties |= {promise.arc.id: promise.arc.party for promise in before if promise.start <= time < promise.over()}
        together = frozenset((*parties, arc.id))
        answer = state.votes.known(rc.name, together)
        if answer is None:
            unknown = Undecided(rc, together)
        elif not answer.accept:
            shown = tuple(parties.values())[:SHOWN]
            return Reason(ReasonCode.VETOED, (rc.name,), shown, answer.reason, len(parties))
    return unknown
