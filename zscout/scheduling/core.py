"""The core of the RCM: events and the time in, effects out; no clock, thread, socket or log inside.

This module applies events and carries out decisions. The strategy's pass (`priority.py` has its steps) decides which
ARC starts and which is preempted, by the rule of `Arc.preemptible_by`; `votes.py` keeps the votes of RCs, `state.py`
the holds and the queue. The RCM service, `zscout replay`, the study and the forecast use this class:

    effects = core.handle(now, Requested(request), ...)

A batch of events is one instant. The caller carries out the effects in order and calls again with their results: with
votes, and with a `Tick` at the time of the last `WakeAt`, if nothing comes before."""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable
from typing import Final

from msgspec.structs import replace

from zscout.config.scheduling_policy import DEFAULT, SchedulingPolicy
from zscout.scheduling import model
from zscout.scheduling.admission import AdmissionCheck
from zscout.scheduling.booking import Booked, Booking, BookingStatus, Dates, Redated, Unbooked
from zscout.scheduling.calendar import Calendar
from zscout.scheduling.model import Arc, ArcState, ArcStatus, Hold, Outcome, Rc, RcStatus, Status
from zscout.scheduling.priority import Priority, reason_of_now, reasons_of_now
from zscout.scheduling.reason import Reason, ReasonCode, of_rcs
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.scheduling.slots import SlotsFound, slots
from zscout.scheduling.state import SchedulerState, Strategy
from zscout.scheduling.upcoming import UpcomingEnd, contended_holds, upcoming
from zscout.scheduling.votes import HolderSet
from zscout.types import NO_TERM, ArcId, ClientId, Grant, HostName, Ns, Place, RcName, Term

NO_HOSTS: Final = frozenset[HostName]()


