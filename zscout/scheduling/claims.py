"""Bookings in the core: a claim with a date, until its owner's request takes it up.

`reservations.py` keeps their RCs free, `slots.py` finds times, `dangers.py` finds threats. Maintenance is a claim
that is never taken up."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from msgspec.structs import replace

from zscout.scheduling.booking import Booking, BookingChanged, BookingState, BookingThreatened
from zscout.scheduling.dangers import Undecided, danger
from zscout.scheduling.model import Arc, ArcRequest, ArcState, Claim, Effect, Outcome, PatternClass, Rc, union
from zscout.scheduling.reason import Reason, ReasonCode
from zscout.scheduling.reservations import Reservations, reservations
from zscout.scheduling.slots import slots
from zscout.scheduling.state import Actions, SchedulerState
from zscout.types import NO_TERM, Ns, Place


def request_for(booking: Booking) -> ArcRequest:
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
    def __init__(self, state: SchedulerState, actions: Actions, emit: Callable[[Effect], None]) -> None:
        self._state, self._actions, self._emit = state, actions, emit
        self._reserved: Reservations | None = None  # the reservations at the last search for dangers
        self._endangered: dict[Claim, None] = {}  # bookings last reported as endangered
        self._wanting: dict[str, list[Arc]] = {}  # by booking: ARCs that want it while it is absent or taken
        self.certain_from: Ns = 0  # dates before this are uncertain: no booking begins or expires for good

    def stand_in(self, booking: Booking) -> Arc:
        """An ARC that represents a booking until it is taken up."""
        arc = self._state.new_arc(request_for(booking), Place(NO_TERM, 0))
        if arc.patterns:
            self._state.bind(arc, booking.bound)
        return arc

    def book(self, booking: Booking, *, tentative: bool = False) -> None:
        if (known := self._state.claims.get(booking.id)) is not None:
            known.tentative = tentative
            self._offer(known)
            return
        if booking.lapses <= self._state.now:
            state = BookingState.USED if booking.maintenance else BookingState.LAPSED
            self._emit(BookingChanged(booking.id, state))
            return
        arc = self.stand_in(booking)
        claim = Claim(booking, arc, arc.mask, tentative)
        self._state.claim(claim)
        if booking.maintenance:
            self._keep_others(arc.mask)
        self._offer(claim)

    def unbook(self, booking: str, *, at_present: bool) -> None:
        if (claim := self._state.claims.get(booking)) is not None:
            self._end(claim, BookingState.UNBOOKED, at_present=at_present)

    def redate(self, booking: str, start: Ns) -> None:
        claim = self._state.claims.get(booking)
        if claim is None or claim.arc.hold is not None:
            return
        claim.booking = replace(claim.booking, start=start)
        self._state.redated(claim)
        if claim.arc.held_back is not None:
            self._wait_again(claim.arc, start)
        self.expire()

    def take_up(self, booking: str, arc: Arc) -> None:
        """Let a waiting or running ARC take its booking up, now or once that is there and open. The ARC waits for
        the date."""
        claim = self._state.claims.get(booking)
        if not booking or (claim is not None and (claim.booking.maintenance or claim is arc.claim)):
            return
        if claim is None or claim.is_taken or claim.tentative:
            wanting = self._wanting.setdefault(booking, [])
            wanting += [arc] if arc not in wanting else []
            self._wait_until(arc, arc.request.not_before)
            return
        for rc in self._state.possible_sharables(claim.arc):
            self._state.votes.rename_arc(rc.name, claim.arc.id, arc.id)
        claim.arc, arc.claim = arc, claim
        if isinstance(arc.watched, PatternClass):
            self._state.index.put(arc, ArcState.READY)
        self._state.claims_changed()
        self._emit(BookingChanged(claim.booking.id, BookingState.TAKEN, arc.id))
        self._wait_again(arc, claim.booking.start)

    def is_wanted(self, booking: str) -> bool:
        return booking in self._wanting

    def _offer(self, claim: Claim) -> None:
        """Offer an open booking to the ARCs that want it, if they are its owner's: not checked before."""
        booking = claim.booking
        for arc in [] if claim.tentative else self._wanting.pop(booking.id, ()):
            asked = arc.request
            same = asked.needs == booking.needs and asked.priority == booking.priority
            if same and asked.client.partition("/")[0] == booking.owner:
                self.take_up(booking.id, arc)

    def _wait_until(self, arc: Arc, date: Ns) -> None:
        date = max(date, self.certain_from)
        if date > self._state.now and arc.id in self._state.queued:
            self._state.hold_back(arc, date, ())
            self._actions.wait(arc, Reason(ReasonCode.NOT_YET))

    def _wait_again(self, arc: Arc, date: Ns) -> None:
        self._stop_waiting(arc)
        self._wait_until(arc, date)

    def _stop_waiting(self, arc: Arc) -> None:
        if arc.held_back is not None and not arc.held_back[1]:
            self._state.consider_again(arc)

    def give_up(self, arc: Arc, outcome: Outcome, *, had_it: bool) -> None:
        """End the booking of an ended ARC; reopen it if the program is gone or gave up before it held."""
        claim = arc.claim
        again = outcome is Outcome.CLIENT_LOST or not had_it
        if claim is not None and not (again and self._state.now < claim.booking.lapses):
            self._end(claim, BookingState.USED)
        else:
            self.leave(arc)

    def leave(self, arc: Arc) -> None:
        """Reopen the booking of an ARC that has ended or is replaced."""
        name, claim = arc.request.booking, arc.claim
        if wanting := [waiting for waiting in self._wanting.pop(name, ()) if waiting is not arc]:
            self._wanting[name] = wanting
        if claim is not None:
            arc.claim = None
            claim.arc = self.stand_in(claim.booking)
            self._state.claims_changed()
            self._emit(BookingChanged(claim.booking.id, BookingState.OPEN, arc.id))
            self._offer(claim)

    def _end(self, claim: Claim, state: BookingState, *, at_present: bool = False) -> None:
        arc = claim.arc if claim.is_taken else None
        for rc in [] if arc is not None else list(self._state.possible_sharables(claim.arc)):
            self._state.votes.forget_arc(rc.name, claim.arc.id)
        self._state.unclaim(claim)
        self._endangered.pop(claim, None)
        self._emit(BookingChanged(claim.booking.id, state, None if arc is None else arc.id))
        if arc is not None and (at_present or self._state.now < self.certain_from):
            self._wanting[claim.booking.id] = [*self._wanting.get(claim.booking.id, ()), arc]
        if arc is not None and not at_present:
            self._stop_waiting(arc)
            self._wait_until(arc, self.certain_from)

    def expire(self) -> None:
        """End the bookings whose time or patience is over."""
        for claim in self._state.claims_over():
            if claim.booking.end <= self._state.now:
                used = claim.is_taken or claim.booking.maintenance
                self._end(claim, BookingState.USED if used else BookingState.LAPSED)
            elif not claim.is_taken:
                self._end(claim, BookingState.LAPSED)

    def in_maintenance(self) -> Iterator[tuple[Claim, Rc, Arc]]:
        """Holders that maintenance ends: of equal or lower priority, past their minimum runtimes. The caller may end
        them meanwhile."""
        now = self._state.now
        for claim in self._state.maintenance.values() if self._state.maintenance else ():
            for rc in self._state.rcs_in(claim.kept) if claim.booking.start <= now else ():
                for holder in list(rc.holders.values()):
                    if holder.priority <= claim.booking.priority and holder.past_min_runtime(now):
                        yield claim, rc, holder

    def rc_lost(self, rc: Rc) -> None:
        self._keep_others(rc.bit)

    def _keep_others(self, bits: int) -> None:
        """Rebind the patterns of bookings that have some of these RCs, where other RCs are free then."""
        for claim in [claim for claim in self._state.claims.values() if claim.kept & bits & ~claim.arc.named_mask]:
            self._keep_another(claim)

    def _keep_another(self, claim: Claim) -> bool:
        arc, booking, now = claim.arc, claim.booking, self._state.now
        if not arc.patterns or arc.hold is not None:
            return False
        date = max(booking.start, now)
        found = slots(self._state, replace(booking, start=date), arc, date, 1, presume=True).found
        kept = arc.named_mask | self._state.mask(found[0].bound.values()) if found else claim.kept
        if kept == claim.kept or kept & ~self._state.present & ~arc.named_mask:
            return False
        claim.booking = replace(booking, bound=found[0].bound)
        claim.kept = kept
        if not claim.is_taken:
            self._state.bind(arc, found[0].bound)
        self._state.claims_changed()
        return True

    def report_dangers(self) -> None:
        """Report bookings newly in danger, or no longer. Checks the bookings that changes may affect, those in
        danger and overdue ones."""
        state = self._state
        if not state.claims:
            self._reserved = None
            self._endangered.clear()
            return
        before = self._reserved
        self._reserved = reserved = reservations(state, state.policy.patience, before)
        changed, state.changed = state.changed, 0
        voted = state.mask(state.votes.changed)
        state.votes.changed.clear()
        if before is not None and before is not reserved:
            changed |= reserved.changed(before)
            voted |= reserved.booked_changed(before)
        concerned = dict.fromkeys(state.claims_before(math.inf if before is None else state.now))
        for rc in state.rcs_in((changed | voted) & state.claimed):
            until = math.inf if rc.bit & voted else reserved.horizon(rc)
            concerned |= dict.fromkeys(state.claims_before(until, rc))
        concerned |= {claim: None for claim in self._endangered if self._relieving(claim) & (changed | voted)}
        for claim in concerned:
            if state.claims.get(claim.booking.id) is claim:
                self._report_danger(claim)

    @property
    def next_start(self) -> Ns | None:
        starts = self._reserved.starts if self._reserved is not None else ()
        return min((start for start in starts if start > self._state.now), default=None)

    def _relieving(self, claim: Claim) -> int:
        patterns = claim.arc.patterns
        return claim.kept | union(rc.bit for need in patterns for rc in self._state.matching(need))

    def _report_danger(self, claim: Claim) -> None:
        state, reserved = self._state, reservations(self._state, self._state.policy.patience, self._reserved)
        found = danger(state, reserved, claim)
        if isinstance(found, Reason) and self._keep_another(claim):
            reserved = reservations(state, state.policy.patience, reserved)
            found = danger(state, reserved, claim)
        self._reserved = reserved
        if isinstance(found, Undecided):
            if claim.danger is not None and found.rc is not None:
                self._actions.propose(found.rc, found.proposal)
            found = claim.danger
        if found == claim.danger:
            return
        claim.danger = found
        if found is None:
            del self._endangered[claim]
        else:
            self._endangered[claim] = None
        self._emit(BookingThreatened(claim.booking.id, found))
