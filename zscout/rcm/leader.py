"""The leading RCM as one pure step: stimuli in, an Outbox out. No clock, task, logger or mesh.

A step is one instant of the core: operations that arrive together, or one other stimulus. Its Outbox comes in parts:
grants are answered and published before the rest is computed. Stimuli that a step creates are queued before all others;
the last part has `more` set while stimuli are left."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

from msgspec.structs import replace

from zscout import messages
from zscout.config.fleet import Fleet
from zscout.keyexpr import BadName, Role
from zscout.messages import Refused
from zscout.rcm import steps
from zscout.rcm.admission import Admission
from zscout.rcm.booked import FleetBookings
from zscout.rcm.device_check import DeviceCheck
from zscout.rcm.operations import Operations
from zscout.rcm.places import request_id
from zscout.rcm.recovery import RecoveredState, listed_by, removed, vouched
from zscout.rcm.request_log import REMEMBERED, RequestLog, reason_info
from zscout.rcm.roster import Roster, beginnings, discrepancies
from zscout.rcm.state_view import holders_of
from zscout.scheduling import model
from zscout.scheduling.core import Core
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.types import SECOND, ArcId, ClientId, Ns, RcName

USAGE_PERIOD: Final[Ns] = 10 * SECOND
"""Between publications of usage per group and of patience: a leader that dies loses at most this much usage."""
PLACE_KEPT: Final[Mapping[model.Outcome, Ns]] = MappingProxyType(
    {model.Outcome.RELEASED: 0, model.Outcome.CANCELLED: 0, model.Outcome.CLIENT_LOST: 86_400 * SECOND}
)
"""The time for which a client may claim the place of an ARC that ended with this outcome; with others, REMEMBERED."""
CONTINUING: Final = frozenset({model.LeadTaken, model.Adopted, model.Vouched, model.HandedOver})
"""Events by which existing holds continue: they are published to the RCs before any client is notified."""


BOOKING_OPERATIONS: Final = (messages.Book, messages.Unbook, messages.FindSlots)


class _Instant(NamedTuple):
    """A decided instant, from which its publication and follow-up are made."""

    events: Sequence[model.Event]
    effects: Sequence[model.Effect]
    extra_rcs: Collection[RcName] | None
    """RCs to publish even if they did not change; None: publish only changes."""
    notified: Collection[ArcId]
    """ARCs whose grants were answered or notified already."""


class Leader:
    """The leader of one term."""

    def __init__(
        self,
        fleet: Fleet,
        core: Core,
        admission: Admission,
        roster: Roster,
        device_check: DeviceCheck,
        bookings: FleetBookings,
        runtimes: RuntimeEstimator | None,
    ) -> None:
        self._fleet, self.core, self.admission, self.roster = fleet, core, admission, roster
        self._bookings, self.term = bookings, admission.places.term
        self.registry = RequestLog(core, roster, admission.places, runtimes)
        self.operations = Operations(fleet, core, self.registry, roster, admission, device_check, bookings, runtimes)
        self._parts = roster, self.registry, self.operations, bookings
        """All parts with deadlines."""
        self.seq = 0
        """The number of the last publication."""
        self.published: Ns = 0
        """The time of the last publication or heartbeat."""
        self._usage_published: Ns = 0
        """The time of the last publication of usage per group."""
        self._last_seqs: dict[RcName, int] = {}
        """By RC: the number of the last publication with its holders."""
        self._recovered: dict[ClientId, set[ArcId]] = {}
        """By client: the ARCs that only RCs have reported."""
        self._queue: deque[steps.Stimulus] = deque()
        self._wake: Ns | None = None
        """The earliest deadline of all parts."""
        self._due_queued = False
        """True while a `Due` is among the stimuli."""
        self._core_wake: Ns | None = None
        self._now: Ns = 0
        self._out = steps.Outbox()

    def step(self, now: Ns, stimuli: Iterable[steps.Stimulus] = ()) -> Iterator[steps.Outbox]:
        """Yield this instant's Outbox in parts. Carry out each before the next; stop when no longer leading."""
        self._now, out = now, steps.Outbox()
        self._out = out
        self._bookings.at(now)
        self._queue.extend(stimuli)
        if self._wake is not None and self._wake <= now and not self._due_queued:
            self._due_queued = True
            self._queue.append(steps.Due.DEADLINES)
        if (events := self._next()) and (instant := self._grant(events)) is not None:
            if out.granted or out.grant_notices:
                yield out.take(steps.ANSWERS)
            self._publish_instant(instant)
            if out.publication is not None:
                yield out.take(steps.PUBLISHED)
            self._follow_up(instant)
        self._queue.extendleft(reversed(out.then))
        out.then = []
        times = [self._core_wake, *[part.next for part in self._parts]]
        out.wake = self._wake = min([at for at in times if at is not None], default=None)
        out.more = bool(self._queue)
        yield out

    def _next(self) -> list[model.Event]:
        operations, queue, out = self.operations, self._queue, self._out
        while queue and isinstance(asked := queue[0], steps.OperationAsked) and operations.can_join(asked):
            queue.popleft()
            out.merge(self.roster.client_active(self._now, str(asked.sender)))
            if isinstance(asked.operation, BOOKING_OPERATIONS):
                out.then.append(steps.BookingAsked(asked))
                return [model.Tick()]
            out.merge(operations.take(self._now, asked))
            if isinstance(asked.operation, (messages.HandOver, messages.Foresee)):
                break
        else:
            if queue and not operations.instant.touched and not out.at_once:
                return self._events(queue.popleft())
        return operations.events()

    def _events(self, work: steps.Stimulus) -> list[model.Event]:
        merge = self._out.merge
        match work:
            case steps.TokenSeen(token, alive):
                token_moved = self.roster.client_token if token.role == Role.CLIENT else self.roster.rc_token
                return merge(token_moved(self._now, token, alive=alive))
            case steps.Reported(state):
                return merge(self.roster.rc_state(self._now, state))
            case steps.QuestionAnswered(question, message, problem):
                return merge(self.roster.answered(self._now, question, message, problem))
            case steps.TokensFound(question, tokens):
                return merge(self.roster.seen(self._now, question, tokens))
            case steps.CoreEvents(events):
                return [*events]
            case steps.Shunned(token, until):
                return merge(self.roster.shun(self._now, token, until))
            case steps.Stalled(length, ended, fresh):
                self.roster.sight.note_stall(length, ended, fresh=fresh)
            case steps.BookingAsked(asked):
                return merge(self._bookings.operation(*asked))
            case steps.RetryBooking():
                return merge(self._bookings.retry(work))
            case steps.Kept(keep, why):
                return merge(self._bookings.kept(keep, why))
            case steps.Shared():
                return merge(self._bookings.shared())
            case steps.ClocksRead():
                return merge(self._bookings.set_clock(work))
            case steps.Due.BOOKINGS:
                self._due_queued = False
                return merge(self._bookings.tick())
            case steps.Reloaded():
                return self._reload()
            case steps.Lead(recovered):
                self._begin_term(recovered)
            case steps.Compare(state):
                return self._compare(state)
            case steps.Name(rc):
                self._publish([], self._names_in_a_row(rc))
            case steps.ClientListed(answer):
                return self._compare_listed(answer)
            case steps.ClientFound(number, there):
                merge(self.operations.new_client_found(self._now, number, there=there))
                return self.operations.events()
            case steps.Resume():
                self._out.then += self.operations.resume()
            case steps.Due.DEADLINES:
                return self._tick()
            case steps.Due.TIME:
                self._tick_core()
        return []

    def _names_in_a_row(self, rc: RcName) -> set[RcName]:
        rcs = {rc}
        while self._queue and isinstance(name := self._queue[0], steps.Name):
            rcs.add(name.rc)
            self._queue.popleft()
        return rcs

    def _tick(self) -> list[model.Event]:
        out, answers = self._out, self.operations.tick(self._now)
        events = out.merge(self.roster.tick(self._now))
        out.then.append(steps.Due.TIME)
        out.merge(answers)
        return events

    def _tick_core(self) -> None:
        due = self._bookings.next
        self._due_queued = due is not None and due <= self._now
        if self._due_queued:
            self._out.then.append(steps.Due.BOOKINGS)
        if self._core_wake is not None and self._core_wake <= self._now:
            self._decide([model.Tick()])
        self._out.merge(self.registry.tick(self._now))

    def _reload(self) -> list[model.Event]:
        """End the ARCs of clients that have lost their role."""
        self.core.policy = self.admission.authority.bound(self._fleet.scheduling)
        known = filter(None, map(self.core.arc, self.core.arcs()))
        return [model.Tick(), *removed((arc.request for arc in known), self.admission)]

    def _begin_term(self, recovered: RecoveredState) -> None:
        now, registry, places = self._now, self.registry, self.admission.places
        joined = self.roster.start(now, recovered.rcs.values(), recovered.pending, patient=recovered.patient)
        for arc in recovered.given_up:
            registry.give_up(now, arc, model.Outcome.RELEASED)
        requests = [hold.request for hold in recovered.holds] + [asked.request for asked in recovered.waiting]
        for request in requests:
            registry.enter(request.arc, request.name)
            self.roster.expect(now, request.client)
            if request.client not in recovered.answered:
                self._await_list(request)
        for arc, (grant, rcs) in recovered.believed.items():
            registry.believe(arc, grant, rcs)
        bookings = self._bookings
        waiting = tuple(replace(asked, request=bookings.dated(asked.request)) for asked in recovered.waiting)
        certain = 0 if bookings.settled else bookings.settles_at
        lead = model.LeadTaken(
            self.term, tuple(recovered.holds), waiting, recovered.charged, certain, recovered.patience
        )
        booked = bookings.recovered({request.booking for request in requests if request.booking} | recovered.booked)
        gone = removed((hold.request for hold in recovered.holds), self.admission)
        # RCs receive the new term first; their full lists of holders end incomplete gangs.
        self._decide([*self._out.merge(joined), *booked, lead, *gone], extra_rcs=recovered.rcs)
        self._out.notices += [registry.refuse(now, *refused) for refused in recovered.refused]
        for arc in self.core.arcs():
            self._bind_place(arc)
            if (expecting := recovered.expected.get(request_id(arc))) is not None:
                places.allow_claims(arc, expecting)

    def _compare(self, state: messages.RcState) -> list[model.Event]:
        """Make an RC and the core agree: end holds that the RC lost, revoke holds that it should not have."""
        rc = state.rc
        current = state.term == self.term and state.seq >= self._last_seqs.get(rc, 0)
        holders = self.core.holders(rc)
        ended, superfluous = discrepancies(state, holders, self._now, current=current)
        if superfluous:
            self._out.then.append(steps.Name(rc))
        events: list[model.Event] = [model.RcReported(rc, ended)] if ended else []
        return events + beginnings(state, holders, self._now, self._fleet.timing.hold_lease)

    def _compare_listed(self, answer: messages.ClientRequests) -> list[model.Event]:
        """Release a client's ARCs that only RCs reported and it no longer lists, as no RCM received its release;
        replace the RCs' words about the others by its own."""
        known = self._recovered.pop(answer.client, set()) & {*self.core.arcs_of(answer.client)}
        listed = {asked.id: asked for asked in answer.requests[: self.admission.limits.max_requests_per_client]}
        events = list[model.Event]()
        for arc in filter(None, map(self.core.arc, sorted(known))):
            if (request := listed.get(request_id(arc.id))) is None:
                events.append(model.Released(arc.id))
            elif not arc.vouched:
                try:
                    own = listed_by(answer.client, request, self.admission, self._bookings.record)
                    events.append(word := vouched(arc, own, self.admission))
                    if word.bound is None and own.grant is not None:
                        self.registry.believe(arc.id, own.grant, own.rcs)
                except (Refused, BadName) as error:
                    self._out.strange.append((answer.client, f"{answer.client} lists what can't be: {error}"))
                    events.append(model.Released(arc.id, f"the leader, as it is no valid request: {error}"))
        return events

    def _await_list(self, request: model.ArcRequest) -> None:
        """Ask a client if it still wants this ARC, which only RCs have reported."""
        self._recovered.setdefault(request.client, set()).add(request.arc)
        self._out.merge(self.roster.ask_requests(self._now, request.client))

    def _decide(self, events: Sequence[model.Event], extra_rcs: Collection[RcName] | None = None) -> None:
        """`extra_rcs` are published even if they did not change."""
        if (instant := self._grant(events, extra_rcs)) is not None:
            self._publish_instant(instant)
            self._follow_up(instant)

    def _grant(self, events: Sequence[model.Event], extra_rcs: Collection[RcName] | None = None) -> _Instant | None:
        """Answer and notify the clients of granted ARCs first. Return None if nothing changes."""
        lost = [event.client for event in events if isinstance(event, model.ClientLost)]
        for client in lost:
            self._recovered.pop(client, None)
        if extra_rcs is None and len(lost) == len(events) and not any(map(self.core.arcs_of, lost)):
            return None  # losing clients without ARCs changes nothing
        now, out, registry, operations = self._now, self._out, self.registry, self.operations
        ended = registry.ended
        events = [event for event in events if not (isinstance(event, model.Adopted) and ended(event.held.request.arc))]
        effects = self.core.handle(now, *events)
        out.events, out.effects = events, effects
        granted = [effect.arc for effect in effects if isinstance(effect, model.Granted)]
        granted = [*filter(self.core.is_running, granted)]
        notified = operations.waiting.keys() & granted
        out.granted = operations.answers(now, granted)
        if CONTINUING.isdisjoint(map(type, events)):
            # An ARC that had another hold until now is notified after the publication.
            over = {effect.arc for effect in effects if isinstance(effect, (model.HoldEnded, model.Dropped))} | notified
            for arc in granted:
                if arc not in over:
                    out.grant_notices.append(registry.notice(now, arc))
                    notified.add(arc)
        return _Instant(events, effects, extra_rcs, notified)

    def _publish_instant(self, instant: _Instant) -> None:
        self._out.reopened, self.registry.traced = self.registry.traced, []
        self._publish(instant.effects, instant.extra_rcs, self.operations.instant.left)

    def _follow_up(self, instant: _Instant) -> None:
        events, effects, _, notified = instant
        now, out, registry, operations = self._now, self._out, self.registry, self.operations
        self._record(events)
        answered = notified | operations.waiting.keys()
        out.notices += registry.report(now, effects, answered, operations.instant.given_up)
        out.merge(operations.decided(now, effects))
        for effect in effects:
            match effect:
                case model.Dropped(arc=arc, outcome=outcome) | model.HoldEnded(arc=arc, outcome=outcome) if (
                    not self.core.is_open(arc)
                ):
                    self.admission.places.end(arc, now, PLACE_KEPT.get(outcome, REMEMBERED))
                case model.Propose():
                    out.proposals.append(self._bookings.proposal(effect))
                case model.WakeAt(at):
                    self._core_wake = at
        out.merge(self._bookings.note(events, effects))
        if line := self.core.strategy.log_line():
            out.log.append(line)
        out.over, registry.traced = registry.traced, []

    def _record(self, events: Iterable[model.Event]) -> None:
        now = self._now
        for event in events:
            match event:
                case model.Requested(request):
                    self.roster.expect(now, request.client)
                    self._bind_place(request.arc)
                    asked = f"asked for {', '.join(sorted(request.needs))} at priority {request.priority}"
                    self.registry.record(now, request.arc, asked)
                case model.PlaceShown(arc) | model.Vouched(model.ArcRequest(arc=arc)):
                    self._bind_place(arc)
                case model.HandedOver(to=client, renamed=arc):
                    self.roster.expect(now, client)
                    self._bind_place(arc)
                    if (moved := self.core.arc(arc)) is not None and not moved.vouched:
                        self._await_list(moved.request)
                case model.Adopted(model.RecoveredHold(model.ArcRequest(client=client) as request)) if self.core.arc(
                    request.arc
                ):
                    self._bind_place(request.arc)
                    self.registry.enter(request.arc, request.name)
                    if client not in self.roster.clients:
                        # The links to its RCs returned just now, and the client's own may as well.
                        self._out.merge(self.roster.client_active(now, client))
                        self.roster.expect(now, client)
                    self._await_list(request)

    def _bind_place(self, arc: ArcId) -> None:
        if (place := self.core.place_of(arc)) is not None:
            self.admission.places.bind(place, arc, self._now)

    def _publish(
        self, effects: Iterable[model.Effect], rcs: Collection[RcName] | None = None, left: Collection[ArcId] = ()
    ) -> None:
        """Publish all holders of the granted or revoked RCs that have joined, if any, and in any case those of `rcs`.
        `left`: ARCs whose own client reported that the program is gone."""
        changed = [e for e in effects if isinstance(e, (model.Granted, model.HoldTimed, model.HoldEnded))]
        if not changed and rcs is None:
            return
        now, concerned = self._now, set[RcName]()
        revoked, begun = list[messages.Revocation](), list[tuple[int, float]]()
        for effect in changed:
            concerned.update(effect.rcs)
            if isinstance(effect, model.HoldEnded):
                revoked.append(_revocation(effect, self.registry.name(effect.arc), now, left))
            elif isinstance(effect, model.Granted) and effect.waited is not None:
                begun.append((effect.grant.seq, effect.waited / SECOND))
        number = self.core.seq if self.core.seq > self.seq else self.core.number()
        # Holds of an RC that has not joined are unknown here, and a publication of its holders would end them.
        names = sorted({*(rcs or ()), *filter(self.roster.has_joined, concerned)})
        self._last_seqs |= dict.fromkeys(names, number)
        holders = {name: holders_of(self.core.holders(name), name, now) for name in names}
        instances = {rc: instance for rc, (instance, _) in self.roster.named(names).items()}
        self._out.publication = self._grants(number, holders, revoked, instances, begun)

    def heartbeat(self, now: Ns) -> messages.Grants:
        """A publication without changes: it repeats the last number."""
        self._now = now
        self._bookings.at(now)
        return self._grants(self.seq, {}, [], {}, [])

    def _grants(
        self,
        number: int,
        rcs: dict[str, list[messages.Holder]],
        revoked: list[messages.Revocation],
        instances: dict[str, str],
        begun: list[tuple[int, float]],
    ) -> messages.Grants:
        now, charged, patience = self._now, dict[str, float](), None
        if now >= self._usage_published + USAGE_PERIOD:
            self._usage_published, charged, patience = now, self.core.charged(), self.core.patience / SECOND or None
        every, time, age = self._fleet.timing.heartbeat / SECOND, self._bookings.time, self._bookings.age
        before, self.seq, self.published = self.seq, number, now
        known = rcs, revoked, instances, begun, time, age, charged, patience
        return messages.Grants(self.term, number, before, every, *known)


def _revocation(effect: model.HoldEnded, name: str, now: Ns, left: Collection[ArcId]) -> messages.Revocation:
    return messages.Revocation(
        id=request_id(effect.arc),
        arc=name,
        client=effect.client,
        grant=effect.grant,
        rcs=list(effect.rcs),
        outcome=effect.outcome,
        reason=str(effect.reason),
        by=effect.by,
        why=reason_info(effect.reason, now),
        own=effect.outcome in (model.Outcome.RELEASED, model.Outcome.CANCELLED) and effect.arc in left,
    )
