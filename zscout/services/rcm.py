"""The leading RCM: the scheduling core on the mesh.

Queries become events of the core; its effects become publications, notices and answers, in that order.
Nothing is decided here but what a request may ask for at all.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

from zscout import clock
from zscout.amounts import duration, exact_amounts
from zscout.config import Fleet
from zscout.keyexpr import BadName, Role, Sender, Token, check_name, check_rc, client_of
from zscout.mesh import Declared, Mesh, MeshError, Refused, Reply, Request
from zscout.messages import (
    MAX_PARAMS,
    Ask,
    Ballot,
    Cancel,
    Grants,
    HandOver,
    Holder,
    Notice,
    Operation,
    Proposal,
    RcmState,
    Release,
    Revocation,
    State,
    StateAsk,
)
from zscout.scheduling.core import Core
from zscout.scheduling.effects import Dropped, Effect, Granted, Propose, Queued, Revoked, WakeAt
from zscout.scheduling.events import (
    Asked,
    Cancelled,
    Event,
    HandedOver,
    LeadTaken,
    Released,
    Tick,
    Vote,
    VoteOverdue,
)
from zscout.scheduling.model import SECOND, Arc, ArcId, Ns, Term
from zscout.scheduling.model import Request as ArcRequest
from zscout.services import views
from zscout.services.presence import Presence
from zscout.services.rebuild import Inheritance
from zscout.services.story import Story

log = logging.getLogger(__name__)

REMEMBER = 60 * SECOND
"""How long ended requests are known: longer than any query's timeout and a lease together."""
MAX_REMEMBERED = 20_000
MAX_LISTED = 1_000
"""Queued ARCs in one answer."""
LATE_VOTE = 2.0
"""Seconds within which a late vote is still heard."""
REPLY_SLACK = 0.1
REASONS_EVERY = 0.1
"""Seconds at most until a waiting client hears that its reason to wait has changed: in a busy queue every
grant changes many reasons, and only the last is of use."""
LOG_EVERY = 0.1
MAX_LOGGED = 50
"""Lines in one entry of the log; the story has them all."""
MAX_PRIORITY = 1_000_000
MAX_GATHERED = 64
"""Operations that are decided together at most."""


