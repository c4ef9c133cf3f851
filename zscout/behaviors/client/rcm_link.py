"""A client's link to the RCM: follows leaders and their terms, and submits the client's requests.

A request is sent until an RCM answers, and again every few seconds. If no RCM publishes for the hold lease, holds end
here, as they do at their RCs.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Final, NoReturn

import msgspec

from zscout.behaviors.client.request import OpenArc, RequestRefused, RequestStore
from zscout.config.fleet import Fleet
from zscout.keyexpr import RANDOM, USERS, Role, Token
from zscout.mesh import Declaration, IncomingQuery, Mesh, Refused, Reply
from zscout.mesh.exchange import naming_versions
from zscout.mesh.renewal import SILENT_RCM_PATIENCE
from zscout.mesh.supervision import StallWatch, Supervisor, done_within
from zscout.mesh.terms import LastTerms
from zscout.messages import (
    Cancel,
    ClientRequests,
    Notice,
    Operation,
    Problem,
    RcAsk,
    RcmState,
    Release,
    StateAsk,
    absurd,
)
from zscout.types import NO_TERM, SECOND, Ns, Term

log = logging.getLogger(__name__)

QUERY_TIMEOUT = 1.0
ASK_AGAIN = 5.0
"""Seconds after which an open request is submitted again, give or take a fifth."""
BACKOFF = (0.05, 1.0)
"""Seconds before an unanswered query is repeated: first and longest."""
END_TRIES = 3
TRY_AGAIN = frozenset({"busy", "not_leading", "internal", "queue_full", "old_term"})
DEPOSED = frozenset({"not_leading", "old_term"})
"""Problem codes from an RCM that has been replaced."""
CHECKS_PER_LEASE = 10
"""Checks for publications of an RCM per hold lease."""
LEADERLESS: Final = 5.0
"""Seconds within which an election ends."""


class _TermOnly(msgspec.Struct, frozen=True):
    """The part of an RCM's publications that a client reads."""

    term: Term


