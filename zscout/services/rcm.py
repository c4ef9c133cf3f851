"""The leading RCM: the scheduling core on the mesh.

Queries become events of the core; its effects become publications, notices and answers, in that order.
Nothing is decided here but what a request may ask for at all.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Sequence
from functools import partial
from typing import Any

from zscout import clock
from zscout.config import Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Declared, Mesh, MeshError, Reply, Request
from zscout.messages import (
    Ballot,
    Grants,
    Holder,
    Operation,
    Proposal,
    RcmState,
    Revocation,
    StateAsk,
)
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.core import Core
from zscout.scheduling.effects import Dropped, Effect, Granted, Propose, Queued, Revoked, WakeAt
from zscout.scheduling.events import Event, LeadTaken, Tick, Vote, VoteOverdue
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import SECOND, Ns, Term
from zscout.scheduling.strategies import STRATEGIES
from zscout.services import views
from zscout.services.desk import Desk
from zscout.services.notices import Notices
from zscout.services.presence import Presence
from zscout.services.rebuild import Inheritance

log = logging.getLogger(__name__)

MAX_LISTED = 1_000
"""Queued ARCs in one answer."""
LATE_VOTE = 2.0
"""Seconds within which a late vote is still heard."""


class Rcm:
    """One reign of one RCM, from taking the lead to giving it up."""

    def __init__(self, mesh: Mesh, fleet: Fleet, term: Term, on_newer: Callable[[Term], None]) -> None:
        self.mesh, self.fleet, self.term = mesh, fleet, term
        self._on_newer = on_newer
        self.core = Core(STRATEGIES[fleet.strategy](), fleet.policy)
        self._gains = 0
        self.notices = Notices(mesh, self.core, term)
        self.presence = Presence(mesh, fleet, self)
        self.desk = Desk(mesh, fleet, self.core, self.notices, self.presence, self._decide)
        self._published = 0
        self._said_at: Ns = 0
        self._touched: dict[str, int] = {}
        self._declared: list[Declared] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._wake: asyncio.TimerHandle | None = None
        self._wake_at: Ns | None = None
        self._armed: Ns = 0
        """When the timer goes off: it may be earlier than it need be."""
        self._closed = False

    # Beginning and end

    def start(self, inheritance: Inheritance) -> None:
        """Begins to lead. Everything that is declared here is declared by the leader only."""
        keys, mesh = self.mesh.keys, self.mesh
        self._grants = mesh.publisher(keys.grants, Grants)
        joined = self.presence.inherit(inheritance.rcs)
        # Who handed over a hold and did not hear that it is done tells of it as well: the RCs know better.
        stands = {(held.place, views.request_id(held.request.arc)) for held in inheritance.standing}
        waiting = [
            one for one in inheritance.waiting if (one.place, views.request_id(one.request.arc)) not in stands
        ]
        for request in (*(held.request for held in inheritance.standing), *(one.request for one in waiting)):
            self.notices.call(request.arc, request.name)
            self.presence.expect(request.client)
        lead = LeadTaken(self.term, tuple(inheritance.standing), tuple(waiting))
        effects = self.core.handle(clock.now(), *joined, lead)
        # RCs hear of the new term first; full lists end whatever was found to be half a gang.
        self._published = 0
        self._carry_out(effects, everything=True)
        token = Token(mesh.me.host, Role.RCM, mesh.me.client, self.term.rcm)
        self._declared += [
            mesh.serve(
                keys.schedule_any, Operation, self.desk.on_operation, limit=self.fleet.limits.max_payload
            ),
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
        self.notices.close()
        for task in list(self._tasks):
            task.cancel()
        self.desk.close()
        self._grants.close()

    # Events into the core

    def feed(self, *events: Event) -> None:
        """Gives the core one instant's events and carries out what follows."""
        self.desk.decide()
        self._decide(events)

    def _decide(self, events: Sequence[Event]) -> None:
        if not self._closed:
            self._carry_out(self.core.handle(clock.now(), *events))
            self._log_gain()

    def _log_gain(self) -> None:
        """Says where a search has beaten the heuristic, and at what cost."""
        strategy = self.core.strategy
        if isinstance(strategy, Adaptive) and strategy.statistics.gains > self._gains:
            self._gains = strategy.statistics.gains
            log.info("adaptive: %s", strategy.statistics.last)

    # Effects out of the core

    def _carry_out(self, effects: list[Effect], *, everything: bool = False) -> None:
        """Publishes first, so that all RCs hear; then tells the clients, then answers who asked."""
        touched: set[str] = self.presence.rcs if everything else set()
        revoked: list[Revocation] = []
        for effect in effects:
            if isinstance(effect, (Granted, Revoked)):
                touched.update(effect.rcs)
            if isinstance(effect, Revoked):
                revoked.append(views.revocation(effect, self.notices.name(effect.arc)))
        if touched or everything:
            self._publish(touched, revoked)
        for effect in effects:
            match effect:
                case Granted(arc=arc):
                    self.notices.granted(effect, answered=self.desk.waiting(arc))
                    self.desk.answer(arc)
                case Revoked(arc=arc):
                    self.notices.revoked(effect, answered=self.desk.given_up(arc))
                case Queued(arc=arc, settled=True) if arc in self.core.floor.queued:
                    self.notices.waits(arc)
                    self.desk.answer(arc)
                case Queued():
                    pass
                case Dropped(arc=arc):
                    self.notices.dropped(effect)
                    self.desk.answer(arc)
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
        starts = forecast(self.core, now).starts if asked.forecast else {}
        request.answer(
            RcmState(
                term=self.term,
                seq=self._published,
                host=self.mesh.me.host,
                holds=holds,
                queue=[
                    views.wait_view(arc, self.core.reason(arc), now, starts.get(arc.id))
                    for arc in queue[:MAX_LISTED]
                ],
                rcs=views.rc_views(floor),
                story=self.notices.story.of(asked.arc, now) if asked.arc is not None else [],
                more=max(0, len(queue) - MAX_LISTED),
            )
        )

    def spawn(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