class Rcm:
    """One reign of one RCM, from taking the lead to giving it up."""

    def __init__(self, mesh: Mesh, fleet: Fleet, term: Term, on_newer: Callable[[Term], None]) -> None:
        self.mesh, self.fleet, self.term = mesh, fleet, term
        self._on_newer = on_newer
        self.core = Core()
        self.story = Story()
        self.presence = Presence(mesh, fleet, self)
        self._step = 0
        self._published = 0
        self._said_at: Ns = 0
        self._touched: dict[str, int] = {}
        self._declared: list[Declared] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._wake: asyncio.TimerHandle | None = None
        self._wake_at: Ns | None = None
        self._armed: Ns = 0
        """When the timer goes off: it may be earlier than it need be."""
        self._untold: set[ArcId] = set()
        """ARCs whose reason to wait has not been published yet."""
        self._unlogged: list[str] = []
        self._answers: dict[ArcId, list[Request[Operation]]] = {}
        self._gathered: dict[ArcId, Asked | Cancelled | Released] = {}
        """Operations of the present burst that are not decided yet."""
        self._given_up: set[ArcId] = set()
        """ARCs that end in this burst by their own client's will."""
        self._names: dict[ArcId, str] = {}
        self._moved: dict[ArcId, ArcId] = {}
        """What was handed over: by the name that its new client has for it, by which this RCM knows it."""
        self._ended: OrderedDict[ArcId, tuple[Ns, Notice]] = OrderedDict()
        self._closed = False

    # Beginning and end

    def start(self, inheritance: Inheritance) -> None:
        """Begins to lead. Everything that is declared here is declared by the leader only."""
        keys, mesh = self.mesh.keys, self.mesh
        self._grants = mesh.publisher(keys.grants, Grants)
        joined = self.presence.inherit(inheritance.rcs)
        for request in (
            *(held.request for held in inheritance.standing),
            *(r for r, _ in inheritance.waiting),
        ):
            self._names[request.arc] = request.name
            self.presence.expect(request.client)
        lead = LeadTaken(self.term, tuple(inheritance.standing), tuple(inheritance.waiting))
        effects = self.core.handle(clock.now(), *joined, lead)
        # RCs hear of the new term first; full lists end whatever was found to be half a gang.
        self._published = 0
        self._carry_out(effects, everything=True)
        token = Token(mesh.me.host, Role.RCM, mesh.me.client, self.term.rcm)
        self._declared += [
            mesh.serve(keys.schedule_any, Operation, self._on_operation, limit=self.fleet.limits.max_payload),
            mesh.serve(keys.rcm_state, StateAsk, self._on_state_asked),
            *self.presence.watch(),
            mesh.alive(token),
        ]
        self.spawn(self._heartbeat())

    def stop(self) -> None:
        """Stops leading. Nothing is revoked: what stands, stands for the next RCM."""
        if self._closed:
            return
        self._closed = True
        for declared in reversed(self._declared):
            declared.close()
        self.presence.stop()
        if self._wake is not None:
            self._wake.cancel()
        self._log()
        for task in list(self._tasks):
            task.cancel()
        for requests in self._answers.values():
            for request in requests:
                request.refuse(Refused("not_leading", "this RCM stopped leading; ask again").problem)
        self._grants.close()

    # Events into the core

    def feed(self, *events: Event) -> None:
        """Gives the core one instant's events and carries out what follows."""
        self._decide()
        if not self._closed:
            self._carry_out(self.core.handle(clock.now(), *events))

    def _gather(self, arc: ArcId, event: Asked | Cancelled | Released) -> None:
        """What was asked in one burst is one instant: one pass decides it, one publication tells it."""
        if not self._gathered:
            self.mesh.after_burst(self._decide)
        self._gathered[arc] = event
        if len(self._gathered) >= MAX_GATHERED:
            self._decide()

    def _decide(self) -> None:
        """Hands over what was gathered: first what ends, then what was asked."""
        gathered, self._gathered = self._gathered, {}
        if not gathered or self._closed:
            return
        asked = [event for event in gathered.values() if isinstance(event, Asked)]
        ended = [event for event in gathered.values() if not isinstance(event, Asked)]
        try:
            self._carry_out(self.core.handle(clock.now(), *ended, *asked))
        except Exception:
            problem = Refused("internal", "the request failed here; see this node's log").problem
            for arc in gathered:
                for request in self._answers.pop(arc, ()):
                    request.refuse(problem)
            raise
        finally:
            self._given_up.clear()
        for event in ended:
            self._answer(event.arc)
        waits = [event.request.arc for event in asked if event.request.arc in self._answers]
        if waits:
            # Votes are out: the first word is theirs, if they come.
            patience = self.fleet.timing.vote_timeout / SECOND + REPLY_SLACK
            asyncio.get_running_loop().call_later(patience, self._answer_all, waits)

    def _on_operation(self, request: Request[Operation]) -> None:
        sender = self.mesh.keys.sender_of(request.key)
        operation = request.message
        check_name(operation.id, "id")
        match operation:
            case Ask():
                self._ask(request, operation, sender)
            case Cancel() | Release():
                owner = client_of(operation.client) if operation.client is not None else sender
                arc = self._known_as(owner, operation.id)
                self._in_order(arc)
                if owner == sender:
                    self._given_up.add(arc)
                by = "its client" if owner == sender else str(sender)
                self._answers.setdefault(arc, []).append(request)
                self._gather(arc, Cancelled(arc, by) if isinstance(operation, Cancel) else Released(arc, by))
            case HandOver():
                self._hand_over(request, operation, sender)

    def _ask(self, request: Request[Operation], ask: Ask, sender: Sender) -> None:
        arc = self._known_as(sender, ask.id)
        self._in_order(arc)
        if arc in self._answers:
            self._answers[arc].append(request)
        elif self.core.floor.arc(arc) is None and arc not in self._ended:
            wanted = self._checked(ask, sender, arc)
            self._names[arc] = ask.arc
            self.presence.expect(str(sender))
            self._answers[arc] = [request]
            self._tell(arc, ask.arc, f"asked for {', '.join(sorted(ask.needs))} at priority {ask.priority}")
            self._gather(arc, Asked(wanted, ask.place))
        else:
            request.answer(self._standing(arc, str(sender), ask.id))

    def _in_order(self, arc: ArcId) -> None:
        """Operations on one ARC stay in their order: what was gathered of it goes first."""
        if arc in self._gathered:
            self._decide()

    def _checked(self, ask: Ask, sender: Sender, arc: ArcId) -> ArcRequest:
        """The request, if it may be made at all; raises Refused with what is wrong and how to mend it."""
        limits, floor = self.fleet.limits, self.core.floor
        if not ask.needs:
            raise Refused("bad_request", "needs is empty; name at least one RC")
        if len(ask.needs) > limits.max_needs:
            raise Refused("bad_request", f"{len(ask.needs)} needs; at most {limits.max_needs} are allowed")
        coming = [event for event in self._gathered.values() if isinstance(event, Asked)]
        if len(floor.queued) + len(coming) >= limits.max_queued:
            raise Refused("queue_full", f"{limits.max_queued} ARCs wait already; ask again later")
        theirs = sum(1 for event in coming if event.request.client == str(sender))
        if theirs + len(self.core.arcs_of(str(sender))) >= limits.max_requests_per_client:
            raise Refused("too_many", f"{sender} has {limits.max_requests_per_client} requests open already")
        if not -MAX_PRIORITY <= ask.priority <= MAX_PRIORITY:
            raise Refused("bad_request", f"priority must lie between -{MAX_PRIORITY} and {MAX_PRIORITY}")
        if ask.place is not None and ask.place.term > self.term:
            raise Refused("bad_request", "place is of a term that has not been; leave it out")
        if ask.place is not None and (ask.place.arrival < 1 or not self.core.given(ask.place)):
            raise Refused("bad_request", "place was never given; leave it out")
        try:
            check_name(ask.arc, "arc")
            for name, params in ask.needs.items():
                check_rc(name)
                if len(params) > MAX_PARAMS:
                    raise ValueError(f"{name} has more than {MAX_PARAMS} parameters")
                for parameter in params:
                    check_name(parameter, f"parameter of {name}")
            return ArcRequest(
                arc=arc,
                client=str(sender),
                needs={name: exact_amounts(params) for name, params in ask.needs.items()},
                priority=ask.priority,
                min_runtime=duration(ask.min_runtime, "min_runtime"),
                keep=ask.keep,
                label=ask.arc,
            )
        except (BadName, ValueError) as error:
            raise Refused("bad_request", str(error)) from None

    def _hand_over(self, request: Request[Operation], operation: HandOver, sender: Sender) -> None:
        arc = self._known_as(sender, operation.id)
        to = str(client_of(operation.to))
        self._in_order(arc)
        running = self.core.floor.running.get(arc)
        if running is None or running.request.client not in (str(sender), to):
            raise Refused("not_running", f"{operation.id} does not run at {sender}")
        if not self.presence.alive(to):
            raise Refused("unknown_client", f"{to} is not on the mesh")
        self._moved[views.arc_id(to, operation.id)] = arc
        self.feed(HandedOver(arc, to))
        request.answer(self._standing(arc, str(sender), operation.id))

    # Effects out of the core

    def _carry_out(self, effects: list[Effect], *, everything: bool = False) -> None:
        """Publishes first, so that all RCs hear; then tells the clients, then answers who asked."""
        touched: set[str] = self.presence.rcs if everything else set()
        revoked: list[Revocation] = []
        for effect in effects:
            if isinstance(effect, (Granted, Revoked)):
                touched.update(effect.rcs)
            if isinstance(effect, Revoked):
                revoked.append(views.revocation(effect, self._name(effect.arc)))
        if touched or everything:
            self._publish(touched, revoked)
        for effect in effects:
            match effect:
                case Granted():
                    self._granted(effect)
                case Revoked():
                    self._revoked(effect)
                case Queued():
                    self._queued(effect)
                case Dropped():
                    self._dropped(effect)
                case Propose():
                    self._propose(effect)
                case WakeAt(at=at):
                    self._set_wake(at)

    def _publish(self, touched: set[str], revoked: list[Revocation]) -> None:
        now = clock.now()
        number = self.core.seq if self.core.seq > self._published else self.core.number()
        for name in touched:
            self._touched[name] = number
        rcs = {name: views.holders(self.core.floor, name, now) for name in sorted(touched)}
        self._say(number, rcs, revoked)

    def _say(self, number: int, rcs: dict[str, list[Holder]], revoked: list[Revocation]) -> None:
        every = self.fleet.timing.heartbeat / SECOND
        self._grants.put(
            Grants(term=self.term, seq=number, prev=self._published, every=every, rcs=rcs, revoked=revoked)
        )
        self._published = number
        self._said_at = clock.now()

    # What presence needs (presence.Reign)

    def repeat(self, rc: str) -> None:
        self._publish({rc}, [])

    def published_at(self, rc: str) -> int:
        return self._touched.get(rc, 0)

    def newer(self, term: Term) -> None:
        if not self._closed:
            self._on_newer(term)

    async def _heartbeat(self) -> None:
        every = self.fleet.timing.heartbeat
        while True:
            due = self._said_at + every - clock.now()
            if due > 0:
                await asyncio.sleep(due / SECOND)
                continue
            self._say(self._published, {}, [])

    def _granted(self, effect: Granted) -> None:
        arc = self.core.floor.running[effect.arc]
        self._tell(arc.id, arc.name, f"granted {', '.join(effect.rcs)}")
        # Its own answer tells the asker; everybody else reads it from the publication.
        if not self._answer(arc.id):
            self._notify(self._of_arc(arc))

    def _revoked(self, effect: Revoked) -> None:
        name = self._name(effect.arc)
        again = "; queued again" if effect.requeued else ""
        self._tell(effect.arc, name, f"{effect.outcome}: {effect.reason}{again}")
        notice = self._notice(
            effect.arc,
            effect.client,
            name,
            "queued" if effect.requeued else "ended",
            reason=effect.reason,
            outcome=effect.outcome,
            by=effect.by,
            grant=effect.grant,
            rcs=list(effect.rcs),
        )
        # An answer tells the client that gave it up; all others read it from the publication.
        if effect.arc not in self._given_up:
            self._notify(notice)
        # What was handed over goes on under its own name.
        if self.core.floor.arc(effect.arc) is None:
            self._remember(effect.arc, notice)

    def _queued(self, effect: Queued) -> None:
        if effect.arc not in self.core.floor.queued or not effect.settled:
            return
        if not self._untold:
            asyncio.get_running_loop().call_later(REASONS_EVERY, self._tell_reasons)
        self._untold.add(effect.arc)
        self._answer(effect.arc)

    def _tell_reasons(self) -> None:
        untold, self._untold = self._untold, set()
        waiting = self.core.floor.queued
        for arc in [waiting[arc] for arc in untold if arc in waiting]:
            self._tell(arc.id, arc.name, f"waits: {arc.reason}")
            if not self._closed:
                self._notify(self._of_arc(arc))

    def _dropped(self, effect: Dropped) -> None:
        name = self._name(effect.arc)
        self._tell(effect.arc, name, f"{effect.outcome}: {effect.reason}")
        notice = self._notice(
            effect.arc, effect.client, name, "ended", reason=effect.reason, outcome=effect.outcome
        )
        self._notify(notice)
        self._remember(effect.arc, notice)
        self._answer(effect.arc)

    def _propose(self, effect: Propose) -> None:
        arcs = ((self.core.floor.arc(arc), params) for arc, params in effect.holders.items())
        holders = [views.proposed(arc, params) for arc, params in arcs if arc is not None]
        proposal = Proposal(proposal=effect.proposal, term=self.term, holders=holders)
        # Overdue is told once; a late answer is still welcome.
        overdue = asyncio.get_running_loop().call_later(
            self.fleet.timing.vote_timeout / SECOND, self.feed, VoteOverdue(effect.proposal)
        )
        voted = partial(self._voted, effect.rc, effect.proposal, overdue)
        try:
            self.mesh.ask_then(self.mesh.keys.vote(effect.rc), proposal, Ballot, voted, timeout=LATE_VOTE)
        except MeshError as error:
            log.warning("%s", error)

    def _voted(
        self, rc: str, proposal: int, overdue: asyncio.TimerHandle, reply: Reply[Ballot] | None
    ) -> None:
        overdue.cancel()
        ballot = reply.message if reply is not None else None
        if ballot is None or ballot.proposal != proposal:
            if reply is not None and reply.problem is not None:
                log.warning("%s did not vote: %s", rc, reply.problem.message)
            self.feed(VoteOverdue(proposal))
        else:
            self.feed(Vote(proposal, ballot.accept, ballot.reason[:500]))

    def _set_wake(self, at: Ns | None) -> None:
        """A timer that goes off too early is left alone: most ends are put off before they come."""
        self._wake_at = at
        if at is None or (self._wake is not None and self._armed <= at):
            return
        if self._wake is not None:
            self._wake.cancel()
        self._armed = at
        delay = max(0.0, (at - clock.now()) / SECOND)
        self._wake = asyncio.get_running_loop().call_later(delay, self._on_wake)

    def _on_wake(self) -> None:
        self._wake = None
        at = self._wake_at
        if at is not None and clock.now() < at:
            self._set_wake(at)
        elif at is not None:
            self.feed(Tick())

    # Words

    def _name(self, arc: ArcId) -> str:
        return self._names.get(arc, views.request_id(arc))

    def _tell(self, arc: ArcId, name: str, text: str) -> None:
        self.story.tell(clock.now(), arc, name, text)
        if not self._unlogged:
            asyncio.get_running_loop().call_later(LOG_EVERY, self._log)
        self._unlogged.append(f"{name} {text}")

    def _log(self) -> None:
        """Writes down what happened lately as one entry: a log that costs as much as a grant is too dear."""
        lines, self._unlogged = self._unlogged, []
        if len(lines) > MAX_LOGGED:
            lines[MAX_LOGGED:] = [f"and {len(lines) - MAX_LOGGED} lines more; ask `zscout why`"]
        if lines:
            log.info("%s", "\n  ".join(lines))

    def _of_arc(self, arc: Arc) -> Notice:
        state: State = "queued" if arc.hold is None else "running"
        hold = arc.hold
        return self._notice(
            arc.id,
            arc.request.client,
            arc.name,
            state,
            priority=arc.request.priority,
            reason=arc.reason,
            place=arc.place,
            ahead=self._ahead(arc) if hold is None else None,
            grant=hold.grant if hold is not None else None,
            rcs=sorted(arc.request.needs),
            remaining=(hold.end - clock.now()) / SECOND if hold is not None else None,
        )

    def _ahead(self, arc: Arc) -> int:
        return sum(1 for other in self.core.floor.queued.values() if other.rank < arc.rank)

    def _notice(self, arc: ArcId, client: str, name: str, state: State, **details: Any) -> Notice:
        self._step += 1
        return Notice(
            id=views.request_id(arc),
            arc=name,
            client=client,
            state=state,
            term=self.term,
            step=self._step,
            **details,
        )

    def _standing(self, arc_id: ArcId, client: str, request_id: str) -> Notice:
        """How a request stands now, as the answer to an operation on it."""
        arc = self.core.floor.arc(arc_id)
        if arc is not None:
            return self._of_arc(arc)
        if arc_id in self._ended:
            return self._ended[arc_id][1]
        return self._notice(arc_id, client, request_id, "ended", reason="no such request is open")

    def _notify(self, notice: Notice) -> None:
        try:
            self.mesh.put(self.mesh.keys.notice(client_of(notice.client)), notice)
        except BadName:
            log.exception("a notice could not be addressed")

    def _answer(self, arc_id: ArcId) -> bool:
        """Answers those who asked for this ARC and wait for the first word about it."""
        requests = self._answers.pop(arc_id, None)
        if requests is None:
            return False
        notice = self._standing(arc_id, arc_id.rpartition("/")[0], views.request_id(arc_id))
        for request in requests:
            request.answer(notice)
        return True

    def _answer_all(self, arcs: list[ArcId]) -> None:
        for arc in arcs:
            self._answer(arc)

    def _known_as(self, client: Sender, request_id: str) -> ArcId:
        """The ARC that a client calls so: its own, or one that was handed over to it."""
        arc = views.arc_id(str(client), request_id)
        return arc if self.core.floor.arc(arc) is not None else self._moved.get(arc, arc)

    def _remember(self, arc: ArcId, notice: Notice) -> None:
        now = clock.now()
        self._names.pop(arc, None)
        if self._moved:
            self._moved = {name: moved for name, moved in self._moved.items() if moved != arc}
        self._ended[arc] = (now + REMEMBER, notice)
        while self._ended and (
            len(self._ended) > MAX_REMEMBERED or next(iter(self._ended.values()))[0] < now
        ):
            self._ended.popitem(last=False)

    # The state

    def _on_state_asked(self, request: Request[StateAsk]) -> None:
        asked, floor, now = request.message, self.core.floor, clock.now()
        holds = [
            views.hold_view(arc, arc.hold, now) for arc in floor.running.values() if arc.hold is not None
        ]
        if asked.holds_only:
            request.answer(RcmState(self.term, self._published, self.mesh.me.host, holds))
            return
        queue = sorted(floor.queued.values(), key=lambda arc: arc.rank)
        request.answer(
            RcmState(
                term=self.term,
                seq=self._published,
                host=self.mesh.me.host,
                holds=holds,
                queue=[views.wait_view(arc, now) for arc in queue[:MAX_LISTED]],
                rcs=views.rc_views(floor),
                story=self.story.of(asked.arc, now) if asked.arc is not None else [],
                more=max(0, len(queue) - MAX_LISTED),
            )
        )

    def spawn(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
