"""Bounded waiting: once an ARC has waited for its patience it is *due*, and no other may pass it.

Ranks prefer short ARCs, and searches prefer large sets: both let other ARCs starve. The remedy is reservation with
conservative backfill (Mu'alem and Feitelson, IEEE TPDS 12(6), 2001), on distinct RCs instead of equal processors, and
from the time at which the ARC is due: an ARC that would end before is not held back. Minimum runtimes are exact, so
reservations are exact too.

From half its patience on, an ARC is *starving*. By priority, then by when they began to starve, each starving ARC gets
the earliest time, from when it is due, at which its RCs are free of holders that do not yield to it then and of earlier
starving ARCs. An ARC of equal or lower priority on these RCs may start only if it ends by then, or if the RC is
sharable and accepts it beside all concerned.

A booking reserves its RCs for its own time. Promises to equals are kept in the order in which they were made: starving
ARCs avoid older bookings and ignore newer ones. Maintenance precedes all promises except those to higher priorities;
while it lasts it precedes these too.

With fair shares an ARC whose group had more than another waiting group counts as queued later (`Arc.late`).

`docs/scheduling/waiting.md` states the resulting promise, `docs/decisions/0008-worth-of-a-set.md` the alternatives
tried."""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Iterator
from operator import attrgetter
from typing import Final, NamedTuple, TypeAlias

from zscout.scheduling.booking import Booking
from zscout.scheduling.model import Arc, Rc, union
from zscout.scheduling.reason import Reason, ReasonCode
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import HolderSet
from zscout.types import ArcId, Ns

MAX_STARVING: Final = 16
"""ARCs with reservations at a time; later starving ARCs follow as these start."""


Order: TypeAlias = tuple[bool, int, Ns, str]
"""Sort key of promises: maintenance first, then band of priorities (negated), when made, id."""


class Reservation(NamedTuple):
    arc: Arc
    start: Ns
    order: Order
    booked: Ns | None = None
    """The end, if it is booked."""
    broken: bool = False
    """Maintenance that operators' ARCs may disregard."""

    @property
    def excludes(self) -> bool:
        """Return True for maintenance: the RC has no other holder."""
        return not self.order[0]

    def over(self) -> Ns:
        return self.arc.ends(self.start) if self.booked is None else self.booked


class Inadmissible(NamedTuple):
    """`rc` keeps an ARC out for `reason`, unless the vote on `proposal` changes that."""

    rc: Rc
    reason: Reason
    proposal: HolderSet | None = None
    early: bool = False
    """The ARC's own reserved time may let it start without a change at the RC."""


def order_of(state: SchedulerState, booking: Booking) -> Order:
    return not booking.maintenance, -state.band(booking.priority), booking.since, booking.id


def yields(holder: Arc, other: Arc, time: Ns) -> bool:
    """Return True if a hold is over at `time`, or `other` may preempt it then."""
    return holder.known_end(other) <= time or holder.preemptible_by(other, time)


def reservations(state: SchedulerState, last: Reservations | None) -> Reservations:
    """The present reservations: `last`, if nothing that it depends on has changed. Time alone changes neither RCs nor
    order; for a due ARC no backfill is possible."""
    if state.policy.patience is not None:
        state.index.mark_starving(state.now, state.queued)
    state.dates.pass_time(state.now, state.present)
    if last is not None and last.current:
        return last
    return Reservations(state)


def _versions(state: SchedulerState) -> tuple[int, ...]:
    return state.version, state.votes.version, state.index.starving_version, state.dates.version


