"""Bookings as the core keeps them: a claim with a date, until its owner's request takes it up.

That nobody gets into its way is done by `reservations.py`; when there is time for one is told by `slots.py`."""

from __future__ import annotations

from collections.abc import Callable

from zscout.scheduling.booking import Booking, BookingChanged, BookingState
from zscout.scheduling.model import Arc, ArcRequest, Claim, Effect, Outcome, Rc
from zscout.scheduling.reason import Reason, ReasonCode
from zscout.scheduling.slots import slots
from zscout.scheduling.state import Actions, SchedulerState
from zscout.types import NO_TERM, Place


def request_for(booking: Booking) -> ArcRequest:
    """The request by which its owner takes it up."""
    return ArcRequest(
        booking.id,
        f"{booking.owner}/",
        booking.needs,
        booking.priority,
        booking.runtime,
        label=booking.label,
        booking=booking.id,
        who=booking.who,
    )


class Claims:
    """The rules by which the bookings of a core change."""

    def __init__(self, state: SchedulerState, actions: Actions, emit: Callable[[Effect], None]) -> None:
        self._state, self._actions, self._emit = state, actions, emit

    def stand_in(self, booking: Booking) -> Arc:
        """What stands for a booking before it is taken up."""
        arc = self._state.new_arc(request_for(booking), Place(NO_TERM, 0))
        if arc.patterns:
            self._state.bind(arc, booking.bound)
        return arc

    def book(self, booking: Booking) -> None:
        if booking.id in self._state.claims:
            return
        if booking.lapses <= self._state.now:
            self._emit(BookingChanged(booking.id, BookingState.LAPSED))
        else:
            arc = self.stand_in(booking)
            self._state.claim(Claim(booking, arc, arc.mask))

    def unbook(self, booking: str) -> None:
        if (claim := self._state.claims.get(booking)) is not None:
            self._end(claim, BookingState.UNBOOKED)

    def take_up(self, booking: str, arc: Arc) -> None:
        """An ARC, which waits or runs, stands for its booking from now on, if that is open. It waits for the date."""
        claim = self._state.claims.get(booking)
        if claim is None or claim.is_taken:
            return
        for rc in self._state.possible_sharables(claim.arc):
            self._state.votes.rename_arc(rc.name, claim.arc.id, arc.id)
        claim.arc, arc.claim = arc, claim
        self._state.claims_changed()
        self._emit(BookingChanged(claim.booking.id, BookingState.TAKEN, arc.id))
        if claim.booking.start > self._state.now and arc.id in self._state.queued:
            self._state.hold_back(arc, claim.booking.start, ())
            self._actions.wait(arc, Reason(ReasonCode.NOT_YET))

    def give_up(self, arc: Arc, outcome: Outcome, *, had_it: bool) -> None:
        """An ARC is over. What it had taken up is open again if its program is gone, or gave up before it had it."""
        claim = arc.claim
        if claim is None:
            return
        again = (outcome is Outcome.CLIENT_LOST or not had_it) and self._state.now < claim.booking.lapses
        if not again:
            self._end(claim, BookingState.USED)
            return
        arc.claim = None
        claim.arc = self.stand_in(claim.booking)
        self._state.claims_changed()
        self._emit(BookingChanged(claim.booking.id, BookingState.OPEN, arc.id))

    def _end(self, claim: Claim, state: BookingState) -> None:
        arc = claim.arc if claim.is_taken else None
        for rc in [] if arc is not None else list(self._state.possible_sharables(claim.arc)):
            self._state.votes.forget_arc(rc.name, claim.arc.id)
        self._state.unclaim(claim)
        self._emit(BookingChanged(claim.booking.id, state, None if arc is None else arc.id))
        if arc is not None and arc.held_back is not None and not arc.held_back[1]:
            self._state.consider_again(arc)

    def expire(self) -> None:
        """Ends the bookings whose time is over, or whose owner's to take them up."""
        for claim in self._state.claims_over():
            if claim.booking.end <= self._state.now:
                self._end(claim, BookingState.USED if claim.is_taken else BookingState.LAPSED)
            elif not claim.is_taken:
                self._end(claim, BookingState.LAPSED)

    def keep_others(self, lost: Rc) -> None:
        """Bookings that any RC of a pattern would do for are kept another one, where there is one that is free then."""
        for claim in self._state.claims.values():
            if not claim.kept & lost.bit & ~claim.arc.named_mask or claim.arc.hold is not None:
                continue
            arc, start = self.stand_in(claim.booking), claim.booking.start
            if found := slots(self._state, claim.booking, arc, start, 1).found:
                claim.kept = arc.named_mask | self._state.mask(found[0].bound.values())
                self._state.claims_changed()
