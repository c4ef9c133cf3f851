"""A node's candidacy for the RCM: sees whether somebody leads, and takes over when nobody does.

Taking over (design, section 5): ask the RCs whether they still see a leader; take a term above all that is
known; ask all RCs and clients what stands, which binds the RCs to the new term; lead over that.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import TypeVar

from zscout import clock
from zscout.config import Fleet
from zscout.keyexpr import BadName, Role, Token, client_of, new_instance
from zscout.mesh import Declared, Mesh, Reply
from zscout.messages import ClientRequests, Grants, RcAsk, RcState, absurd
from zscout.scheduling.model import NO_TERM, SECOND, Term
from zscout.services.component_placer import ComponentPlacer
from zscout.services.election import Election
from zscout.services.load_balancer import LoadBalancer
from zscout.services.placement_ledger import PlacementLedger
from zscout.services.rcm import Rcm
from zscout.services.rebuild import rebuild

log = logging.getLogger(__name__)
R = TypeVar("R")

MAX_ATTEMPTS = 3
"""Terms tried in one go when RCs turn out to have promised higher ones."""


class Candidate:
    """Stands by, leads when it must, steps down when a higher term is seen."""

    def __init__(self, mesh: Mesh, fleet: Fleet) -> None:
        self.mesh, self.fleet = mesh, fleet
        # A leader is silent for as long as this when its program hangs but its session lives.
        silence = max(4 * fleet.timing.heartbeat, round(fleet.mesh.lease * SECOND))
        self.election = Election(mesh.me.host, fleet.candidates, silence=silence, now=clock.now())
        self.known: Term = NO_TERM
        """The highest term seen anywhere."""
        self.rcm: Rcm | None = None
        self.balancer: LoadBalancer | None = None
        """Beside the RCM, while this node leads; and so is the placer."""
        self.placer: ComponentPlacer | None = None
        self.ledger = PlacementLedger(mesh)
        self._changed = asyncio.Event()
        self._declared: list[Declared] = []
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self._declared = [
            mesh.subscribe(keys.grants, Grants, self._on_grants),
            mesh.watch(keys.alive_any(Role.RCM), self._on_leader),
            mesh.watch(keys.alive_any(Role.CANDIDATE), self._on_candidate),
            mesh.alive(Token(mesh.me.host, Role.CANDIDATE, mesh.me.client, new_instance())),
        ]
        self.ledger.start()
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        if self.rcm is not None:
            self._stop_leading(self.rcm)
        await self.ledger.stop()
        for declared in self._declared:
            declared.close()

    def _stop_leading(self, rcm: Rcm) -> None:
        rcm.stop()
        self.rcm = None
        if self.placer is not None:
            self.placer.stop()
            self.placer = None
        if self.balancer is not None:
            self.balancer.stop()
            self.balancer = None

    # What is seen

    def _on_grants(self, _key: str, said: Grants) -> None:
        self.election.heard(said.term, clock.now())
        self._see(said.term)

    def _on_leader(self, token: Token, alive: bool) -> None:
        mine = self.rcm is not None and token.instance == self.rcm.term.rcm
        if not mine:
            log.info("%s %s", token.host, "leads" if alive else "does not lead any more")
        self.election.leader(token.instance, alive=alive, now=clock.now())
        self._changed.set()

    def _on_candidate(self, token: Token, alive: bool) -> None:
        self.election.candidate(token.host, alive=alive)
        self._changed.set()

    def _see(self, term: Term) -> None:
        if absurd(term, self.known):
            log.warning("ignored term %d: absurdly far above %d", term.counter, self.known.counter)
            return
        if term > self.known:
            self.known = term
        if self.rcm is not None and term > self.rcm.term:
            log.warning(
                "stepping down: term %d of another RCM is above %d", term.counter, self.rcm.term.counter
            )
            self._stop_leading(self.rcm)
            self._changed.set()

    # Leading

    async def _run(self) -> None:
        while True:
            self._changed.clear()
            now = clock.now()
            at = self.election.next_try(now) if self.rcm is None else None
            if at is not None and at <= now:
                await self._try()
                continue
            try:
                async with asyncio.timeout(None if at is None else (at - now) / SECOND):
                    await self._changed.wait()
            except TimeoutError:
                pass

    async def _try(self) -> None:
        if await self._leader_elsewhere() or not await self._take_over():
            self.election.failed(clock.now())

    async def _leader_elsewhere(self) -> bool:
        """Whether most RCs still see a leader: then it is this candidate that is cut off."""
        timeout = self.fleet.timing.rebuild / SECOND
        replies = await self.mesh.ask(self.mesh.keys.rc_state_any, RcAsk(), RcState, timeout=timeout)
        states = self._credible(replies, lambda state: self.mesh.keys.rc_state(state.rc))
        for state in states:
            self._see(state.term)
        seeing = sum(1 for state in states if state.leader)
        if seeing * 2 > len(states):
            log.info("%d of %d RCs still see a leader: waiting", seeing, len(states))
            return True
        return False

    async def _take_over(self) -> bool:
        timeout = self.fleet.timing.rebuild / SECOND
        keys = self.mesh.keys
        for _ in range(MAX_ATTEMPTS):
            if self.election.sees_leader(clock.now()):
                return False
            term = Term(self.known.counter + 1, new_instance())
            question = RcAsk(promise=term)
            rcs, clients = await asyncio.gather(
                self.mesh.ask(keys.rc_state_any, question, RcState, timeout=timeout),
                self.mesh.ask(keys.requests_any, question, ClientRequests, timeout=timeout),
            )
            problems = [*(reply.problem for reply in rcs), *(reply.problem for reply in clients)]
            for problem in problems:
                if problem is not None and problem.term is not None:
                    self._see(problem.term)
            if self.known > term:
                continue
            asked = self._credible(clients, lambda told: keys.requests(client_of(told.client)))
            self._lead(term, self._credible(rcs, lambda state: keys.rc_state(state.rc)), asked)
            return True
        return False

    def _credible(self, replies: list[Reply[R]], key_of: Callable[[R], str]) -> list[R]:
        """The messages of `replies` that name in themselves whom their key names; others prove nothing."""
        messages = []
        for reply in replies:
            try:
                if reply.message is not None and reply.key == key_of(reply.message):
                    messages.append(reply.message)
            except BadName as error:
                log.warning("ignored an answer on %.200r: %s", reply.key, error)
        return messages

    def _lead(self, term: Term, states: list[RcState], asked: list[ClientRequests]) -> None:
        inheritance = rebuild(states, asked, clock.now())
        self.known = term
        log.info(
            "leading in term %d: %d RCs, %d holds, %d waiting",
            term.counter,
            len(inheritance.rcs),
            len(inheritance.standing),
            len(inheritance.waiting),
        )
        self.rcm = Rcm(self.mesh, self.fleet, term, self._see)
        self.rcm.start(inheritance)
        self.balancer = LoadBalancer(self.mesh)
        self.balancer.start()
        self.placer = ComponentPlacer(self.mesh, self.fleet, term, self.balancer, self.ledger.inherited())
        self.placer.start()
