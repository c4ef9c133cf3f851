"""The core of the RCM: events in, effects out, time given.

Every decision of the RCM is made here and nowhere else; there is no clock, thread, socket or log inside.
The RCM service, `zscout replay`, the study and the fault simulator drive this one class:

    effects = core.handle(now, Asked(request), ...)

A batch of events is one instant: holds whose time is over end first, then the events are applied in the
order given, then one pass runs. The caller carries the effects out in their order and comes back with what
follows from them: votes, and a `Tick` at the latest when `WakeAt` says.
"""

from __future__ import annotations

from dataclasses import replace

from zscout.keyexpr import is_pattern
from zscout.scheduling import priority
from zscout.scheduling.effects import (
    Dropped,
    Effect,
    Granted,
    Outcome,
    Propose,
    Queued,
    Revoked,
    WakeAt,
)
from zscout.scheduling.ends import Ends
from zscout.scheduling.events import (
    Asked,
    Cancelled,
    ClientLost,
    Event,
    HandedOver,
    LeadTaken,
    RcJoined,
    RcLost,
    RcReported,
    Released,
    Standing,
    Tick,
    Vote,
    VoteOverdue,
    Waiting,
)
from zscout.scheduling.floor import Floor, check
from zscout.scheduling.model import (
    NO_TERM,
    QUANTUM,
    Arc,
    ArcId,
    Grant,
    Hold,
    Ns,
    Place,
    Rc,
    Request,
    Term,
)
from zscout.scheduling.policy import DEFAULT, Policy
from zscout.scheduling.priority import Strategy
from zscout.scheduling.votes import HolderSet, Votes


