"""The leading RCM: the scheduling core on the mesh.

    in        queries, tokens, reports of RCs, votes and time become
    events    of the core, all of one instant together; it returns
    effects,  which go
    out       to who is granted, as a publication, notices to others, answers and proposals, in this order.

Nothing is decided here. Queries for the state (`zscout status`, `why`) are answered here as well.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from msgspec.structs import replace

from zscout import messages, trace
from zscout.config.fleet import Fleet
from zscout.keyexpr import BadName, Role, Token, client_of
from zscout.mesh import Declaration, IncomingQuery, Lane, Mesh, MeshError, Refused, Reply, Tally
from zscout.mesh.supervision import StallWatch, Supervisor
from zscout.rcm.admission import Admission
from zscout.rcm.authority import Authority
from zscout.rcm.places import Places, arc_id, request_id
from zscout.rcm.recovery import RecoveredState, listed_by, removed, vouched
from zscout.rcm.request_log import REMEMBERED, RequestLog, reason_info
from zscout.rcm.roster import MAX_TOKENS, Change, Question, Roster, discrepancies
from zscout.rcm.terms import Verdict, Word
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    Adopted,
    ArcRequest,
    ArcStatus,
    ClientLost,
    Dropped,
    Effect,
    Event,
    Granted,
    HandedOver,
    Hold,
    HoldEnded,
    LeadTaken,
    Outcome,
    PlaceShown,
    Propose,
    RcReported,
    RecoveredHold,
    Released,
    Requested,
    Status,
    Tick,
    Vote,
    VoteOverdue,
    Vouched,
    WakeAt,
)
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.scheduling.strategies import STRATEGIES
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.rcm.bookings import Bookings
from zscout.services.rcm.digest import HoldDigest, HoldListener
from zscout.services.rcm.inventory import Inventory
from zscout.services.rcm.request_handler import RequestHandler
from zscout.types import SECOND, VERSION, ArcId, ClientId, Ns, RcName, Term

log = logging.getLogger(__name__)

MAX_LISTED = 1_000
"""Queued ARCs in one answer."""
TELL_CHARGED: Final[Ns] = 10 * SECOND
"""From one time that candidates are told what groups had to the next: what is lost with a leader."""
LATE_VOTE = 2.0
"""Seconds within which a late vote still counts."""
KEPT: Final[Mapping[Outcome, Ns]] = MappingProxyType(
    {Outcome.RELEASED: 0, Outcome.CANCELLED: 0, Outcome.CLIENT_LOST: 86_400 * SECOND}
)
"""For how long a client may ask again for the place of what ended so; else it is for as long as that is known."""
CONTINUED: Final = (LeadTaken, Adopted, Vouched, HandedOver)
"""Events by which holds that stand go on: the RCs hear of that before anybody else."""
STATE_AGE: Final[Ns] = SECOND // 20
"""An answer about the state may be this old (rule 20): building it costs as much as many grants."""
MAX_BUILT: Final = 4
"""Answers of one kind that are built within STATE_AGE, where the state changes."""
MAX_REASON = 500
"""Characters of a veto's reason."""


class _Built(NamedTuple):
    """An answer about the state, and after which batch of events it was built."""

    state: messages.RcmState
    encoded: bytes
    batches: int
    built: int
    """How many were built within STATE_AGE."""


