"""Bookings in the core: a claim with a date, until its owner's request takes it up.

`Dates` has all bookings, best-ranked first. After two halves of a fleet have booked separately, two dates may exclude
each other. Then the better-ranked one is kept; the other is bound to other RCs, or is in conflict and not a claim.

`reservations.py` keeps their RCs free, `slots.py` finds times, `dangers.py` finds threats. Maintenance is a claim
that is never taken up.

After a change, only claims that overlap it in time and share an RC with it are checked again. An instant makes a
bounded number of checks, and requests another pass for the rest. A sharable RC is asked about few sets at a time, those
of the next dates first; an unknown vote causes neither conflict nor danger."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain, pairwise
from operator import itemgetter
from typing import Final

from msgspec.structs import replace

from zscout.keyexpr import host_in, is_pattern
from zscout.scheduling.booking import (
    Booking,
    BookingBound,
    BookingChanged,
    BookingConflict,
    BookingState,
    BookingThreatened,
    Dates,
)
from zscout.scheduling.claim_index import DateIndex, bits, by_date
from zscout.scheduling.dangers import Undecided, danger
from zscout.scheduling.model import Arc, ArcRequest, ArcState, Claim, Effect, Outcome, PatternClass, Rc, union
from zscout.scheduling.reason import Reason, ReasonCode
from zscout.scheduling.reservations import Reservations, reservations
from zscout.scheduling.slots import slots
from zscout.scheduling.state import Actions, SchedulerState
from zscout.scheduling.votes import HolderSet
from zscout.types import NO_TERM, ArcId, Ns, Place, RcName

MAX_CHECKS: Final = 256
"""Checks of claims in one instant: some 5 ms."""
CHECKS_PER_SEARCH: Final = 8
"""A search for other RCs, or a proposal, counts as this many checks."""
MAX_IN_FLIGHT: Final = 8
"""Sets of holders that an RC is asked about at a time."""


def request_for(booking: Booking) -> ArcRequest:
    return ArcRequest(
        booking.id,
        f"{booking.owner}/",
        booking.needs,
        booking.priority,
        booking.runtime,
        keep=booking.lasting,
        label=booking.label,
        booking=booking.id,
        who=booking.who,
    )


@dataclass(slots=True)
class _Questions:
    """The sets to ask one RC about, next dates first."""

    heap: list[tuple[Ns, int, HolderSet]] = field(default_factory=list)
    waiting: set[HolderSet] = field(default_factory=set)
    in_flight: dict[HolderSet, Ns] = field(default_factory=dict)
    count: int = 0

    def add(self, date: Ns, holders: HolderSet) -> None:
        if holders not in self.waiting and holders not in self.in_flight:
            self.count += 1
            self.waiting.add(holders)
            heapq.heappush(self.heap, (date, self.count, holders))

    def pop(self) -> None:
        self.waiting.discard(heapq.heappop(self.heap)[2])


class Calendar:
    def __init__(self, state: SchedulerState, actions: Actions, emit: Callable[[Effect], None]) -> None:
        self._state, self._actions, self._emit = state, actions, emit
        self._ranks: dict[str, int] = {}  # of all dates; bookings without a rank are not judged
        self._in_conflict: dict[str, Claim] = {}  # dates in conflict; their votes are kept, and not asked for again
        self._conflict_with: dict[str, str] = {}  # by date in conflict: the booking that excludes it
        self._conflicts_at: dict[int, DateIndex] = {}  # dates in conflict, by bit of each RC that could serve them
        self._unjudged: set[str] = set()
        self._order: list[tuple[int, str]] = []  # a heap of the unjudged dates, by rank
        self._unbound: dict[str, None] = {}  # dates whose patterns wait for votes
        self.is_partial = False  # further dates follow
        self._questions: dict[RcName, _Questions] = {}
        self._askable: dict[RcName, None] = {}  # RCs that may be asked about further sets
        self._danger_unchecked: dict[Claim, None] = {}  # bookings that may have come into danger or out of it
        self._checks_left = MAX_CHECKS  # checks left in this instant
        self._overdue_turn = 0  # counts checks of overdue bookings, which take turns
        self._reserved: Reservations | None = None  # the reservations at the last search for dangers
        self._endangered: dict[Claim, None] = {}  # bookings last reported as endangered
        self._wanting: dict[str, list[Arc]] = {}  # by booking: ARCs that want it while it is absent or taken
        self.certain_from: Ns = 0  # dates before this are uncertain: no booking begins or expires for good

    def stand_in(self, booking: Booking) -> Arc:
        """An ARC for a booking that is not taken up; without RCs for maintenance, whose claim has them."""
        if booking.maintenance:
            return Arc(request_for(booking), Place(NO_TERM, 0), 0)
        arc = self._state.new_arc(request_for(booking), Place(NO_TERM, 0))
        if arc.patterns:
            self._state.bind(arc, booking.bound)
        return arc

    def set_dates(self, dates: Dates) -> None:
        self.is_partial = dates.more
        if dates.more:
            for booking in dates.ranked:
                self.book(booking)
                self._unjudged.add(booking.id)
            return
        if dates.moved:
            self._move_waiting(dates.moved)
        state, wanted = self._state, {booking.id: booking for booking in dates.ranked}
        for name in [name for name in state.claims if name not in wanted]:
            self.unbook(name, at_present=name in dates.forgotten)
        for name in [name for name in self._in_conflict if name not in wanted]:
            self._forget_votes(self._take_from_conflict(name))
        before, self._ranks = self._ranks, {name: rank for rank, name in enumerate(wanted)}
        known = [name for name in wanted if name in before]
        same_order = all(before[name] < before[other] for name, other in pairwise(known))
        unjudged, self._unjudged, self._order = self._unjudged if same_order else {*known}, set(), []
        self._judge_again(unjudged)
        known_claims = (state.claims.get(name) or self._in_conflict.get(name) for name in known)
        moves = {wanted[claim.booking.id].start - claim.date for claim in known_claims if claim is not None}
        for name, booking in wanted.items():
            if (claim := state.claims.get(name) or self._in_conflict.get(name)) is None:
                self.book(booking, tentative=name in self._wanting)
                self._judge_again((name,))
            elif claim.date != booking.start:
                self.redate(name, booking.start, alike=len(moves) == 1)

    def book(self, booking: Booking, *, tentative: bool = False) -> None:
        if (known := self._state.claims.get(booking.id)) is not None:
            known.tentative = tentative
            self._offer(known)
            return
        if booking.lapses <= self._state.now:
            state = BookingState.USED if booking.maintenance else BookingState.LAPSED
            self._emit(BookingChanged(booking.id, state))
            return
        claim = Claim(booking, self.stand_in(booking), 0, tentative)
        claim.kept = self._kept(claim)
        self._state.dates.add(claim)
        if booking.maintenance:
            self._free_from_patterns(claim, claim.kept)
        self._offer(claim)

    def _kept(self, claim: Claim) -> int:
        """Bits of the RCs to keep for a claim not held; for maintenance of patterns and hosts, the RCs known now."""
        booking, state = claim.booking, self._state
        if not booking.maintenance:
            return claim.arc.mask
        named = state.mask(need for need in booking.needs if not is_pattern(need) and host_in(need) is None)
        return named | union(rc.bit for rc in state.rcs.values() if booking.maintains(rc.name, rc.host))

    def _free_from_patterns(self, claim: Claim, mask: int) -> None:
        """Rebind the patterns of bookings that use some of these RCs during this maintenance."""
        dates, booking = self._state.dates, claim.booking
        overlapping = (dates.of(rc, booking.start, booking.end) for rc in self._state.rcs_in(mask))
        self._rebind_others(mask, chain.from_iterable(overlapping))

    def _extend_maintenance(self, rc: Rc) -> None:
        """Add a joined RC to the maintenance that covers it, and remove it from its former host's."""
        for claim in list(self._state.maintenance.values()):
            kept = claim.kept | rc.bit if claim.booking.maintains(rc.name, rc.host) else claim.kept & ~rc.bit
            if kept != claim.kept:
                claim.kept = kept
                self._state.dates.put(claim)
                self._free_from_patterns(claim, kept & rc.bit)
                self._judge_again((claim.booking.id,))

    def unbook(self, booking: str, *, at_present: bool) -> None:
        if (claim := self._state.claims.get(booking)) is not None:
            self._end(claim, BookingState.UNBOOKED, at_present=at_present)

    def redate(self, booking: str, start: Ns, *, alike: bool = False) -> None:
        """Move a booking's date; of a held one, not its `booking`. If all move `alike`, no date is judged again."""
        if not alike:
            self._judge_again((booking,))
        if (conflicting := self._in_conflict.get(booking)) is not None:
            by = self._conflict_with[booking]
            self._take_from_conflict(booking)
            conflicting.booking, conflicting.date = replace(conflicting.booking, start=start), start
            self._put_in_conflict(conflicting, by)
        if (claim := self._state.claims.get(booking)) is None:
            return
        claim.date = start
        if claim.arc.hold is None:
            claim.booking = replace(claim.booking, start=start)
        self._state.dates.put(claim, changed=not alike)
        self._danger_unchecked[claim] = None
        if claim.arc.hold is None and claim.arc.held_back is not None:
            self._wait_again(claim.arc, start)
        if claim.arc.hold is None:
            self.expire()

    def _move_waiting(self, by: Ns) -> None:
        """After a step of the clock, move the dates of ARCs whose bookings are absent or taken."""
        for arc in chain.from_iterable(self._wanting.values()):
            arc.take(replace(arc.request, not_before=arc.request.not_before + by))
            if arc.hold is None:
                self._wait_again(arc, arc.request.not_before)

    def take_up(self, booking: str, arc: Arc) -> None:
        """Let an ARC take up its booking, now or once that is open. A waiting ARC is held back until the date."""
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
        self._state.dates.put(claim)
        self._emit(BookingChanged(claim.booking.id, BookingState.TAKEN, arc.id))
        self._wait_again(arc, claim.booking.start)

    def _offer(self, claim: Claim) -> None:
        """Let the ARCs that want an open booking take it up, if they match it and are its owner's."""
        booking = claim.booking
        for arc in [] if claim.tentative else self._wanting.pop(booking.id, ()):
            request = arc.request
            same = request.needs == booking.needs and request.priority == booking.priority
            if same and request.client.partition("/")[0] == booking.owner:
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
        """End the booking of an ended ARC. Before it lapses, reopen it if the client was lost or the ARC never held."""
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
        if (conflicting := self._in_conflict.get(name)) is not None and conflicting.arc is arc:
            conflicting.arc = self.stand_in(conflicting.booking)
            self._judge_again((name,))
        if claim is not None:
            arc.claim = None
            if claim.booking.start != claim.date:
                claim.booking = replace(claim.booking, start=claim.date)
            claim.arc = self.stand_in(claim.booking)
            self._state.dates.put(claim)
            self._emit(BookingChanged(claim.booking.id, BookingState.OPEN, arc.id))
            self._offer(claim)

    def _end(self, claim: Claim, state: BookingState, *, at_present: bool = False, forget: bool = True) -> None:
        arc = claim.arc if claim.is_taken else None
        if arc is None and forget:
            self._forget_votes(claim)
        self._state.dates.remove(claim)
        claim.arc.claim = None
        self._unbound.pop(claim.booking.id, None)
        self._endangered.pop(claim, None)
        claim.danger = None
        self._emit(BookingChanged(claim.booking.id, state, None if arc is None else arc.id))
        if arc is not None and (at_present or self._state.now < self.certain_from):
            self._wanting[claim.booking.id] = [*self._wanting.get(claim.booking.id, ()), arc]
        if arc is not None and not at_present:
            self._stop_waiting(arc)
            self._wait_until(arc, self.certain_from)

    def _forget_votes(self, claim: Claim) -> None:
        for rc in list(self._state.possible_sharables(claim.arc)):
            self._state.votes.forget_arc(rc.name, claim.booking.id)

    def expire(self) -> None:
        for claim in self._state.dates.over(self._state.now):
            if claim.booking.end <= self._state.now:
                used = claim.is_taken or claim.booking.maintenance
                self._end(claim, BookingState.USED if used else BookingState.LAPSED)
            elif not claim.is_taken:
                self._end(claim, BookingState.LAPSED)

    def in_maintenance(self) -> Iterator[tuple[Claim, Rc, Arc]]:
        """Yield the holders that maintenance ends: of equal or lower priority past their minimum runtimes; all, if it
        is urgent. The caller may end them meanwhile."""
        now = self._state.now
        for claim in self._state.maintenance.values() if self._state.maintenance else ():
            begun = claim.booking.start <= now and not claim.booking.broken
            for rc in self._state.rcs_in(claim.kept) if begun else ():
                for holder in list(rc.holders.values()):
                    due = holder.priority <= claim.booking.priority and holder.past_min_runtime(now)
                    if due or claim.booking.urgent:
                        yield claim, rc, holder

    def rc_lost(self, rc: Rc) -> None:
        self._rebind_others(rc.bit, self._state.dates.of(rc, self._state.now))

    def rc_joined(self, rc: Rc) -> None:
        self._extend_maintenance(rc)
        self._judge_again(claim.booking.id for claim in self._state.dates.of(rc, self._state.now))
        self._judge_again(self._in_conflict)
        self._judge_again(self._unbound)

    def _rebind_others(self, mask: int, claims: Iterable[Claim]) -> None:
        """Rebind the patterns of bookings that use some of these RCs to other RCs that are free then, the next dates
        first. Bookings beyond this instant's checks are rebound when their danger is found."""
        for claim in by_date(claim for claim in {*claims} if claim.kept & mask & ~claim.arc.named_mask):
            if self._checks_left > 0:
                self._rebind(claim)

    def _rebind(self, claim: Claim) -> bool:
        arc, booking, now = claim.arc, claim.booking, self._state.now
        if not arc.patterns or arc.hold is not None:
            return False
        self._checks_left -= CHECKS_PER_SEARCH
        date = max(booking.start, now)
        found = slots(self._state, replace(booking, start=date), arc, date, 1, presume=True).found
        kept = arc.named_mask | self._state.mask(found[0].bound.values()) if found else claim.kept
        if kept == claim.kept or kept & ~self._state.present & ~arc.named_mask:
            return False
        claim.booking = replace(booking, bound=found[0].bound)
        claim.kept = kept
        if not claim.is_taken:
            self._state.bind(arc, found[0].bound)
        self._state.dates.put(claim)
        return True

    # Changes, followed up in parts

    def begin(self) -> None:
        self._checks_left = MAX_CHECKS

    def follow_up(self) -> None:
        """Judge dates, ask for votes, and report dangers where something has changed."""
        state = self._state
        if not state.claims and not self._in_conflict:
            if self._reserved is not None or state.dates.touched:
                self._reserved = None
                state.dates.touched.clear()
                for of_claims in (self._endangered, self._danger_unchecked, self._questions, self._askable):
                    of_claims.clear()
                self._unjudged.clear()
                self._order.clear()
            state.changed.clear()
            state.votes.changed.clear()
            return
        self._take_votes()
        self._mark_affected()
        self._judge()
        self._ask_votes()
        self._take_changes()
        self._mark_affected()
        self._report_dangers()
        if self._unjudged or self._danger_unchecked or self._askable:
            self._actions.run_again()

    def _mark_affected(self) -> None:
        """Mark claims and dates that overlap changed claims for another check."""
        state, touched = self._state, self._state.dates.touched
        if self._reserved is None and not self._in_conflict and len(self._unjudged) >= len(self._ranks):
            touched.clear()  # all are checked anyway
        while touched:
            claim, mask, start, end = touched.popitem()[0]
            rank = self._ranks.get(claim.booking.id, math.inf)
            if claim.booking.id in state.claims:
                self._danger_unchecked[claim] = None
            for bit in bits(mask):
                for other in state.dates.of(state.rc_of(bit), start, end):
                    self._danger_unchecked[other] = None
                    if self._ranks.get(other.booking.id, -1) > rank:
                        self._judge_again((other.booking.id,))
                if bit in self._conflicts_at:
                    self._judge_again(
                        conflicting.booking.id for conflicting in self._conflicts_at[bit].overlapping(start, end)
                    )

    def _judge_again(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self._unjudged and (rank := self._ranks.get(name)) is not None:
                self._unjudged.add(name)
                heapq.heappush(self._order, (rank, name))

    def _take_votes(self) -> None:
        """Mark claims and dates that new and dropped votes are about for another check."""
        state = self._state
        changed, state.votes.changed = state.votes.changed, {}
        for name, sets in changed.items():
            rc = state.rc(name)
            if name in self._questions:
                self._askable[name] = None
            if sets is None:
                claims = state.dates.of(rc, state.now)
                self._danger_unchecked |= dict.fromkeys(claims)
                self._judge_again(claim.booking.id for claim in claims)
            for holders in sets or ():
                vetoed = not state.votes.accepts(name, holders)
                for holder in holders:
                    claim = self._claim_of(holder)
                    if claim is not None:
                        self._danger_unchecked[claim] = None
                        self._judge_again((claim.booking.id,))
                    elif vetoed and (arc := state.running.get(holder)) is not None:
                        self._danger_unchecked |= dict.fromkeys(state.dates.of(rc, state.now, arc.known_end()))
                    if vetoed and claim is not None:
                        spans = state.dates.of(rc, claim.booking.start, claim.booking.end)
                        self._danger_unchecked |= dict.fromkeys(spans)

    def _claim_of(self, holder: ArcId) -> Claim | None:
        """The claim of an ARC, or of a booking that no ARC has taken up."""
        arc = self._state.arc(holder)
        if arc is not None and (arc.claim is not None or arc.request.booking in self._in_conflict):
            return arc.claim or self._in_conflict[arc.request.booking]
        return self._state.claims.get(holder) or self._in_conflict.get(holder)

    def placeholder_in_conflict(self, holder: ArcId) -> Arc | None:
        return self._in_conflict[holder].arc if holder in self._in_conflict else None

    # Which dates are kept

    def _judge(self) -> None:
        """Decide which dates are kept, best-ranked first: a date may be in the way of lower-ranked dates only."""
        while self._order and self._checks_left > 0:
            name = heapq.heappop(self._order)[1]
            self._unjudged.discard(name)
            self._checks_left -= 1
            if (claim := self._state.claims.get(name)) is not None:
                self._judge_claim(claim)
            elif name in self._in_conflict:
                self._judge_conflict(name)
            self._mark_affected()

    def _judge_claim(self, claim: Claim) -> None:
        if claim.arc.patterns and not claim.booking.bound and claim.arc.hold is None:
            self._bind(claim, "")
            return
        by, unknown = self._obstacle(claim)
        if by is None:
            self._want_votes(claim, unknown)
            self._danger_unchecked[claim] = None
            if claim.tentative:
                claim.tentative = False
                self._offer(claim)
            return
        self._end(claim, BookingState.UNBOOKED, at_present=True, forget=False)
        self._bind(claim, by)

    def _judge_conflict(self, name: str) -> None:
        claim = self._in_conflict[name]
        by, _ = self._obstacle(claim)
        if by is None and not (claim.arc.patterns and not self._conflict_with[name]):
            self._take_from_conflict(name)
            self._emit(BookingConflict(name, None))
            self._enter(claim)
        else:
            self._bind(claim, by or "")

    def _enter(self, claim: Claim) -> None:
        claim.booking = replace(claim.booking, start=claim.date)
        claim.arc = self.stand_in(claim.booking)
        claim.kept, claim.tentative = self._kept(claim), False
        self._state.dates.add(claim)
        self._judge_again((claim.booking.id,))
        self._offer(claim)

    def _bind(self, claim: Claim, by: str) -> None:
        """Bind the patterns of a date to RCs that are free then. If there are none, it is in conflict with `by`."""
        name, is_claim = claim.booking.id, claim.booking.id in self._state.claims
        self._unbound.pop(name, None)
        if claim.arc.patterns:
            self._checks_left -= CHECKS_PER_SEARCH
            unbound = replace(claim.booking, start=claim.date, bound={})
            found = slots(self._state, unbound, self.stand_in(unbound), claim.date, 1, bookings_only=True)
            if found.unknown:
                self._want_votes(claim, found.unknown)
                if not by and is_claim:
                    self._unbound[name] = None
                    return  # judged again when the votes are in
            elif found.found:
                bound = found.found[0].bound
                claim.booking = replace(unbound, bound=bound)
                if is_claim:
                    self._state.bind(claim.arc, bound)
                    claim.kept = claim.arc.mask
                    self._state.dates.put(claim)
                    self._offer(claim)
                else:
                    if name in self._in_conflict:
                        self._take_from_conflict(name)
                        self._emit(BookingConflict(name, None))
                    self._enter(claim)
                self._emit(BookingBound(name, bound))
                return
        if is_claim:
            self._end(claim, BookingState.UNBOOKED, at_present=True, forget=False)
        if self._conflict_with.get(name) != by:
            if name in self._in_conflict:
                self._take_from_conflict(name)
            self._put_in_conflict(claim, by)
            self._emit(BookingConflict(name, by))

    def _put_in_conflict(self, claim: Claim, by: str) -> None:
        name = claim.booking.id
        self._in_conflict[name], self._conflict_with[name] = claim, by
        for bit in bits(self._choices(claim)):
            self._conflicts_at.setdefault(bit, DateIndex()).add(claim.date, claim.date + claim.booking.runtime, claim)

    def _take_from_conflict(self, name: str) -> Claim:
        claim = self._in_conflict.pop(name)
        del self._conflict_with[name]
        for bit in list(self._conflicts_at):
            self._conflicts_at[bit].discard(claim.date, claim.date + claim.booking.runtime, claim)
            if not self._conflicts_at[bit]:
                del self._conflicts_at[bit]
        return claim

    def _choices(self, claim: Claim) -> int:
        return claim.kept | union(map(self._state.matching_mask, claim.arc.patterns))

    def _obstacle(self, claim: Claim) -> tuple[str | None, list[tuple[Rc, HolderSet]]]:
        """A better-ranked date that excludes `claim`, if any; else the unknown votes that decide. Absent RCs are
        skipped, as it is unknown whether they are sharable."""
        state, unknown, rank = self._state, list[tuple[Rc, HolderSet]](), self._ranks[claim.booking.id]
        # A running ARC keeps the RCs of its patterns.
        needed = claim.kept if claim.arc.hold is None else claim.arc.named_mask
        for rc in state.rcs_in(needed & state.present):
            found = [
                (other_rank, other)
                for other in state.dates.of(rc, claim.date, claim.date + claim.booking.runtime)
                if (other_rank := self._ranks.get(other.booking.id, rank)) < rank
                and other.mask & rc.bit
                and _overlap(claim, other)
            ]
            before = [other for _, other in sorted(found, key=itemgetter(0))]
            if before and (
                not rc.sharable or _any_maintenance(claim, before) or self._refused(rc, claim, before, unknown)
            ):
                return before[0].booking.id, []
        return None, unknown

    def _refused(self, rc: Rc, claim: Claim, before: list[Claim], unknown: list[tuple[Rc, HolderSet]]) -> bool:
        """Return True if the RC ever refuses the claim beside those `before` it. Adds unknown votes to `unknown`."""
        for time in sorted({claim.booking.start, *(other.booking.start for other in before)}):
            if not claim.booking.start <= time < claim.booking.end:
                continue
            there = [booked for booked in (*before, claim) if booked.booking.start <= time < booked.booking.end]
            holders = frozenset(booked.arc.id for booked in there)
            answer = self._state.votes.known(rc.name, holders)
            if answer is None:
                unknown.append((rc, holders))
            elif not answer.accept:
                return True
        return False

    # Votes

    def _want_votes(self, claim: Claim, unknown: Iterable[tuple[Rc, HolderSet]]) -> None:
        for rc, holders in unknown:
            self._questions.setdefault(rc.name, _Questions()).add(claim.booking.start, holders)
            self._askable[rc.name] = None

    @property
    def next_question(self) -> Ns | None:
        """When an unresponsive RC may be asked again."""
        votes = self._state.votes
        silent = self._questions.keys() & votes.unresponsive if votes.unresponsive else ()
        return min(map(votes.retry_at, silent), default=None)

    def _ask_votes(self) -> None:
        """Ask each RC about a few sets at a time, next dates first."""
        votes = self._state.votes
        for name in votes.due(self._state.now) if votes.unresponsive else ():
            if name in self._questions:
                self._askable[name] = None
        for name in list(self._askable):
            if self._checks_left <= 0:
                return
            del self._askable[name]
            questions = self._questions[name]
            self._ask_rc(self._state.rc(name), questions)
            if not questions.heap and not questions.in_flight:
                del self._questions[name]

    def _ask_rc(self, rc: Rc, questions: _Questions) -> None:
        votes, in_flight = self._state.votes, questions.in_flight
        for holders, date in list(in_flight.items()):
            if not votes.is_asked(rc.name, holders):
                del in_flight[holders]
                questions.add(date, holders)
        while questions.heap and votes.open(rc.name) < MAX_IN_FLIGHT:
            date, _, holders = questions.heap[0]
            if self._may_ask(rc, holders):
                self._checks_left -= CHECKS_PER_SEARCH
                if not self._actions.propose(rc, holders) and rc.name in votes.unresponsive:
                    return
                in_flight[holders] = date
            questions.pop()

    def _may_ask(self, rc: Rc, holders: HolderSet) -> bool:
        there = rc.present and rc.sharable and all(self._claim_of(holder) is not None for holder in holders)
        return there and self._state.votes.known(rc.name, holders) is None

    # Dangers

    def _take_changes(self) -> None:
        """Mark for a check the bookings whose danger may have changed with holders, RCs or reservations."""
        state, before = self._state, self._reserved
        self._reserved = reserved = reservations(state, before)
        changed, state.changed = state.changed, {}
        if before is not None and before is not reserved:
            for bit, over in reserved.starving_changed(before).items():
                changed[bit] = max(over, changed.get(bit, 0))
        if before is None:
            self._danger_unchecked |= dict.fromkeys(state.claims.values())
        for bit, until in changed.items() if before is not None else ():
            if until > state.now and bit & state.dates.claimed:
                self._danger_unchecked |= dict.fromkeys(state.dates.of(state.rc_of(bit), state.now, until))
        mask = union(changed)
        self._danger_unchecked |= {claim: None for claim in self._endangered if mask and self._choices(claim) & mask}

    def _report_dangers(self) -> None:
        """Report bookings that came into danger or out of it, and other causes of danger."""
        state, unchecked, uncertain = self._state, self._danger_unchecked, self._unjudged | self._unbound.keys()
        while unchecked and self._checks_left > 0:
            claim = next(iter(unchecked))
            del unchecked[claim]
            name = claim.booking.id
            if state.claims.get(name) is claim and name not in uncertain:
                self._checks_left -= 1
                self._report_danger(claim)
        # The reasons of overdue bookings change with their ARCs.
        begun = state.dates.begun(state.now)
        waiting = [claim for claim in begun if claim.arc.hold is None and claim.booking.id not in uncertain]
        for _ in range(min(len(waiting), self._checks_left)):
            self._overdue_turn += 1
            self._checks_left -= 1
            self._report_danger(waiting[self._overdue_turn % len(waiting)])

    @property
    def next_start(self) -> Ns | None:
        starts = self._reserved.starts if self._reserved is not None else ()
        return min((start for start in starts if start > self._state.now), default=None)

    def _report_danger(self, claim: Claim) -> None:
        state, reserved = self._state, reservations(self._state, self._reserved)
        found = danger(state, reserved, claim)
        if isinstance(found, Reason) and self._rebind(claim):
            reserved = reservations(state, reserved)
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


def _overlap(claim: Claim, other: Claim) -> bool:
    """Return True if the claims overlap in time; maintenance does not conflict with maintenance."""
    both = claim.booking.maintenance and other.booking.maintenance
    return not both and -other.booking.runtime < other.date - claim.date < claim.booking.runtime


def _any_maintenance(claim: Claim, before: list[Claim]) -> bool:
    return claim.booking.maintenance or any(other.booking.maintenance for other in before)