class RcmLink:
    def __init__(self, mesh: Mesh, fleet: Fleet, store: RequestStore, supervisor: Supervisor) -> None:
        self.mesh, self.fleet, self.store, self._supervisor = mesh, fleet, store, supervisor
        self.key = mesh.keys.schedule(mesh.me)
        self.term: Term = NO_TERM
        """The highest term received or promised; messages of lower terms are ignored."""
        self._received_term: Term = NO_TERM
        """The highest term received from a leader, without promises to candidates."""
        self._lower_leader: tuple[Term, Ns] = NO_TERM, 0
        """A lower term in which a leader publishes, and the time since when."""
        self._unanswered = False
        """True if the last query had no answer of a current RCM."""
        self._rcm_is_behind = False
        """True if the last answer was of a lower term: the next query then informs its RCM of the higher one."""
        self.leader_came = asyncio.Event()
        self._leaders: set[Token] = set()
        self._changes = 0
        """How often a leader appeared, or one of several disappeared."""
        self._last_contact: Ns = mesh.now()
        self._unseen_since: Ns = mesh.now()
        """When the last visible leader disappeared."""
        self._stall = StallWatch(mesh.now)
        self._last_terms = LastTerms(mesh, supervisor, self._raise_term, timeout=QUERY_TIMEOUT)

    def start(self) -> list[Declaration]:
        keys, mesh = self.mesh.keys, self.mesh
        self._published = mesh.poll_latest(keys.grants, _TermOnly)
        return [
            mesh.serve(keys.requests(mesh.me), RcAsk, self._on_requests),
            self._published,
            mesh.watch(keys.alive_any(Role.RCM), self._on_leader),
            Declaration(self._stall.start().stop),
        ]

    @property
    def leader(self) -> str | None:
        """The host of the leading node; None if no RCM is visible."""
        return next((token.host for token in sorted(self._leaders)), None)

    def accept(self, term: Term, *, promise: bool = False, above: bool = False) -> bool:
        """Return True if messages of `term` count, and keep the highest. `promise`: the term is a candidate's. `above`:
        accept even an absurdly high term, as an RC already obeys one."""
        if term < self.term and not promise and self._only_promised(term):
            self._go_back(term)
        if term < self.term or absurd(term, self.term, heard=self._in_contact and not above):
            self._last_terms.shown(term, self.term)
            return False
        self.term = term
        if not promise:
            self._received_term = term
        return True

    def _only_promised(self, term: Term) -> bool:
        """Return True if a leader of `term` is visible and the highest term is only a promise to a candidate."""
        newer = self._received_term < term and self._received_term < self.term
        return self.mesh.keys.closed and newer and any(token.instance == term.rcm for token in self._leaders)

    async def _follow_lower(self, terms: list[Term]) -> None:
        """Return to a visible leader of a lower term that RCs obey, if none of the highest published for a hold lease.
        Only with certificates: without them the fleet moves above the highest term instead."""
        now, lease = self.mesh.now(), self.fleet.timing.hold_lease
        term = max(terms, default=NO_TERM)
        if not self.mesh.keys.closed or self._in_contact or term >= self.term:
            self._lower_leader = NO_TERM, now
        elif term > NO_TERM:
            if term != self._lower_leader[0]:
                self._lower_leader = term, now
            seen = any(token.instance == term.rcm for token in self._leaders)
            if now - self._lower_leader[1] >= lease and seen and await self._is_obeyed(term) and term < self.term:
                self._go_back(term)

    async def _is_obeyed(self, term: Term) -> bool:
        ask, key = StateAsk(devices_only=True), self.mesh.keys.ask_state(self.mesh.me)
        replies = await self.mesh.ask(key, ask, RcmState, timeout=QUERY_TIMEOUT)
        states = [reply.message for reply in replies if reply.message is not None]
        return any(state.term == term and any(rc.present for rc in state.rcs) for state in states)

    def _go_back(self, term: Term) -> None:
        log.warning("back from term %d to the leader of term %d", self.term.counter, term.counter)
        self.term = self._received_term = term
        self._rcm_is_behind = False
        self.store.go_back(term)
        self._changes += 1
        self.leader_came.set()

    def _raise_term(self, term: Term) -> None:
        self.term = max(self.term, term)

    @property
    def stalled(self) -> bool:
        """True just after a stall of this process, in which it may have missed answers."""
        return self._stall.fresh()

    @property
    def _in_contact(self) -> bool:
        return self.mesh.now() - self._last_contact < self.fleet.timing.hold_lease

    @property
    def _contact_is_fresh(self) -> bool:
        return self.mesh.now() - self._last_contact < self.fleet.timing.hold_lease // 2

    @property
    def who(self) -> str:
        return "the leader" if self.leader is None else f"the leader at {self.leader}"

    @property
    def _publishes_unseen(self) -> bool:
        """True if an RCM has published since the last token of one disappeared."""
        return self.leader is None and self._last_contact > self._unseen_since

    async def leader_within(self, seconds: float) -> bool:
        """Wait for a leader to appear after `leader_came` was cleared; return False if none has within `seconds`."""
        return await done_within(seconds, self.leader_came.wait())

    def _on_requests(self, request: IncomingQuery[RcAsk]) -> None:
        if request.message.above is None:
            self._promise(request, above=False)
        else:
            self._supervisor.spawn(self._promise_above(request, request.message.above))

    async def _promise_above(self, request: IncomingQuery[RcAsk], host: str) -> None:
        seen = await self.mesh.living(self.mesh.keys.alive_any(Role.CANDIDATE), timeout=QUERY_TIMEOUT)
        try:
            self._promise(request, above=any(token.host == host for token in seen))
        except Refused as refused:
            request.refuse(refused.problem)

    def _promise(self, request: IncomingQuery[RcAsk], *, above: bool) -> None:
        promise = request.message.promise
        promised = promise is None or self.accept(promise, promise=True, above=above)
        if not promised and not request.message.ordinary:
            raise Refused("old_term", f"this client obeys term {self.term.counter}", self.term)
        request.answer(ClientRequests(client=str(self.mesh.me), requests=self.store.open_requests(), term=self.term))

    def _on_leader(self, token: Token, alive: bool) -> None:
        (self._leaders.add if alive else self._leaders.discard)(token)
        if not self._leaders:
            self._unseen_since = self.mesh.now()
        if self._leaders:
            self._changes += 1
            # Also if one of two has gone: the answer of the remaining leader may have arrived second, and be lost.
            self.leader_came.set()

    async def watch_lease(self) -> NoReturn:
        """End holds when no RCM has published for the hold lease, as their RCs do."""
        lease, suspect = self.fleet.timing.hold_lease, self.mesh.suspicions.suspect
        while True:
            await asyncio.sleep(lease / SECOND / CHECKS_PER_LEASE)
            now = self.mesh.now()
            # As at the RCs, an RCM that was replaced, or has an absurd term, keeps no hold alive.
            published = [publication.term for _, publication in self._published.each()]
            await self._follow_lower(published)
            if [term for term in published if self.accept(term)]:
                # The RCM may have published right after the last check.
                self._last_contact = now - lease // CHECKS_PER_LEASE
            seen = self.leader is not None and not self.stalled
            silent = now - self._last_contact >= lease // 2
            suspect("an RCM is seen that does not publish", so=seen and silent, patience=SILENT_RCM_PATIENCE)
            if now - self._last_contact < lease or self.stalled:
                continue
            for arc in self.store.open:
                if arc.state == "running":
                    arc._lose("no leader published within the hold lease", now)
                    self.store.notify(arc)

    async def query(self, operation: Operation) -> Reply[Notice] | None:
        """The answer, preferably of a current RCM. None: none came, and the operation may have been carried out."""
        replies = await self.mesh.ask(self.key, operation, Notice, timeout=QUERY_TIMEOUT, enough=self._is_current)
        if not replies or not self._contact_is_fresh or self.mesh.suspicions.any:
            await self._look_for_contradictions(silent=not replies)
        reply = max(replies, key=self._is_current, default=None)
        return reply if reply is None or reply.problem is None else naming_versions(reply, self.who)

    def _is_current(self, reply: Reply[Notice]) -> bool:
        if reply.message is not None:
            return reply.message.term >= self.term
        return reply.problem is None or reply.problem.code not in DEPOSED

    async def _look_for_contradictions(self, *, silent: bool) -> None:
        """Suspect the mesh session if the leader's token, publications and answers contradict each other, or if
        candidates are visible and none leads for long."""
        heard, suspect = self._contact_is_fresh, self.mesh.suspicions.suspect
        # A leader that has died published of late, too.
        there = self.leader is not None or (heard and self._publishes_unseen)
        suspect("an RCM is seen that does not answer", so=silent and there)
        suspect("an RCM answers that does not publish", so=not silent and not heard)
        candidates = self.mesh.keys.alive_any(Role.CANDIDATE)
        missed = silent and not there and await self.mesh.living(candidates, timeout=QUERY_TIMEOUT)
        suspect("candidates are seen, and no RCM", so=bool(missed), patience=LEADERLESS)

    async def submit(self, arc: OpenArc) -> None:
        """Submit a request until an RCM has answered; wait while the client is paused. Raises RequestRefused."""
        if self.mesh.keys.closed and (why := self.fleet.access.refusal(self.mesh.me.host, "request devices", USERS)):
            # Access control drops such queries: there would be no answer.
            arc.state = "refused"
            raise RequestRefused(Problem("not_allowed", why))
        pause, longest = BACKOFF
        while arc.state == "asking":
            await self.store.resumed.wait()
            self.leader_came.clear()
            problem = await self.ask(arc)
            if arc.state != "asking":
                return
            if problem is not None:
                arc.reason = problem.message
                if problem.code not in TRY_AGAIN:
                    arc.state = "refused"
                    raise RequestRefused(problem)
            elif self.leader is None:
                arc.reason = "no leader is on the mesh; start zscout-node"
            self.store.notify(arc)
            if not await self.leader_within(pause * RANDOM.get().uniform(0.8, 1.2)):
                pause = min(longest, pause * 2)

    async def ask(self, arc: OpenArc, *, reachable: bool = False) -> Problem | None:
        """Submit a request once, and apply the answer. Return the problem if it was refused."""
        ask = arc._ask(self.mesh.now(), reachable=reachable)
        # With `term`, an RCM that was replaced learns so; it would refuse a place of a later RCM as impossible.
        show_term = self._rcm_is_behind or arc._place is not None
        reply = await self.query(msgspec.structs.replace(ask, term=self.term) if show_term else ask)
        if reply is None:
            self._unanswered = True
            return None
        if reply.message is not None:
            self._rcm_is_behind = reply.message.term < self.term
            # Neither an answer of a replaced RCM counts, nor one in an absurd term.
            self._unanswered = not self.accept(reply.message.term)
            if not self._unanswered:
                self.store.take(arc, reply.message)
        else:
            self._unanswered = False
            self._rcm_is_behind = reply.problem is not None and reply.problem.code == "old_term"
        return reply.problem

    async def keep_asking(self) -> NoReturn:
        """Repeat all requests and withdrawals at every change of the RCM and every few seconds; every second while a
        visible RCM does not answer, or publications of an invisible RCM arrive."""
        unanswered, known = False, self._changes
        while True:
            varied = RANDOM.get().uniform(0.8, 1.2) if self._changes == known else 0.0
            pause, step = ASK_AGAIN * varied, BACKOFF[1] * varied
            while self._changes == known and pause > 0:
                self.leader_came.clear()
                await self.leader_within(min(step, pause))
                pause -= step
                # A leader that publishes and is not visible may have ended a hold without notifying this client.
                if self._publishes_unseen or (unanswered and self.leader is not None):
                    break
            unanswered, known = False, self._changes
            for arc in self.store.open:
                if arc.open and self.store.resumed.is_set():
                    problem = await self.ask(arc)
                    unanswered |= self._unanswered
                    if problem is not None and problem.code not in TRY_AGAIN and arc.state == "queued":
                        # It would be refused each time, though an earlier RCM accepted it.
                        self.store.withdrawn[arc.id] = Cancel(id=arc.id)
                        arc._finish("lost", f"the leader refuses it: {problem.message}", self.mesh.now())
                        self.store.notify(arc)
                        self.store.forget(arc)
            for request_id in list(self.store.withdrawn):
                if not await self._withdraw(request_id):
                    unanswered = True
                    break

    async def end(self, arc: OpenArc) -> None:
        """Give back a hold, or leave the queue. Return once answered, or after a few tries; `keep_asking` continues."""
        running = arc.state == "running"
        # `left`: its program has left the devices.
        self.store.withdrawn[arc.id] = (Release if running else Cancel)(id=arc.id, left=True)
        arc._finish("released" if running else "cancelled", "given up by this client", self.mesh.now())
        self.store.notify(arc)
        for _ in range(END_TRIES):
            if await self._withdraw(arc.id) or self.leader is None:
                break
        self.store.forget(arc)

    async def give_back(self, operation: Release | Cancel) -> None:
        """Withdraw a request that this client does not have any more."""
        self.store.withdrawn[operation.id] = operation
        await self._withdraw(operation.id)

    async def _withdraw(self, request_id: str) -> bool:
        """Return True if no withdrawal is pending any more."""
        if (operation := self.store.withdrawn.get(request_id)) is None:
            return True
        reply = await self.query(operation)
        if reply is None or (reply.problem is not None and reply.problem.code in TRY_AGAIN):
            return False
        self.store.withdrawn.pop(request_id, None)
        return True