class Rcm:
    """One term of one RCM, from taking the lead to giving it up. When any of its work fails, `on_failure` is
    called with the error, once: the term is to be ended then."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        term: Term,
        on_newer: Callable[[Word], Verdict],
        on_failure: Callable[[Exception], object],
        inventory: Inventory | None = None,
        authority: Authority | None = None,
        places: Places | None = None,
        listeners: Sequence[HoldListener] = (),
        tally: Tally | None = None,
        keeper: BookingKeeper | None = None,
        kept: Sequence[messages.BookingsKept] = (),
        runtimes: RuntimeEstimator | None = None,
    ) -> None:
        """`inventory`, `authority`, `keeper`: those of its candidate, if it has one. `places`, `kept`: what it has
        recovered. `listeners` are told of holds, and `tally` counts how operations end. Forecasts go by
        `runtimes`."""
        self.mesh, self.fleet, self.term = mesh, fleet, term
        self.supervisor = Supervisor(f"the RCM of term {term.counter}", on_failure)
        self.authority = authority or Authority(fleet)
        self.core = Core(STRATEGIES[fleet.strategy](), self.authority.bound(fleet.scheduling))
        supervisor, receive = self.supervisor, self._receive
        self._on_newer = on_newer
        self.on_disbelieved: Callable[[RcName, Term], object] = lambda *_: None
        """Called when no RC has joined, and one obeys an RCM of so low a term that this one is none to it."""
        self.places = places or Places(fleet.name, None, term)
        self._admission = Admission(fleet.limits, self.authority, self.places)
        self._runtimes = runtimes
        self._own_inventory = inventory is None
        self.inventory = inventory or Inventory(mesh, fleet)
        devices = self.inventory.devices
        self.roster = Roster(mesh.keys, mesh.me.host, fleet, term, devices, self._admission, self.core.arc, mesh.now())
        self._stall = StallWatch(mesh.now)
        self.registry = RequestLog(self.core, self.roster, self.places, runtimes)
        self._digest = HoldDigest(self.core, listeners) if listeners else None
        self._tally = tally
        self.requests = RequestHandler(
            mesh,
            fleet,
            self.core,
            self.registry,
            self.roster,
            devices,
            self._admission,
            supervisor,
            receive,
            self._follow,
            runtimes,
        )
        self.bookings = self.requests.bookings = Bookings(
            mesh,
            fleet,
            term,
            self.core,
            keeper or BookingKeeper(mesh),
            kept,
            self._admission,
            supervisor,
            receive,
            self._propose,
            partial(self.requests.check_door, may_wait=False),
        )
        self.bookings.handler.runtimes = runtimes
        self._heartbeat = fleet.timing.heartbeat
        self._grants = mesh.publisher(mesh.keys.grants, messages.Grants)
        self.seq = 0
        """The last number that was published."""
        self._published: Ns = 0
        """When that was."""
        self._told_charged: Ns = 0
        """When candidates were told last what groups had."""
        self._named: dict[RcName, int] = {}
        """The number of the last publication that named an RC."""
        self._recovered: dict[ClientId, set[ArcId]] = {}
        """By client: the ARCs that only RCs have told of."""
        self._states: dict[messages.StateAsk, _Built] = {}
        self._states_since: Ns = 0
        self._vote_timeout = fleet.timing.vote_timeout / SECOND
        self._voted = supervisor.guard(self._on_ballot)
        self._declared: list[Declaration] = []
        self._wake: asyncio.TimerHandle | None = None
        self._core_wake: Ns | None = None
        self._armed: Ns = 0
        """When the timer goes off: it may be earlier than it need be."""

    # Beginning and end

    def start(self, recovered: RecoveredState) -> None:
        """Begins to lead. Everything that is declared here is declared by the leader only."""
        keys, mesh, guard = self.mesh.keys, self.mesh, self.supervisor.guard
        if self._own_inventory:
            self.inventory.start(self.supervisor)
        self._stall.start()
        now = self._look()
        joined = self.roster.start(now, recovered.rcs.values(), recovered.pending, patient=recovered.patient)
        for arc in recovered.given_up:
            self.registry.give_up(now, arc, Outcome.RELEASED)
        requests = [*(hold.request for hold in recovered.holds), *(one.request for one in recovered.waiting)]
        for request in requests:
            self.registry.enter(request.arc, request.name)
            self.roster.expect(now, request.client)
            if request.client not in recovered.answered:
                self._recover(request)
        for arc, rcs in recovered.believed.items():
            self.registry.believe(arc, rcs)
        waiting = (replace(one, request=self.bookings.dates.dated(one.request)) for one in recovered.waiting)
        certain = 0 if self.bookings.settled else self.bookings.settles_at
        lead = LeadTaken(self.term, tuple(recovered.holds), tuple(waiting), recovered.charged, certain)
        taken = {request.booking for request in requests if request.booking}
        booked = self.bookings.recovered(taken | recovered.booked)
        gone = removed((hold.request for hold in recovered.holds), self._admission)
        # RCs receive the new term first; full lists end whatever was found to be half a gang.
        self._decide([*joined.events, *booked, lead, *gone], named=recovered.rcs)
        self._notify(self.registry.refuse(now, *refused) for refused in recovered.refused)
        for arc in self.core.arcs():
            self._bind(arc)
            if (expecting := recovered.expected.get(request_id(arc))) is not None:
                self.places.admit(arc, expecting)
        limit = self.fleet.limits.max_payload
        self._declared = [
            mesh.serve(
                keys.schedule_any,
                messages.Operation,
                guard(self._on_operation),
                limit=limit,
                tally=self._tally,
                concerns=self._concerns,
            ),
            *(
                mesh.serve(key, messages.StateAsk, guard(self._on_state_asked), lane=Lane.QUESTION)
                for key in (keys.rcm_state, keys.rcm_state_any)
            ),
            mesh.subscribe(keys.rc_state_any, messages.RcState, guard(self._on_rc_state)),
            mesh.watch(keys.alive_any(Role.CLIENT), guard(self._on_client)),
            mesh.watch(keys.alive_any(Role.RC), guard(self._on_rc_token)),
            mesh.alive(Token(mesh.me.host, Role.RCM, mesh.me.client, self.term.rcm)),
        ]
        self.bookings.start()
        self.supervisor.spawn(self._send_heartbeats())

    def stop(self) -> None:
        """Stops leading. Nothing is revoked: holds and requests stay for the next RCM."""
        if self._digest is not None:
            self._digest.close(self.mesh.now())
        for declared in reversed(self._declared):
            declared.close()
        self._stall.stop()
        self.supervisor.cancel()
        if self._own_inventory:
            self.inventory.stop()
        self._log(self.registry.close(self.mesh.now()))
        self.bookings.close()
        self.requests.close()
        self._grants.close()

    def on_reload(self) -> None:
        """The rights have changed: who has none any more holds and waits for nothing."""
        self.core.policy = self.authority.bound(self.fleet.scheduling)
        known = filter(None, map(self.core.arc, self.core.arcs()))
        self._receive(Tick(), *removed((arc.request for arc in known), self._admission))

    # In

    def _look(self) -> Ns:
        """The present time. The roster learns of a stall of this process."""
        stall, fresh = self._stall, self._stall.fresh()
        self.roster.stalled(stall.length, stall.ended, fresh=fresh)
        return self.mesh.now()

    def _concerns(self, query: IncomingQuery[messages.Operation]) -> tuple[Lane, str]:
        """Dry runs and slots are questions; an operation on another host's request waits behind that host's surplus."""
        operation, host = query.message, self.mesh.keys.sender_of(query.key).host
        if isinstance(operation, (messages.Foresee, messages.FindSlots)):
            return Lane.QUESTION, host
        owner = operation.client if isinstance(operation, (messages.Cancel, messages.Release)) else None
        return Lane.ASK, host if owner is None else client_of(owner).host

    def _on_operation(self, query: IncomingQuery[messages.Operation]) -> None:
        self.requests.on_operation(query)
        self._send_notices()

    def _send_notices(self) -> None:
        notices, self.requests.notices = self.requests.notices, []
        self._notify(notices)

    def _on_rc_state(self, key: str, state: messages.RcState) -> None:
        self._follow(self.roster.rc_state(self._look(), key, state))

    def _on_client(self, token: Token, alive: bool) -> None:
        self._follow(self.roster.client_token(self._look(), token, alive=alive))

    def _on_rc_token(self, token: Token, alive: bool) -> None:
        self._follow(self.roster.rc_token(self._look(), token, alive=alive))

    def _follow(self, change: Change) -> None:
        """Carry out what follows for the roster, in its order."""
        verdicts = [(token, self._on_newer(word)) for word, token in change.higher]
        for rc, term in change.disbelieved:
            self.on_disbelieved(rc, term)
        if not self.supervisor.active:
            return
        if change.events:
            self._receive(*change.events)
        for state in change.reported:
            self._compare(state)
        if change.named:
            self._publish([], change.named)
        for listed in change.listed:
            self._on_requests(listed)
        for number, found in change.found:
            self.requests.on_new_client(number, found=found)
            self._send_notices()
        if change.settled:
            self.requests.resume()
            self._send_notices()
        for asked in change.questions:
            self.supervisor.spawn(self._ask(asked))
        for sign, so in change.suspicions:
            self.mesh.suspicions.suspect(sign, so=so)
        for remark in change.remarks:
            log.info("%s", remark)
        for rc, host in change.duplicates:
            log.warning("duplicate device %s at %s; another host's is used", rc, host)
        if change.surplus:
            log.warning("%s shows more than %d tokens: later ones are ignored", change.surplus, MAX_TOKENS)
        for token, verdict in verdicts:
            if token is not None and verdict.absent_until:
                self._follow(self.roster.shun(self.mesh.now(), token, verdict.absent_until))
        self._set_wake(self._core_wake)

    async def _ask(self, asked: Question) -> None:
        if asked.kind is None:
            tokens = await self.mesh.living(asked.key, timeout=asked.timeout)
            self._follow(self.roster.seen(self._look(), asked, tokens))
            return
        reply = await self.mesh.ask_one(asked.key, asked.message, asked.kind, timeout=asked.timeout)
        message, problem = (None, None) if reply is None else (reply.message, reply.problem)
        self._follow(self.roster.answered(self._look(), asked, message, problem))

    def _receive(self, *events: Event) -> None:
        """What has happened; events that come together are one instant."""
        for event in events:
            if isinstance(event, ClientLost):
                self._recovered.pop(event.client, None)
        # A client that asked for nothing changes nothing.
        if all(isinstance(event, ClientLost) and not self.core.arcs_of(event.client) for event in events):
            return
        if self.supervisor.active:
            # What was asked before is decided before.
            self.requests.flush()
            self._decide(events)

    def _compare(self, state: messages.RcState) -> None:
        """Makes an RC and the core agree: what the RC lost has ended, what is too much there is revoked."""
        if not self.supervisor.active:
            return
        rc = state.rc
        current = state.term == self.term and state.seq >= self._named.get(rc, 0)
        ended, superfluous = discrepancies(state, self.core.holders(rc), self.mesh.now(), current=current)
        if ended:
            self._receive(RcReported(rc, ended))
        if superfluous:
            self._publish([], [rc])

    def _on_requests(self, answer: messages.ClientRequests) -> None:
        """What RCs alone told of, and a client does not ask for, it gave up where no RCM heard of it; else its own word
        is the one that counts."""
        known = self._recovered.pop(answer.client, set()) & {*self.core.arcs_of(answer.client)}
        listed = {one.id: one for one in answer.requests[: self.fleet.limits.max_requests_per_client]}
        events = list[Event]()
        for arc in filter(None, map(self.core.arc, sorted(known))):
            if (request := listed.get(request_id(arc.id))) is None:
                events.append(Released(arc.id))
            elif not arc.vouched:
                try:
                    own = listed_by(answer.client, request, self._admission, self.bookings.record)
                    events.append(vouched(arc, own, self._admission))
                except (Refused, BadName) as error:
                    log.warning("%s lists what can't be: %s", answer.client, error)
                    events.append(Released(arc.id, f"the leader, as it is no valid request: {error}"))
        if events:
            self._receive(*events)

    def _recover(self, request: ArcRequest) -> None:
        """Has a client say whether it still asks for what RCs hold for it."""
        self._recovered.setdefault(request.client, set()).add(request.arc)
        self._follow(self.roster.ask_requests(self.mesh.now(), request.client))

    # Events, and out

    def _decide(self, events: Sequence[Event], named: Collection[RcName] | None = None) -> None:
        """One instant. RCs that are `named` are published, whatever becomes of them."""
        over = self.registry.ended
        events = [one for one in events if not (isinstance(one, Adopted) and over(one.held.request.arc))]
        effects = self.core.handle(self.mesh.now(), *events)
        now = self.mesh.now()
        told = self.requests.answer_grants(effects)
        if not any(isinstance(event, CONTINUED) for event in events):
            notices = self.registry.grants(now, effects, told)
            told |= self._notify(notices)
        self._trace()
        self._publish(effects, named)
        self._note(events)
        answered = told | self.requests.waiting.keys()
        self._notify(self.registry.report(now, effects, answered, self.requests.given_up))
        self.requests.answer(effects)
        for effect in effects:
            match effect:
                case Dropped(arc=arc, outcome=outcome) | HoldEnded(arc=arc, outcome=outcome) if not self.core.is_open(
                    arc
                ):
                    self.places.end(arc, now, KEPT.get(outcome, REMEMBERED))
                case Propose():
                    self._propose(effect)
                case WakeAt(at):
                    self._set_wake(at)
        self.bookings.note(events, effects)
        if line := self.core.strategy.log_line():
            log.info("%s", line)
        if self._digest is not None:
            # All who wait for an answer have it by now.
            self._digest.take(now, events, effects, self.registry.foretold)
        self._trace()

    def _notify(self, notices: Iterable[messages.Notice]) -> set[ArcId]:
        """Send notices to their clients; return their ARCs."""
        notified = set()
        for notice in notices:
            self.mesh.put(self.mesh.keys.notice(client_of(notice.client)), notice)
            notified.add(arc_id(notice.client, notice.id))
        return notified

    def _trace(self) -> None:
        if trace.enabled():
            for did, arc in self.registry.traced:
                trace.write(self.mesh.now(), did, term=self.term, arc=arc)
        self.registry.traced.clear()

    def _log(self, text: str) -> None:
        if text:
            log.info("%s", text)

    def _note(self, events: Iterable[Event]) -> None:
        """What is remembered of an instant."""
        now = self.mesh.now()
        for event in events:
            match event:
                case Requested(ArcRequest(client=client)) | HandedOver(to=client):
                    self.roster.expect(now, client)
            match event:
                case Requested(request):
                    self._bind(request.arc)
                    asked = f"asked for {', '.join(sorted(request.needs))} at priority {request.priority}"
                    self.registry.record(now, request.arc, asked)
                case PlaceShown(arc) | Vouched(ArcRequest(arc=arc)):
                    self._bind(arc)
                case HandedOver(renamed=arc):
                    self._bind(arc)
                    if (moved := self.core.arc(arc)) is not None and not moved.vouched:
                        self._recover(moved.request)
                case Adopted(RecoveredHold(ArcRequest(client=client) as request)) if self.core.arc(request.arc):
                    self._bind(request.arc)
                    self.registry.enter(request.arc, request.name)
                    if client not in self.roster.clients:
                        # As the links to its RCs came back just now, so may its own.
                        self._follow(self.roster.heard(now, client))
                        self.roster.expect(now, client)
                    self._recover(request)

    def _bind(self, arc: ArcId) -> None:
        if (place := self.core.place_of(arc)) is not None:
            self.places.bind(place, arc, self.mesh.now())

    def _set_wake(self, at: Ns | None) -> None:
        """Sets when the core is woken. A timer that is set for earlier stays, and is set again when it goes off: most
        ends are put off before they come."""
        self._core_wake = at
        at = min((time for time in (at, self.roster.next, self.registry.next) if time is not None), default=None)
        if at is None or (self._wake is not None and self._armed <= at):
            return
        if self._wake is not None:
            self._wake.cancel()
        self._armed = at
        self._wake = self.supervisor.call_later(max(0.0, (at - self.mesh.now()) / SECOND), self._on_wake)

    def _on_wake(self) -> None:
        self._wake = None
        now = self._look()
        if self.roster.next is not None and self.roster.next <= now:
            self._follow(self.roster.tick(now))
        if self._core_wake is not None and self._core_wake <= now:
            self._receive(Tick())
        notices, text = self.registry.tick(now)
        self._notify(notices)
        self._log(text)
        self._set_wake(self._core_wake)

    # Out: grants

    def _publish(self, effects: Iterable[Effect], rcs: Collection[RcName] | None = None) -> None:
        """Publishes all holders of the RCs that were granted or revoked, if any were and as far as they have joined;
        with `rcs` in any case, and those of `rcs` as well."""
        changed = [effect for effect in effects if isinstance(effect, (Granted, HoldEnded))]
        if not changed and rcs is None:
            return
        now = self.mesh.now()
        revoked = [
            _revocation(effect, self.registry.name(effect.arc), now, own=self._is_own(effect))
            for effect in changed
            if isinstance(effect, HoldEnded)
        ]
        number = self.core.seq if self.core.seq > self.seq else self.core.number()
        # One that has not joined holds what is not known here: to name it would end that.
        concerned = filter(self.roster.has_joined, {rc for effect in changed for rc in effect.rcs})
        names = sorted({*(rcs or ()), *concerned})
        self._named |= dict.fromkeys(names, number)
        holders = {name: holders_of(self.core.holders(name), name, now) for name in names}
        instances = {rc: instance for rc, (instance, _) in self.roster.named(names).items()}
        begun = [
            (effect.grant.seq, effect.waited / SECOND)
            for effect in changed
            if isinstance(effect, Granted) and effect.waited is not None
        ]
        self._put(number, holders, revoked, instances, begun)

    def _is_own(self, effect: HoldEnded) -> bool:
        """Whether its own client has given this hold back, and its program is gone, in the burst that is decided."""
        return effect.outcome in (Outcome.RELEASED, Outcome.CANCELLED) and effect.arc in self.requests.left

    async def _send_heartbeats(self) -> None:
        """Repeats the last number whenever nothing was published for a while."""
        while True:
            due = self._published + self._heartbeat - self.mesh.now()
            if due > 0:
                await asyncio.sleep(due / SECOND)
            else:
                self._put(self.seq, {}, [], {})

    def _put(
        self,
        number: int,
        rcs: dict[RcName, list[messages.Holder]],
        revoked: list[messages.Revocation],
        instances: dict[RcName, str],
        begun: Sequence[tuple[int, float]] = (),
    ) -> None:
        every = self._heartbeat / SECOND
        if (rcs or revoked) and trace.enabled():
            holders = {
                rc: [(one.grant, f"{one.client}/{one.id}", one.place, one.rcs) for one in held]
                for rc, held in rcs.items()
            }
            ends = [(one.grant, one.outcome) for one in revoked]
            trace.write(
                self.mesh.now(), "publish", term=self.term, seq=number, rcs=holders, instances=instances, ends=ends
            )
        now, charged = self.mesh.now(), dict[str, float]()
        if now >= self._told_charged + TELL_CHARGED:
            self._told_charged, charged = now, self.core.charged()
        time, age = self.bookings.time, (now - self.bookings.clock.since) / SECOND
        self._grants.put(
            messages.Grants(self.term, number, self.seq, every, rcs, revoked, instances, [*begun], time, age, charged)
        )
        self.seq, self._published = number, now

    # Out: proposals, and ballots in

    def _propose(self, effect: Propose) -> None:
        arcs = ((name, self.core.arc(name), params) for name, params in effect.holders.items())
        holders = [
            messages.ProposedHolder(request_id(arc.id), arc.name, arc.request.client, messages.decimals(params))
            if arc is not None
            else self.bookings.proposed(name, params)
            for name, arc, params in arcs
        ]
        proposal = messages.Proposal(proposal=effect.proposal, term=self.term, holders=holders)
        # Overdue once; an answer that comes before the query ends still counts.
        overdue = self.supervisor.call_later(self._vote_timeout, self._receive, VoteOverdue(effect.proposal))
        voted = partial(self._voted, effect.rc, effect.proposal, overdue)
        late = max(LATE_VOTE, 2 * self._vote_timeout)
        try:
            self.mesh.ask_then(self.mesh.keys.vote(effect.rc), proposal, messages.Ballot, voted, timeout=late)
        except MeshError as error:
            log.warning("%s", error)

    def _on_ballot(
        self, rc: RcName, proposal: int, overdue: asyncio.TimerHandle, reply: Reply[messages.Ballot] | None
    ) -> None:
        overdue.cancel()
        self.mesh.suspicions.suspect(f"{rc} is seen and does not vote", so=reply is None)
        ballot = reply.message if reply is not None else None
        if ballot is not None and ballot.proposal == proposal:
            self._receive(Vote(proposal, ballot.accept, ballot.reason[:MAX_REASON]))
            return
        if reply is not None and reply.problem is not None:
            log.warning("%s did not vote: %s", rc, reply.problem.message)
        self._receive(VoteOverdue(proposal))

    def _on_state_asked(self, query: IncomingQuery[messages.StateAsk]) -> None:
        asked, now = query.message, self.mesh.now()
        if asked.holds_only:
            query.answer(self._state(asked, now))  # RCs reckon ends by it: it is never of an earlier instant
            return
        alike = replace(asked, arc=None)
        if now - self._states_since > STATE_AGE:
            self._states_since = now
            self._states.clear()
        known = self._states.get(alike)
        if known is None or (known.built < MAX_BUILT and known.batches != self.core.batches):
            state = self._state(alike, now)
            built = 1 if known is None else known.built + 1
            known = self._states[alike] = _Built(state, messages.encode(state), self.core.batches, built)
        if asked.arc is None:
            query.answer(known.state, known.encoded)
        else:
            query.answer(replace(known.state, story=self.registry.story(now, asked.arc)))

    def _state(self, asked: messages.StateAsk, now: Ns) -> messages.RcmState:
        if asked.devices_only:
            rcs = self._devices(self.core.status(0), now)
            return messages.RcmState(self.term, self.seq, self.mesh.me.host, rcs=rcs, version=VERSION)
        status = self.core.status(0 if asked.holds_only else MAX_LISTED)
        holds = [_hold_view(arc, arc.hold, now, self._runtimes) for arc in status.running if arc.hold is not None]
        instances = self.roster.named(sorted({rc for hold in holds for rc in hold.needs}))
        me = self.mesh.me.host
        state = messages.RcmState(self.term, self.seq, me, holds, instances=instances, version=VERSION)
        if not asked.holds_only:
            starts = self.registry.starts(now) if asked.forecast else {}
            state = replace(
                state,
                queue=[_wait_view(arc, now, starts.get(arc.id)) for arc in status.queued],
                rcs=self._devices(status, now),
                more=status.waiting - len(status.queued),
                charged=self.core.charged(),
            )
        return state

    def _devices(self, status: Status, now: Ns) -> list[messages.RcView]:
        """All RCs that are there or expected. What somebody asks for and nobody ever offered is not among them."""
        known = {rc.name: rc for rc in status.rcs}
        devices = self.inventory.devices
        devices.forget_old(now)
        named = self.roster.named(known)
        there = {rc.name for rc in status.rcs if rc.present}
        views = []
        for name in sorted(there | devices.names):
            rc, state = known.get(name), self.roster.reported(name)
            view = messages.RcView(name, present=False, sharable=False)
            if rc is not None:
                view = messages.RcView(name, rc.present, rc.sharable, [*map(request_id, rc.holders)])
            if state is not None:
                reason = "" if state.health == "ok" else state.health[:MAX_REASON]
                view = replace(view, sharable=state.sharable, reason=reason, parameters=state.parameters)
            views.append(devices.view(view, now, named[name][1] if name in named else None))
        return views


# The core's values as messages


def _of(arc: ArcStatus) -> dict[str, Any]:
    """What all messages have of an ARC."""
    return {
        "id": request_id(arc.id),
        "arc": arc.name,
        "client": arc.request.client,
        "priority": arc.request.priority,
        "place": arc.place,
        "min_runtime": messages.decimal_seconds(arc.request.min_runtime),
        "who": arc.request.who,
        "booking": arc.request.booking,
    }


def holders_of(arcs: Iterable[ArcStatus], rc: str, now: Ns) -> list[messages.Holder]:
    return [
        messages.Holder(
            **_of(arc),
            grant=arc.hold.grant,
            rcs=sorted(arc.needs),
            remaining=(arc.hold.end - now) / SECOND,
            keep=arc.request.keep,
            params=messages.decimals(arc.needs[rc]),
            bound=dict(arc.bound),
            direct=arc.request.direct,
            continues=arc.request.continues,
        )
        for arc in arcs
        if arc.hold is not None
    ]


def _revocation(effect: HoldEnded, name: str, now: Ns, *, own: bool) -> messages.Revocation:
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
        own=own,
    )


def _hold_view(arc: ArcStatus, hold: Hold, now: Ns, runtimes: RuntimeEstimator | None) -> messages.HoldView:
    end = None if runtimes is None else runtimes.end(arc.request, hold, now)
    return messages.HoldView(
        **_of(arc),
        grant=hold.grant,
        needs={rc: messages.decimals(params) for rc, params in sorted(arc.needs.items())},
        held=(now - hold.start) / SECOND,
        remaining=(hold.end - now) / SECOND,
        keep=arc.request.keep,
        bound=dict(arc.bound),
        direct=arc.request.direct,
        continues=arc.request.continues,
        ends_in=None if end is None else (end - now) / SECOND,
    )


def _wait_view(arc: ArcStatus, now: Ns, start: Ns | None) -> messages.WaitView:
    return messages.WaitView(
        **_of(arc),
        needs={need: messages.decimals(params) for need, params in sorted(arc.request.needs.items())},
        waited=(now - arc.since) / SECOND,
        reason=str(arc.reason or ""),
        preemptions=arc.preemptions,
        starts_in=None if start is None else (start - now) / SECOND,
        why=reason_info(arc.reason, now),
    )