class Core:
    def __init__(
        self, strategy: Strategy | None = None, policy: SchedulingPolicy = DEFAULT, *, assume_latest_begin: bool = False
    ) -> None:
        """`assume_latest_begin`: RCs report nothing, so each is assumed to begin as late as its bound allows."""
        self.strategy, self._assume_latest_begin = strategy or Priority(), assume_latest_begin
        self._state = SchedulerState(policy, adaptive=self.strategy.name == "adaptive")
        self._votes = self._state.votes
        self.term: Term = NO_TERM
        self.seq = 0
        self.batches = 0
        self._arrivals = 0
        self._effects: list[model.Effect] = []
        self._calendar = Calendar(self._state, self, lambda effect: self._effects.append(effect))
        self._ended_grants: set[Grant] = set()  # grants of earlier terms that ended in this term
        self._wake: Ns | None = None
        self._run_again = False

    def handle(self, now: Ns, *events: model.Event) -> list[model.Effect]:
        """Apply one instant's events and run a pass. Raises ValueError if `now` goes backwards.

        1. End the holds and bookings whose time is over.
        2. Apply the events, in the order given.
        3. End the kept holds that block maintenance.
        4. Run a pass of the strategy, if the queue is not empty.
        5. Report conflicts and dangers of bookings, and the next wake-up."""
        if now < self._state.now:
            raise ValueError(f"time went backwards: {now} after {self._state.now}")
        self._state.now = now
        self.batches += 1
        self._effects = []
        self._run_again = False
        self._calendar.begin()
        self._expire()
        self._calendar.expire()
        self._state.readmit()
        if len(events) == 1 and isinstance(events[0], model.Requested):
            self._enter_request(events[0], alone=True)
        else:
            for event in events:
                self._apply(event)
        self._begin_maintenance()
        if self._state.queued:
            self._state.order_groups()
            self.strategy.run_pass(self._state, self)
        for arc in self._state.held_back.values():
            if arc.held_back is None and (other := self._state.at_place(arc.place)) is not None:
                self.wait(arc, _claimed_by(other))
        if not self._calendar.is_partial:
            self._calendar.follow_up()
            self._set_wake()
        return self._effects

    @property
    def reasons_changed(self) -> bool:
        """Return True if a waiting ARC may have another reason than the one last reported."""
        return bool(self._state.index.unreported)

    def report_reasons(self) -> list[model.Effect]:
        """Return the reasons that changed since the last report."""
        self._effects = []
        for arc, reason in reasons_of_now(self._state):
            self.wait(arc, reason)
        return self._effects

    def upcoming_changed(self, *, reported: bool) -> bool:
        """Return True if upcoming ends of holds may have changed since the last report. `reported`: it had some."""
        state = self._state
        contended = (state.index.contended | state.dates.contended) & (state.busy | state.sharable)
        return bool(contended and (reported or state.queued or state.claims))

    def contended_holds(self) -> list[ArcId]:
        return [arc.id for arc in contended_holds(self._state)]

    def upcoming(self, arc_id: ArcId) -> tuple[UpcomingEnd, ...]:
        arc = self._state.running.get(arc_id)
        return () if arc is None else upcoming(self._state, arc)

    @property
    def policy(self) -> SchedulingPolicy:
        return self._state.policy

    @policy.setter
    def policy(self, policy: SchedulingPolicy) -> None:
        self._state.take_policy(policy)

    def status(self, limit: int | None = None) -> Status:
        """The fleet as of the last batch, with the best-ranked `limit` of the queue (None: all)."""
        state = self._state
        return Status(
            running=tuple(self._arc_status(arc) for arc in state.running.values()),
            queued=tuple(map(self._arc_status, self._best_ranked(limit))),
            waiting=self.waiting,
            rcs=tuple(
                RcStatus(name, rc.present, rc.sharable, tuple(rc.holders)) for name, rc in sorted(state.rcs.items())
            ),
        )

    def arc(self, arc_id: ArcId) -> ArcStatus | None:
        arc = self._state.arc(arc_id)
        return None if arc is None else self._arc_status(arc)

    def _best_ranked(self, limit: int | None) -> list[Arc]:
        state = self._state
        arcs = [state.queued[rank[-1]] for rank in state.index.ranks[:limit]]
        if state.held_back:
            arcs = sorted((*arcs, *state.held_back.values()), key=lambda arc: arc.rank)[:limit]
        return arcs

    def is_queued(self, arc_id: ArcId) -> bool:
        return arc_id in self._state.queued or arc_id in self._state.held_back

    @property
    def waiting(self) -> int:
        return len(self._state.queued) + len(self._state.held_back)

    def holders(self, rc: RcName) -> list[ArcStatus]:
        return [self._arc_status(arc) for arc in self._state.rc(rc).holders.values()]

    def arcs_of(self, client: ClientId) -> list[ArcId]:
        """The ARCs of one client, waiting first: ended in this order, none can start by the end of another."""
        arcs = self._state.arcs_of(client)
        return [arc.id for arc in sorted(arcs, key=lambda arc: (arc.hold is not None, arc.entry))]

    def arcs(self) -> list[ArcId]:
        return [arc.id for arc in self._state.all_arcs()]

    def is_open(self, arc_id: ArcId) -> bool:
        return self._state.arc(arc_id) is not None

    def is_running(self, arc_id: ArcId) -> bool:
        return arc_id in self._state.running

    def count_of(self, client: ClientId) -> int:
        return len(self._state.arcs_of(client))

    def count_of_owner(self, owner: str) -> int:
        return len(self._state.arcs_of_owner(owner))

    def arcs_of_owners(self, owners: Collection[str]) -> list[ArcId]:
        return [arc.id for owner in owners for arc in self._state.arcs_of_owner(owner)]

    def place_of(self, arc_id: ArcId) -> Place | None:
        arc = self._state.arc(arc_id)
        return None if arc is None else arc.place

    def at_place(self, place: Place) -> list[ArcId]:
        """The ARCs of this place: several where clients claim the same after a takeover."""
        first = self._state.at_place(place)
        others = [arc.id for arc in self._state.held_back.values() if arc.place == place and arc is not first]
        return others if first is None else [first.id, *others]

    def could_have_issued(self, place: Place) -> bool:
        """Return True unless `place` is of this term and has not been given out yet."""
        return place.term != self.term or place.arrival <= self._arrivals

    def as_events(
        self, term: Term, limit: int | None = None, *, without: Container[str] = ()
    ) -> tuple[list[model.Event], model.LeadTaken]:
        """The events that bring another core to this state, in `term`: with the best-ranked `limit` of the queue (None:
        all), and `without` these bookings."""
        state = self._state
        joined: list[model.Event] = [
            model.RcJoined(rc.name, rc.sharable, rc.host, rc.begin_within, rc.unwell)
            if rc.present
            else model.RcLost(rc.name, why=rc.absence)
            for rc in state.rcs.values()
            if rc.present or rc.absence
        ]
        recovered_holds = tuple(
            model.RecoveredHold(
                arc.request,
                arc.place,
                arc.hold.grant,
                arc.hold.start,
                arc.hold.end,
                arc.bound,
                arc.vouched,
                arc.hold.protected_from,
                runtime=arc.hold.runtime,
            )
            for arc in state.running.values()
            if arc.hold is not None
        )
        joined += [Booked(claim.booking) for name, claim in state.claims.items() if name not in without]
        queued = (*state.queued.values(), *state.held_back.values()) if limit is None else self._best_ranked(limit)
        waiting = tuple(
            model.Requested(
                arc.request, arc.place, arc.since, model.WaitSoFar(arc.patience, arc.lost, arc.unproven_wait)
            )
            for arc in queued
        )
        return joined, model.LeadTaken(term, recovered_holds, waiting, self.charged(), patience=self.patience)

    def slots(self, wanted: Booking, until: Ns, limit: int, *, bookings_only: bool = False) -> SlotsFound:
        """The first `limit` times, from the start of `wanted` to `until`, at which this booking could be kept; not for
        maintenance. `bookings_only` ignores holds and queue."""
        arc = self._calendar.stand_in(wanted)
        return slots(self._state, wanted, arc, until, limit, bookings_only=bookings_only)

    def likely_slot(self, wanted: Booking, until: Ns, runtimes: RuntimeEstimator) -> Ns | None:
        """An estimate of its start if holds end when they usually do. It reserves nothing."""
        now, running = self._state.now, self._state.running.values()
        ends = {arc.id: runtimes.end(arc.request, arc.hold, now) for arc in running if arc.hold is not None}
        likely = {arc: end for arc, end in ends.items() if end is not None}
        found = slots(self._state, wanted, self._calendar.stand_in(wanted), until, 1, likely=likely).found
        return found[0].start if found else None

    def ask_votes(self, unknown: Iterable[tuple[Rc, HolderSet]], wanted: Booking | None = None) -> list[model.Propose]:
        """Proposals for unknown votes on bookings; `wanted`: a booking not made yet."""
        newcomer = None if wanted is None else self._calendar.stand_in(wanted)
        proposals = []
        for rc, holders in unknown:
            if (number := self._votes.propose(rc.name, holders, self._state.now)) is not None:
                known = [
                    self._state.voter(holder) or self._calendar.placeholder_in_conflict(holder)
                    for holder in sorted(holders)
                ]
                arcs = [arc or newcomer for arc in known]
                params = {arc.id: self._state.params(arc, rc) for arc in arcs if arc is not None}
                proposals.append(model.Propose(number, rc.name, params))
        return proposals

    def booking(self, name: str) -> BookingStatus | None:
        if (claim := self._state.claims.get(name)) is None:
            return None
        bound = claim.booking.bound if claim.arc.hold is None else claim.arc.bound
        maintained = tuple(rc.name for rc in self._state.rcs_in(claim.kept)) if claim.booking.maintenance else ()
        return BookingStatus(claim.booking, claim.arc.id if claim.is_taken else None, bound, maintained)

    def drained(self) -> frozenset[HostName]:
        """The hosts in maintenance now."""
        if not self._state.maintenance:
            return NO_HOSTS
        begun = (claim.booking for claim in self._state.maintenance.values() if claim.date <= self._state.now)
        return frozenset().union(*(booking.hosts for booking in begun))

    def charged(self) -> dict[str, float]:
        return self._state.charged()

    @property
    def patience(self) -> Ns:
        return self._state.patience if self._state.adaptive else 0

    def charged_in_all(self) -> dict[str, float]:
        return {} if self._state.shares is None else self._state.shares.totals()

    def bookings(self) -> list[tuple[Booking, ArcId | None]]:
        return [(claim.booking, claim.arc.id if claim.is_taken else None) for claim in self._state.claims.values()]

    def expects_yes(self, rc: RcName, holders: HolderSet) -> bool:
        """Return True if an RC would accept these holders, or its vote is unknown."""
        answer = self._votes.known(rc, holders)
        return answer is None or answer.accept

    def _arc_status(self, arc: Arc) -> ArcStatus:
        reason, ahead = arc.reason, self._state.index.ahead(arc) if arc.hold is None else None
        if arc.state is ArcState.WATCHING:
            reason = reason_of_now(self._state, arc) or AdmissionCheck(self._state, arc).refusal() or reason
        known = arc.request, arc.place, arc.hold, arc.needs, arc.bound, arc.since, arc.preemptions
        return ArcStatus(*known, ahead, reason, arc.reason, arc.vouched)

    def _apply(self, event: model.Event) -> None:
        match event:
            case model.Requested():
                self._enter_request(event)
            case model.Cancelled(arc, by):
                self._end_request(arc, Outcome.CANCELLED, Reason(ReasonCode.CANCELLED, detail=by))
            case model.Released(arc, by):
                self._end_request(arc, Outcome.RELEASED, Reason(ReasonCode.RELEASED, detail=by))
            case model.Vote(proposal, accept, reason):
                self._votes.answer(proposal, accept=accept, reason=reason)
            case model.VoteOverdue(proposal):
                self._votes.overdue(proposal, self._state.now)
            case model.RcJoined(rc, sharable, host, begin_within, unwell):
                if self._state.rc(rc).present:
                    self._lose_rc(rc, "it restarted")
                self._state.set_begin_within(rc, begin_within)
                self._state.join(rc, sharable=sharable, host=host)
                self._state.set_unwell(rc, unwell)
                self._calendar.rc_joined(self._state.rc(rc))
                self._state.readmit(rc)
            case model.RcUnwell(rc, why):
                self._state.set_unwell(rc, why)
            case model.RcReported(rc, ended, rules_changed):
                for arc in ended:
                    if arc in self._state.rc(rc).holders:
                        self._end_hold(self._state.running[arc], Outcome.LOST, Reason(ReasonCode.RC_ENDED, (rc,)))
                if rules_changed:
                    self._votes.forget_rc(rc)
            case model.RcBegins():
                self._note_begins(event)
            case model.RcLost(rc, reason, why):
                self._lose_rc(rc, why or reason)
                self._state.rc(rc).absence = why
            case model.ClientLost(client, reason):
                for lost in self.arcs_of(client):
                    self._end_request(lost, Outcome.CLIENT_LOST, Reason(ReasonCode.CLIENT_LOST, detail=reason))
            case model.PlaceShown(arc, place):
                self._show_place(arc, place)
            case model.Unconfirmed(arc, grant, rcs):
                self._end_unconfirmed(arc, grant, rcs)
            case model.Reachable(arc):
                if (held_back := self._state.held_back.get(arc)) is not None:
                    self._state.consider_again(held_back)
            case model.HandedOver(arc, to, renamed):
                self._hand_over(arc, to, renamed)
            case model.LeadTaken():
                self._take_lead(event)
            case model.Adopted(held):
                self._adopt(held)
            case Dates():
                self._calendar.set_dates(event)
            case model.Vouched():
                self._vouch(event)
            case Booked(booking, tentative):
                self._calendar.book(booking, tentative=tentative)
            case Unbooked(booking, at_present):
                self._calendar.unbook(booking, at_present=at_present)
            case Redated(booking, start):
                self._calendar.redate(booking, start)
            case model.Tick():
                pass

    def _enter_request(self, requested: model.Requested, *, alone: bool = False) -> None:
        """`alone`: the only event of this instant."""
        if self._state.arc(requested.request.arc) is not None:
            return
        arc = self._new_arc(requested.request, requested.place)
        if alone and requested.since is None and not requested.request.booking and self._state.is_free(arc):
            # Any strategy would start it; this saves queueing it first.
            self._state.enter(arc)
            self.start(arc)
            return
        since = self._state.now if requested.since is None else min(requested.since, self._state.now)
        arc.unproven_wait = self._state.now - since
        if requested.past is not None:
            arc.patience, arc.lost, arc.unproven_wait = requested.past
        self._state.enqueue(arc, since)
        self._calendar.take_up(requested.request.booking, arc)

    def _new_arc(self, request: model.ArcRequest, place: Place | None) -> Arc:
        if place is None:
            self._arrivals += 1
            place = Place(self.term, self._arrivals)
        elif place.term == self.term:
            self._arrivals = max(self._arrivals, place.arrival)
        return self._state.new_arc(request, place)

    def _end_request(self, arc_id: ArcId, outcome: Outcome, reason: Reason) -> None:
        if (arc := self._state.arc(arc_id)) is None:
            return
        if arc.hold is not None:
            if outcome is Outcome.RELEASED and arc.past_min_runtime(self._state.now):
                outcome = Outcome.COMPLETED
            self._end_hold(arc, outcome, reason, requeue=False)
            return
        self._state.dequeue(arc)
        self._forget(arc)
        self._effects.append(model.Dropped(arc.id, arc.request.client, outcome, reason))
        self._calendar.give_up(arc, outcome, had_it=False)

    def _lose_rc(self, name: str, reason: str) -> None:
        """End each hold of a lost RC at all its RCs, and queue the ARC at its place."""
        rc = self._state.rc(name)
        for arc in list(rc.holders.values()):
            self._end_hold(arc, Outcome.LOST, Reason(ReasonCode.RC_LOST, (name,), detail=reason))
        self._state.leave(name)
        self._votes.forget_rc(name)
        self._calendar.rc_lost(rc)

    def _show_place(self, arc_id: ArcId, place: Place) -> None:
        arc = self._state.arc(arc_id)
        if arc is not None and arc.hold is None and place < arc.place:
            held_back = arc.held_back
            self._state.dequeue(arc)
            self._state.leave_place(arc)
            arc.place = place
            arc.take(arc.request)
            self._state.enqueue(arc, arc.since)
            if held_back is not None:
                self._state.hold_back(arc, *held_back)

    def _end_unconfirmed(self, arc_id: ArcId, grant: Grant, rcs: tuple[RcName, ...]) -> None:
        """End the hold with this grant. Its ARC keeps its place and is held back, longer each time in a row."""
        arc = self._state.running.get(arc_id)
        if arc is None or arc.hold is None or arc.hold.grant != grant:
            return
        reason, times = of_rcs(ReasonCode.UNCONFIRMED, rcs), arc.unconfirmed
        self._end_hold(arc, Outcome.LOST, reason)
        if arc.id in self._state.queued:
            arc.unconfirmed = times + 1
            self._state.hold_back(
                arc, self._state.now + min(model.HOLD_BACK << min(times, 8), model.MAX_HOLD_BACK), rcs
            )
            self.wait(arc, reason)

    def _hand_over(self, arc_id: ArcId, to: str, renamed: ArcId) -> None:
        arc, existing = self._state.arc(arc_id), self._state.arc(renamed)
        if arc is None or arc is existing:
            return
        reason = Reason(ReasonCode.HANDED_OVER, detail=to)
        if existing is not None:
            # After a change of RCM both clients may have reported the ARC.
            same_needs = existing.request.needs == arc.request.needs
            if existing.place != arc.place and (existing.hold is None or not same_needs):
                return
            if existing.hold is not None or arc.hold is None:
                self._end_request(arc_id, Outcome.HANDED_OVER, reason)
                return
            self._remove(existing)
        if arc.hold is None:
            self._effects.append(model.Dropped(arc.id, arc.request.client, Outcome.HANDED_OVER, reason))
        else:
            self._effects.append(self._revocation(arc, arc.hold, Outcome.HANDED_OVER, reason, requeued=False))
        for rc in self._state.possible_sharables(arc):
            self._votes.rename_arc(rc.name, arc.id, renamed)
        self._state.hand_over(arc, to, renamed)
        if arc.hold is not None:
            arc.hold = replace(arc.hold, grant=Grant(self.term, self.number()))
            self._effects.append(self._granted(arc, arc.hold))
        elif arc.reason:
            self._effects.append(model.Queued(arc.id, to, arc.reason))

    def _take_lead(self, lead: model.LeadTaken) -> None:
        if lead.term <= self.term:
            raise ValueError(f"the new term {lead.term} is not above {self.term}")
        self.term, self.seq, self._arrivals = lead.term, 0, 0
        if self._state.shares is not None:
            self._state.shares.restore(lead.charged)
        self._calendar.certain_from = lead.dates_from
        if lead.patience:
            self._state.runtimes.restore(lead.patience)
        # Where two holds claim one exclusive RC, the newest grant counts.
        for held in sorted(lead.recovered_holds, key=lambda held: held.grant, reverse=True):
            if self._state.arc(held.request.arc) is None:
                self._recover_hold(held)
        self._expire()
        for requested in lead.waiting:
            self._enter_request(requested)

    def _adopt(self, held: model.RecoveredHold) -> None:
        known = self._state.arc(held.request.arc)
        # A grant of this term that is unknown here has ended.
        over = held.grant in self._ended_grants or held.grant.term == self.term
        if over or (known is not None and known.hold is not None):
            return
        if known is not None:
            self._remove(known)
            held = replace(held, place=min(known.place, held.place or known.place))
        arc = self._recover_hold(held)
        if known is not None and arc.hold is None and self._state.arc(arc.id) is arc:
            # Queue its client's own request: the RCs' report lacks parameters of absent RCs.
            self._remove(arc)
            arc = self._queue_again(known.request, held.place, vouched=known.vouched)
        if arc.hold is not None and (arc.request.keep or not arc.past_min_runtime(self._state.now)):
            self._effects.append(self._granted(arc, arc.hold))
        self._expire()

    def _vouch(self, vouched: model.Vouched) -> None:
        """Replace a request reported by RCs with its client's own, and re-enter its hold."""
        arc = self._state.arc(vouched.request.arc)
        if arc is not None and arc.hold is not None and not arc.vouched and vouched.bound is None:
            self._end_hold(arc, Outcome.LOST, of_rcs(ReasonCode.SUPERSEDED, sorted(arc.needs)[:1]))
            arc = self._state.arc(vouched.request.arc)
        if arc is None or arc.vouched:
            return
        place, hold = vouched.place or arc.place, arc.hold
        if hold is None or vouched.bound is None:
            self._remove(arc)
            self._queue_again(vouched.request, place)
            return
        held = model.RecoveredHold(
            vouched.request,
            place,
            hold.grant,
            hold.start,
            hold.end,
            vouched.bound,
            protected_from=hold.protected_from,
            waits={**arc.waits},
            runtime=hold.runtime,
        )
        self._state.stop(arc)
        self._forget(arc)
        arc = self._recover_hold(held)
        if arc.hold is not None:
            self._effects.append(self._granted(arc, arc.hold))

    def _remove(self, arc: Arc) -> None:
        self._state.dequeue(arc)
        self._forget(arc)
        self._calendar.leave(arc)

    def _queue_again(self, request: model.ArcRequest, place: Place | None, *, vouched: bool = True) -> Arc:
        arc = self._new_arc(request, place)
        arc.vouched = vouched
        self._state.enqueue(arc, self._state.now)
        self._calendar.take_up(request.booking, arc)
        return arc

    def _recover_hold(self, held: model.RecoveredHold) -> Arc:
        """Continue a hold of an earlier term if all its RCs are present and free and no other ARC runs at its place.
        Otherwise end it, and queue its ARC unless its time is over."""
        arc = self._new_arc(held.request, held.place)
        arc.vouched = held.vouched
        if arc.patterns:
            self._state.bind(arc, held.bound)
        hold = self._state.hold(arc, held.grant, held.start, held.end, held.protected_from, held.runtime)
        arc.waits = {**held.waits}
        if (waits := max(filter(None, held.waits.values()), default=None)) is not None:
            hold = replace(hold, waits=waits, last=self._state.last(arc, waits, held.end))
            arc.lost = 0  # earlier losses are unknown: only the previous leader knew the time of the grant
        absent = [rc.name for rc in self._state.rcs_in(arc.mask & ~self._state.present)]
        taken = [rc.name for rc in self._state.rcs_in(arc.mask & self._state.busy)]
        other = self._state.at_place(arc.place)
        broken: Reason | None = None
        if absent or taken:
            broken = Reason(ReasonCode.RC_LOST if absent else ReasonCode.SUPERSEDED, (*absent, *taken)[:1])
        elif other is not None and other.hold is not None:
            broken = _claimed_by(other)
        elif other is not None:
            self._state.put_before(arc, other)
        over = held.end <= self._state.now or (broken is not None and self._state.is_barred(arc))
        if not over or not broken:
            self._state.enqueue(arc, self._state.now)
        if broken:
            outcome = Outcome.COMPLETED if over and not arc.request.keep else Outcome.LOST
            self._effects.append(self._revocation(arc, hold, outcome, broken, requeued=not over))
        else:
            self._state.start(arc, hold)
        if self._state.arc(arc.id) is arc:
            self._calendar.take_up(held.request.booking, arc)
        return arc

    def _expire(self) -> None:
        for arc in self._state.expired_arcs():
            if not arc.runs:
                continue  # its devices have not begun; its end is set once they have
            if arc.hold is not None and arc.hold.last is not None and arc.hold.last <= self._state.now:
                self._end_hold(arc, Outcome.COMPLETED, Reason(ReasonCode.LIMIT), requeue=False)
            elif arc.request.keep:
                self._state.min_runtime_over(arc)
            else:
                self._end_hold(arc, Outcome.COMPLETED, Reason(ReasonCode.EXPIRED), requeue=False)

    def _begin_maintenance(self) -> None:
        for claim, rc, arc in self._calendar.in_maintenance():
            if arc.hold is not None:
                outcome = Outcome.COMPLETED if arc.past_min_runtime(self._state.now) else Outcome.PREEMPTED
                party = claim.booking.party._replace(until=claim.booking.until)
                self._end_hold(arc, outcome, Reason(ReasonCode.MAINTENANCE, (rc.name,), (party,)))

    def start(self, arc: Arc) -> None:
        grant = Grant(self.term, self.number())
        now, state = self._state.now, self._state
        runtime, begun = self._protected_runtime(arc), now + arc.begin_within if self._assume_latest_begin else now
        hold = state.hold(arc, grant, now, arc.ends_after(now, begun, runtime), runtime=runtime)
        if not arc.preemptions:
            state.runtimes.count(arc.owner, arc.request.min_runtime)
        waited = 0 if arc.state is ArcState.NEW else now - arc.since
        self._state.start(arc, hold)
        self._effects.append(self._granted(arc, hold, waited))

    def _protected_runtime(self, arc: Arc) -> Ns | None:
        """The minimum runtime of a hold that starts now (`ArcRequest.until_done`); None: its request's."""
        request, begun = arc.request, self._state.now + arc.begin_within
        if request.until_done <= request.min_runtime or not request.keep or arc.claim is not None:
            return None
        free = Reservations(self._state).free_until(arc, begun + request.until_done) - begun
        return free if free > request.min_runtime else None

    def _note_begins(self, reported: model.RcBegins) -> None:
        """Note when the RC begins its holds: the runtime of a hold counts from the begin of its last RC."""
        self._state.set_begin_within(reported.rc, reported.begin_within)
        for arc in list(self._state.rc(reported.rc).holders.values()):
            if arc.hold is None or arc.hold.grant not in reported.holds:
                continue
            until, waits = reported.holds[arc.hold.grant], reported.rc in arc.waits
            if (waits and arc.waits[reported.rc] is None) or (until is None and not waits):
                continue  # a begin is counted once
            arc.waits[reported.rc] = until
            self._retime_hold(arc, arc.hold)

    def _retime_hold(self, arc: Arc, hold: Hold) -> None:
        """Set the end of a hold by the time at which its RCs begin."""
        now, waits = self._state.now, arc.waits_until
        if waits == hold.waits or (waits is not None and abs(waits - (hold.waits or 0)) < model.WAITS_SLACK):
            return
        begun = now if waits is None else max(now, waits)
        end = arc.ends_after(hold.start, begun, hold.runtime)
        last = self._state.last(arc, begun, end)
        self._state.retime(arc, replace(hold, end=end, last=last, waits=waits))
        rcs = tuple(sorted(arc.needs))
        self._effects.append(model.HoldTimed(arc.id, arc.request.client, hold.grant, rcs, waits))

    def preempt(self, arc: Arc, by: Arc) -> bool:
        done = arc.past_min_runtime(self._state.now)
        if arc.hold is not None and arc.owner != by.owner:
            arc.lost += self._state.now - arc.hold.start
        reason = Reason(ReasonCode.DISPLACED if done else ReasonCode.PREEMPTED, by=(by.party,))
        self._end_hold(arc, Outcome.COMPLETED if done else Outcome.PREEMPTED, reason)
        return arc.id in self._state.queued

    def wait(self, arc: Arc, reason: Reason, *, settled: bool = True) -> None:
        # While proposals are open the earlier reason stays, to avoid flapping.
        if reason == arc.reason or (not settled and arc.reason):
            return
        for why in (arc.reason, reason):
            if why is not None and why.code is ReasonCode.VETOED:
                self._state.index.contended |= self._state.mask(why.rcs)
        arc.reason = reason
        self._effects.append(model.Queued(arc.id, arc.request.client, reason, settled))

    def propose(self, rc: Rc, holders: HolderSet) -> bool:
        proposals = self.ask_votes([(rc, holders)])
        self._effects += proposals
        return bool(proposals)

    def run_again(self) -> None:
        self._run_again = True

    def _end_hold(self, arc: Arc, outcome: Outcome, reason: Reason, *, requeue: bool = True) -> None:
        """End a hold. Its ARC is not queued again past its minimum runtime, or with an RC barred to its owner."""
        requeue = requeue and not arc.past_min_runtime(self._state.now) and not self._state.is_barred(arc)
        hold = self._state.stop(arc)
        self._effects.append(self._revocation(arc, hold, outcome, reason, requeued=requeue))
        arc.unconfirmed = 0
        if requeue:
            preempted = outcome is Outcome.PREEMPTED
            arc.preemptions += preempted
            arc.unproven_wait = arc.unproven_wait if preempted else 0
            # With `adaptive`, the wait before a preempted hold still counts.
            self._state.enqueue(arc, self._state.now - (arc.waited if preempted and self._state.adaptive else 0))
        else:
            self._forget(arc)
            self._calendar.give_up(arc, outcome, had_it=True)

    def _forget(self, arc: Arc) -> None:
        self._state.forget(arc)
        for rc in self._state.possible_sharables(arc):
            self._votes.forget_arc(rc.name, arc.id)

    def number(self) -> int:
        self.seq += 1
        return self.seq

    def _granted(self, arc: Arc, hold: Hold, waited: Ns | None = None) -> model.Granted:
        end = None if arc.request.keep else hold.end
        rcs = tuple(sorted(arc.needs))
        return model.Granted(arc.id, arc.request.client, hold.grant, rcs, hold.start, end, waited)

    def _revocation(self, arc: Arc, hold: Hold, outcome: Outcome, reason: Reason, *, requeued: bool) -> model.HoldEnded:
        self.number()
        if hold.grant.term != self.term:
            self._ended_grants.add(hold.grant)
        rcs = tuple(sorted(arc.needs))
        by = reason.by[0].arc if reason.by and reason.code is not ReasonCode.MAINTENANCE else None
        return model.HoldEnded(arc.id, arc.request.client, hold.grant, rcs, outcome, reason, requeued, by)

    def next_change(self) -> Ns | None:
        """When the state next changes by time alone, as when a hold ends; the order of fair shares aside."""
        calendar, held_back = self._calendar, self._state.held_back.values()
        dates = (self._state.next_end(), self._state.dates.next_change(), calendar.next_start, calendar.next_question)
        ends = [end for end in (*dates, self._state.next_starving()) if end is not None]
        return min(ends + [arc.held_back[0] for arc in held_back if arc.held_back], default=None)

    def next_order(self) -> Ns | None:
        shares = self._state.shares
        return None if shares is None or not self._state.queued else shares.next_order()

    def _set_wake(self) -> None:
        at = self.next_change()
        if self._state.queued:
            soon = self._state.now + model.QUANTUM
            soon = min(soon, self.next_order() or soon)
            at = soon if at is None else min(soon, at)
        if self._run_again:
            at = self._state.now
        if at != self._wake or self._run_again:
            self._wake = at
            self._effects.append(model.WakeAt(at))


def _claimed_by(other: Arc) -> Reason:
    return Reason(ReasonCode.CLAIMED, detail=other.request.client)