class Core:
    """All scheduling state of one fleet, and the rules by which it changes."""

    def __init__(self, strategy: Strategy = priority.run_pass, policy: Policy = DEFAULT) -> None:
        self.strategy, self.policy = strategy, policy
        self.floor = Floor(policy)
        self.votes = Votes()
        self.term: Term = NO_TERM
        self.seq = 0
        self._arrivals = 0
        self._now: Ns = 0
        self._cause = 0
        self._effects: list[Effect] = []
        self._ends = Ends(self.floor.running)
        self._wake: Ns | None = None
        self._again = False
        """Whether the strategy asked for another pass at once."""

    @property
    def batches(self) -> int:
        """How many batches of events were handled; effects name theirs in `cause`."""
        return self._cause

    def handle(self, now: Ns, *events: Event) -> list[Effect]:
        """Applies one instant's events and runs a pass. `now` must not go backwards."""
        if now < self._now:
            raise ValueError(f"time went backwards: {now} after {self._now}")
        self._now = now
        self._cause += 1
        self._effects = []
        self._again = False
        self._expire()
        for event in events:
            self._apply(event)
        if self.floor.queued:
            self.strategy(self.floor, self.votes, now, self)
        self._set_wake()
        return self._effects

    # Events

    def _apply(self, event: Event) -> None:
        match event:
            case Asked(request, place, since):
                self._ask(request, place, since)
            case Cancelled(arc, by):
                self._give_up(arc, Outcome.CANCELLED, f"cancelled by {by}")
            case Released(arc, by):
                self._give_up(arc, Outcome.RELEASED, f"released by {by}")
            case Vote(proposal, accept, reason):
                self.votes.answer(proposal, accept=accept, reason=reason)
            case VoteOverdue(proposal):
                self.votes.overdue(proposal, self._now)
            case RcJoined(rc, sharable):
                if self.floor.rc(rc).present:
                    self._lose(rc, "it started anew")
                self.floor.join(rc, sharable=sharable)
            case RcReported(rc, ended, rules_changed):
                for arc in ended:
                    if arc in self.floor.rc(rc).holders:
                        self._end(self.floor.running[arc], Outcome.LOST, f"{rc} ended the hold")
                if rules_changed:
                    self.votes.forget_rc(rc)
            case RcLost(rc, reason):
                self._lose(rc, reason)
            case ClientLost(client, reason):
                for lost in self.arcs_of(client):
                    self._give_up(lost.id, Outcome.CLIENT_LOST, reason)
            case HandedOver(arc, to, renamed):
                self._hand_over(arc, to, renamed)
            case LeadTaken(term, standing, waiting):
                self._lead(term, standing, waiting)
            case Tick():
                pass

    def arcs_of(self, client: str) -> list[Arc]:
        """The ARCs of one client, those that wait first: so none of them profits from the others' end."""
        return self.floor.arcs_of(client)

    def reason(self, arc: Arc) -> str:
        """Why a queued ARC waits, with all that is in its way as of the last batch; `arc.reason` is what was
        told last. For who asks: nobody is told each time that one holder follows another far ahead of him."""
        if arc.watched is None:
            return arc.reason
        visit = priority.Visit(self.floor, self.votes, self._now, arc)
        return visit.obstacle(0) or visit.refusal() or arc.reason

    def given(self, place: Place) -> bool:
        """Whether `place` may have been given; of earlier terms the core does not know."""
        return place.term != self.term or place.arrival <= self._arrivals

    def _ask(self, request: Request, place: Place | None, since: Ns | None) -> None:
        if self.floor.arc(request.arc) is not None:
            return
        since = self._now if since is None else min(since, self._now)
        self.floor.enqueue(self._new_arc(request, place), since)

    def _new_arc(self, request: Request, place: Place | None) -> Arc:
        if place is None:
            self._arrivals += 1
            place = Place(self.term, self._arrivals)
        elif place.term == self.term:
            self._arrivals = max(self._arrivals, place.arrival)
        band = self.policy.band(request.priority)
        slots = tuple(filter(is_pattern, request.needs))
        named = self.floor.mask([need for need in request.needs if need not in slots])
        arc = Arc(request, place, named, band=band, slots=slots, named=named)
        if slots:
            self.floor.unbind(arc)
        return arc

    def _give_up(self, arc_id: ArcId, outcome: Outcome, reason: str) -> None:
        arc = self.floor.arc(arc_id)
        if arc is None:
            return
        if arc.hold is not None:
            if outcome is Outcome.RELEASED and arc.overstays(self._now):
                outcome = Outcome.COMPLETED
            self._end(arc, outcome, reason, requeue=False)
            return
        self.floor.drop(arc)
        self._forget(arc)
        self._effects.append(Dropped(self._cause, arc.id, arc.request.client, outcome, reason))

    def _lose(self, name: str, reason: str) -> None:
        """An RC is gone: each gang it was part of ends as a whole and is queued with its place."""
        rc = self.floor.rc(name)
        for arc in list(rc.holders.values()):
            self._end(arc, Outcome.LOST, f"{name} was lost: {reason}")
        self.floor.leave(name)
        self.votes.forget_rc(name)

    def _hand_over(self, arc_id: ArcId, to: str, renamed: ArcId) -> None:
        arc, twin = self.floor.arc(arc_id), self.floor.arc(renamed)
        if arc is None or arc is twin:
            return
        reason = f"handed over to {to}"
        if twin is not None:
            # Where a change of RCM hid the outcome, both clients may have told of the one ARC.
            if twin.place != arc.place:
                return
            if twin.hold is not None or arc.hold is None:
                self._give_up(arc_id, Outcome.HANDED_OVER, reason)
                return
            self.floor.drop(twin)
            self._forget(twin)
        if arc.hold is None:
            self._effects.append(
                Dropped(self._cause, arc.id, arc.request.client, Outcome.HANDED_OVER, reason)
            )
        else:
            old = self._revocation(arc, arc.hold, Outcome.HANDED_OVER, reason, requeued=False)
            self._effects.append(old)
        for rc in self.floor.of(self.floor.everywhere(arc) & self.floor.sharable):
            self.votes.rename_arc(rc.name, arc.id, renamed)
        self.floor.hand_over(arc, to, renamed)
        if arc.hold is not None:
            arc.hold = replace(arc.hold, grant=self._next_grant())
            if arc.hold.end > self._now:
                self._ends.note(arc, arc.hold)
            self._effects.append(self._granted(arc, arc.hold))
        elif arc.reason:
            self._effects.append(Queued(self._cause, arc.id, to, arc.reason))

    def _lead(self, term: Term, standing: tuple[Standing, ...], waiting: tuple[Waiting, ...]) -> None:
        if term <= self.term:
            raise ValueError(f"the new term {term} is not above {self.term}")
        self.term, self.seq, self._arrivals = term, 0, 0
        # The newest grant is the truth where two claim one exclusive RC.
        for held in sorted(standing, key=lambda held: held.grant, reverse=True):
            if self.floor.arc(held.request.arc) is not None:
                continue
            arc = self._new_arc(held.request, held.place)
            if arc.slots:
                self.floor.bind(arc, held.bound)
            hold = Hold(held.grant, held.start, held.end, self.policy.shield(owed=False))
            absent = [rc.name for rc in self.floor.of(arc.mask & ~self.floor.present)]
            taken = [rc.name for rc in self.floor.of(arc.mask & self.floor.busy)]
            over = held.end <= self._now
            if not over or not (absent or taken):
                self.floor.enqueue(arc, self._now)
            if absent or taken:
                reason = f"{absent[0]} was lost" if absent else f"{taken[0]} has a newer holder"
                outcome = Outcome.COMPLETED if over and not arc.request.keep else Outcome.LOST
                self._effects.append(self._revocation(arc, hold, outcome, reason, requeued=not over))
            else:
                self._take(arc, hold)
        self._expire()
        for one in waiting:
            self._ask(*one)

    def _expire(self) -> None:
        for arc in self._ends.over(self._now):
            if arc.request.keep:
                self.floor.overstayed(arc)
            else:
                self._end(arc, Outcome.COMPLETED, "its minimum runtime is over", requeue=False)

    # What a strategy may do (priority.Actions)

    def start(self, arc: Arc) -> None:
        grant = self._next_grant()
        shield = self.policy.shield(owed=arc.owed)
        hold = Hold(grant, self._now, self._now + arc.request.min_runtime, shield)
        self._take(arc, hold)
        self._effects.append(self._granted(arc, hold))

    def displace(self, arc: Arc, by: Arc) -> bool:
        done = arc.overstays(self._now)
        outcome = Outcome.COMPLETED if done else Outcome.PREEMPTED
        who = f"{by.name}, priority {by.request.priority}"
        reason = f"its minimum runtime is over and {who}, needs its RCs" if done else f"preempted by {who}"
        self._end(arc, outcome, reason, by=by.id)
        return arc.id in self.floor.queued

    def wait(self, arc: Arc, reason: str, *, settled: bool = True) -> None:
        # A reason given before stands while votes are out: it would change back and forth otherwise.
        if reason == arc.reason or (not settled and arc.reason):
            return
        arc.reason = reason
        self._effects.append(Queued(self._cause, arc.id, arc.request.client, reason, settled))

    def propose(self, rc: Rc, holders: HolderSet) -> None:
        number = self.votes.open_question(rc.name, holders, self._now)
        if number is None:
            return
        arcs = (self.floor.arc(holder) for holder in sorted(holders))
        params = {arc.id: self.floor.params(arc, rc) for arc in arcs if arc is not None}
        self._effects.append(Propose(self._cause, number, rc.name, params))

    def again(self) -> None:
        self._again = True

    # Holds

    def _take(self, arc: Arc, hold: Hold) -> None:
        self.floor.start(arc, hold, self._now)
        self._ends.note(arc, hold)

    def _end(
        self, arc: Arc, outcome: Outcome, reason: str, *, by: ArcId | None = None, requeue: bool = True
    ) -> None:
        """Ends a hold. What has had its minimum runtime is owed nothing and is not queued again."""
        requeue = requeue and not arc.overstays(self._now)
        hold = self.floor.stop(arc)
        self._effects.append(self._revocation(arc, hold, outcome, reason, requeued=requeue, by=by))
        if requeue:
            arc.preemptions += outcome is Outcome.PREEMPTED
            self.floor.enqueue(arc, self._now)
        else:
            self._forget(arc)

    def _forget(self, arc: Arc) -> None:
        self.floor.forget(arc)
        for rc in self.floor.of(self.floor.everywhere(arc) & self.floor.sharable):
            self.votes.forget_arc(rc.name, arc.id)

    def number(self) -> int:
        """The next number of this term. Grants take theirs here, and so does all else that is published."""
        self.seq += 1
        return self.seq

    def _next_grant(self) -> Grant:
        return Grant(self.term, self.number())

    def _granted(self, arc: Arc, hold: Hold) -> Granted:
        end = None if arc.request.keep else hold.end
        rcs = tuple(sorted(arc.needs))
        return Granted(self._cause, arc.id, arc.request.client, hold.grant, rcs, hold.start, end)

    def _revocation(
        self, arc: Arc, hold: Hold, outcome: Outcome, reason: str, *, requeued: bool, by: ArcId | None = None
    ) -> Revoked:
        self.number()
        rcs = tuple(sorted(arc.needs))
        client = arc.request.client
        return Revoked(self._cause, arc.id, client, hold.grant, rcs, outcome, reason, requeued, by)

    def _set_wake(self) -> None:
        at = self._ends.next()
        if self.floor.queued:
            at = min(self._now + QUANTUM, at) if at is not None else self._now + QUANTUM
        if self._again:
            at = self._now
        if at != self._wake or self._again:
            self._wake = at
            self._effects.append(WakeAt(self._cause, at))

    def validate(self) -> None:
        """Checks all invariants; for tests and simulators, after every event."""
        self.floor.validate()
        for arc in self.floor.running.values():
            check(
                (arc.hold is not None and arc.hold.end - self._now >= 0) or arc.request.keep,
                f"{arc.id} overran",
            )
            check(not arc.reason, f"{arc.id} runs and has a reason to wait")
        for arc in self.floor.queued.values():
            check(bool(arc.reason), f"{arc.id} waits without a reason")
        for _, rc, holders in self.votes.out():
            check(self.floor.rc(rc).present, f"a proposal is out at {rc}, which is absent")
            check(all(self.floor.arc(arc) for arc in holders), f"a proposal at {rc} names an ARC that ended")