class Reservations:
    """Reservations of starving ARCs, made once, and of bookings, looked up on use. Held bookings have theirs too, as a
    pass may preempt their holds."""

    def __init__(self, state: SchedulerState) -> None:
        self._state, self._votes = state, state.votes
        self.made_of = _versions(state)
        self.starving: dict[int, list[Reservation]] = {}  # of starving ARCs, by bit of the RC, in order
        self._free: dict[int, Ns] = {}  # by bit: the end of earlier reservations
        self.starts: list[Ns] = []  # reserved times of starving ARCs
        for priority, since, arc in state.index.starving[:MAX_STARVING]:
            if state.queued[arc].claim is None:
                self._reserve(state.queued[arc], (True, priority, since, arc))
        self.bits = state.dates.claimed | union(self.starving)

    @property
    def current(self) -> bool:
        return self.made_of == _versions(self._state)

    def at(self, rc: Rc, start: Ns, end: float) -> list[Reservation]:
        """The bookings of `rc` in this span, and all its reservations for starving ARCs, in order."""
        state, found = self._state, list(self.starving.get(rc.bit, ()))
        if rc.bit & state.dates.claimed and (claims := state.dates.booked(rc, start, end)):
            for claim in claims:
                booking = claim.booking
                found.append(
                    Reservation(claim.arc, booking.start, order_of(state, booking), booking.end, booking.broken)
                )
            if len(found) > 1:
                found.sort(key=attrgetter("order"))
        return found

    def before(self, rc: Rc, order: Order, start: Ns, end: float) -> list[Reservation]:
        return [promise for promise in self.at(rc, start, end) if promise.order < order]

    def _beside_bookings(self, arc: Arc, rcs: list[Rc], start: Ns, order: Order) -> Ns:
        """The earliest time from `start` at which `arc` meets no booking."""
        while blocking := [end for rc in rcs for end in self._blocking(arc, rc, start, order)]:
            start = max(blocking)  # a start before this would meet the booking that ends last
        return start

    def _blocking(self, arc: Arc, rc: Rc, start: Ns, order: Order) -> Iterator[Ns]:
        """The ends of bookings of `rc` that are in the way of `arc` if it starts at `start`."""
        if not rc.bit & self._state.dates.claimed:
            return
        for claim in self._state.dates.booked(rc, start, arc.ends(start)):
            booking = claim.booking
            if order_of(self._state, booking) < order:
                beside = rc.sharable and not booking.maintenance
                if not (beside and self._votes.accepts(rc.name, frozenset((claim.arc.id, arc.id)))):
                    yield booking.end

    def _reserve(self, arc: Arc, order: Order) -> None:
        rcs = self._rcs(arc, order)
        if not all(rc.present for rc in rcs):
            return
        start, found = -1.0, float(max(self._state.now, self.due(arc)))
        while start < found:
            # A holder that yields now may be protected by then: try later times until no holder is in the way.
            start = found
            found = max(start, self._within_quota(arc), *(self._free_from(rc, arc, order, int(start)) for rc in rcs))
            if math.isinf(found):
                return
            found = self._beside_bookings(arc, rcs, int(found), order)
        start = int(start)
        reservation = Reservation(arc, start, order)
        self.starts.append(start)
        for rc in rcs:
            insort(self.starving.setdefault(rc.bit, []), reservation, key=attrgetter("order"))
            self._free[rc.bit] = max(self._free.get(rc.bit, 0), arc.ends(start))

    def _rcs(self, arc: Arc, order: Order) -> list[Rc]:
        """The RCs to reserve, for each pattern the match that is free first. If none is left, an absent placeholder."""
        rcs = list(self._state.rcs_in(arc.named_mask)) if arc.patterns else list(arc.rcs)
        for need in arc.patterns:
            matching = self._state.matching(need)
            left = [rc for rc in matching if rc.present and rc not in rcs and not rc.bit & self._state.barred(arc)]
            time = max(self._state.now, self.due(arc))
            shut = self._state.present & ~self._state.open_to(arc.priority)
            best = min(
                left,
                key=lambda rc: (bool(rc.bit & shut), self._free_from(rc, arc, order, time), rc.bit),
                default=Rc(need, 0),
            )
            rcs.append(best)
        return rcs

    def _within_quota(self, arc: Arc) -> float:
        state, ends = self._state, [float(self._state.now)]
        if state.quota_left(arc) == 0:
            ends.append(min(other.known_end() for other in state.running.values() if other.owner == arc.owner))
        for quota in state.policy.rc_quotas.get(arc.owner, ()):
            running = [other for other in state.running.values() if other.owner in quota.owners]
            held = sum(len(other.rcs) for other in running)
            for other in sorted(running, key=lambda other: other.known_end()):
                if held + len(arc.request.needs) <= quota.rcs:
                    break
                ends.append(other.known_end())
                held -= len(other.rcs)
        return max(ends)

    def _free_from(self, rc: Rc, arc: Arc, order: Order, time: Ns) -> float:
        """The time by which `rc` has room for `arc`, ignoring holders that yield at `time`; infinite if unknown."""
        non_preemptible = rc.non_preemptible_holders(arc, time)
        if rc.sharable:
            return self._room_from(rc, arc, order, non_preemptible)
        return max((self._free.get(rc.bit, self._state.now), *(holder.known_end(arc) for holder in non_preemptible)))

    def _room_from(self, rc: Rc, arc: Arc, order: Order, holders: list[Arc]) -> float:
        """The first time at which a sharable RC accepts `arc` beside the holders and earlier promises not over then."""
        now, votes = self._state.now, self._votes
        before = [promise for promise in self.before(rc, order, now, arc.ends(now)) if not promise.excludes]
        ends = [(holder.known_end(arc), holder.id) for holder in holders]
        ends += [(float(promise.over()), promise.arc.id) for promise in before]
        if votes.accepts(rc.name, frozenset((arc.id, *(other for _, other in ends)))):
            return now
        alone = votes.known(rc.name, frozenset((arc.id,)))
        if rc.name in votes.unresponsive or (alone is not None and not alone.accept):
            return math.inf
        ends.sort()
        for number, (time, _) in enumerate(ends, 1):
            if votes.accepts(rc.name, frozenset((arc.id, *(other for _, other in ends[number:])))):
                return time
        return max(now, ends[-1][0]) if ends else now

    def due(self, arc: Arc) -> Ns:
        return arc.since + arc.late + arc.patience

    def free_until(self, arc: Arc, end: Ns) -> Ns:
        """When its RCs are next reserved, at most `end`; not its own time, nor lower-priority starving ARCs'."""
        now, band = self._state.now, self._state.band
        for rc in self._state.rcs_in(arc.mask & self.bits):
            for promise in self.at(rc, now, end):
                binds = promise.booked is not None or band(arc.priority) <= band(promise.arc.priority)
                if binds and promise.arc is not arc:
                    end = min(end, max(now, promise.start))
        return end

    def goes_first(self, arc: Arc) -> bool:
        """Return True if `arc` precedes its equals: booked or due, with a sharable RC, which may accept each backfilled
        ARC alone but not all together."""
        state = self._state
        due = arc.claim is not None or (arc.starving and self.due(arc) <= state.now)
        return due and bool(arc.mask & state.sharable)

    def conflict(self, arc: Arc) -> Inadmissible | None:
        """The reservation that `arc` would delay if it started now."""
        if not arc.mask & self.bits:
            return None
        for rc in self._state.rcs_in(arc.mask & self.bits):
            before: list[Reservation] = []
            blocking: Reservation | None = None
            binding, early = self._binding(rc, arc)
            for reservation in binding:
                if reservation.excludes:
                    if self._delays(arc, reservation):
                        return Inadmissible(rc, kept_for(rc, reservation), early=early)
                    continue
                before.append(reservation)
                if blocking is None and self._delays(arc, reservation):
                    blocking = reservation
            if blocking is None:
                continue
            reason = kept_for(rc, blocking)
            if not rc.sharable:
                return Inadmissible(rc, reason, early=early)
            for together in self._together(rc, arc, before):
                answer = self._votes.known(rc.name, together)
                if answer is None or not answer.accept:
                    return Inadmissible(rc, reason, together if answer is None else None, early)
        return None

    def _binding(self, rc: Rc, arc: Arc) -> tuple[list[Reservation], bool]:
        """The reservations of `rc` that bind `arc` if it starts now: those before its own and, until its own time, all
        bookings. True: later bookings are among them, so its own time may let it start."""
        now = self._state.now
        reserved = self.at(rc, now, arc.ends(now))
        own = self._own(rc, arc)
        if own is None:
            return reserved, False
        before = [promise for promise in reserved if promise.order < own.order]
        if own.start <= now:
            return before, False
        later = [promise for promise in reserved if promise.order > own.order and promise.booked is not None]
        return [*before, *later], bool(later)

    def _own(self, rc: Rc, arc: Arc) -> Reservation | None:
        if (claim := arc.claim) is None:
            return next((promise for promise in self.starving.get(rc.bit, ()) if promise.arc is arc), None)
        if not claim.mask & rc.bit or self._state.dates.is_suspended(claim):
            return None
        return Reservation(arc, claim.booking.start, order_of(self._state, claim.booking), claim.booking.end)

    def _together(self, rc: Rc, arc: Arc, before: list[Reservation]) -> list[HolderSet]:
        """The sets of holders to ask `rc` about if `arc` starts now: one for now, and one for each promised ARC that
        arrives before its end. A set has no holder that yields to the arriving ARC. It includes the promised ARCs that
        may be there: a starving ARC may start earlier than reserved, but not before an ARC with an earlier
        reservation."""
        now, end = self._state.now, arc.ends(self._state.now)
        sets = []
        for time in sorted({now, *(promise.start for promise in before if now < promise.start < end)}):
            arriving = [promise for promise in before if promise.start == time > now]
            there = [promise for promise in before if self._is_there(promise, time, arriving)]
            coming = [promise.arc for promise in arriving] or [arc]
            staying = [
                holder.id for holder in rc.holders.values() if not any(yields(holder, other, time) for other in coming)
            ]
            sets.append(frozenset((*staying, arc.id, *(promise.arc.id for promise in there))))
        if any(promise.booked is not None for promise in before):
            return sets
        # Ask about all sets at once; only if that is refused, about each set.
        whole = frozenset[ArcId]().union(*sets)
        answer = self._votes.known(rc.name, whole)
        return sets if answer is not None and not answer.accept else [whole]

    def _is_there(self, promise: Reservation, time: Ns, arriving: list[Reservation]) -> bool:
        if promise.booked is not None:
            return promise.start <= time < promise.booked
        begun = promise.start <= time or any(promise.order < other.order for other in arriving)
        return begun and promise.arc.ends(max(promise.start, self._state.now)) > time

    def reserves(self, rc: Rc, arc: Arc) -> bool:
        """Return True if `rc` is reserved exclusively for another ARC that precedes `arc`."""
        return any(
            (promise.excludes or not rc.sharable) and self._delays(arc, promise)
            for promise in self._binding(rc, arc)[0]
        )

    def _delays(self, arc: Arc, reservation: Reservation) -> bool:
        """Return True if `arc`, started now, would still hold the RCs at the reserved time, and must not."""
        if reservation.broken and self._state.operator(arc.priority):
            return False
        band, now = self._state.band, self._state.now
        begun = reservation.excludes and reservation.start <= now
        binds = begun or band(arc.priority) <= band(reservation.arc.priority)
        return binds and arc.ends(now) > reservation.start

    def changed(self, earlier: Reservations) -> int:
        booked = self._state.dates.changed_since(earlier.made_of[-1])
        return booked | union(self.starving_changed(earlier))

    def starving_changed(self, earlier: Reservations) -> dict[int, Ns]:
        """By bit of the RCs whose reservations for starving ARCs have changed: the end of the last of these."""
        now, before = self.starving, earlier.starving
        return {
            bit: max(promise.over() for promise in (*now.get(bit, ()), *before.get(bit, ())))
            for bit in now.keys() | before.keys()
            if now.get(bit) != before.get(bit)
        }


def kept_for(rc: Rc, reservation: Reservation) -> Reason:
    if reservation.broken:
        return Reason(ReasonCode.BROKEN, (rc.name,), (reservation.arc.party,))
    if reservation.excludes:
        until = None if reservation.arc.request.keep else reservation.booked
        party = reservation.arc.party._replace(until=until)
        return Reason(ReasonCode.MAINTENANCE, (rc.name,), (party,))
    code = ReasonCode.RESERVED if reservation.booked is None else ReasonCode.BOOKED
    return Reason(code, (rc.name,), (reservation.arc.party,))
