"""What a client hears: who leads, in which term, and whether an RCM still speaks."""

from __future__ import annotations

import asyncio
from typing import NoReturn

import msgspec

from zscout import clock
from zscout.behaviors.book import Book
from zscout.config import Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Declared, Mesh, Refused, Request
from zscout.messages import ClientRequests, RcAsk, absurd
from zscout.scheduling.model import NO_TERM, SECOND, Ns, Term
from zscout.stall import StallWatch

LOOKS = 10
"""How often within a hold lease a client looks whether the RCM spoke."""


class _Spoken(msgspec.Struct, frozen=True):
    """What a client reads of the RCM's publications."""

    term: Term


class Hearing:
    """Follows the RCM for one client; answers it when it takes the lead."""

    def __init__(self, mesh: Mesh, fleet: Fleet, book: Book) -> None:
        self.mesh, self.fleet, self.book = mesh, fleet, book
        self.term: Term = NO_TERM
        """The highest term heard or promised; older words are ignored."""
        self.leader_came = asyncio.Event()
        self._leaders: set[Token] = set()
        self._heard: Ns = clock.now()
        self._stall = StallWatch()

    def start(self) -> list[Declared]:
        self._stall.start()
        keys, mesh = self.mesh.keys, self.mesh
        self._spoken = mesh.overhear(keys.grants, _Spoken)
        return [
            mesh.serve(keys.requests(mesh.me), RcAsk, self._on_requests),
            self._spoken,
            mesh.watch(keys.alive_any(Role.RCM), self._on_leader),
        ]

    def stop(self) -> None:
        self._stall.stop()

    @property
    def leader(self) -> str | None:
        """The host whose node leads, or None where no RCM is seen."""
        return next((token.host for token in sorted(self._leaders)), None)

    def believe(self, term: Term) -> bool:
        """Whether what is said in `term` counts; the highest term is kept."""
        if term < self.term or absurd(term, self.term):
            return False
        self.term = term
        return True

    async def leader_within(self, seconds: float) -> bool:
        """Waits so long for a leader to appear since `leader_came` was cleared. False: none did."""
        try:
            async with asyncio.timeout(seconds):
                return await self.leader_came.wait()
        except TimeoutError:
            return False

    def _on_requests(self, request: Request[RcAsk]) -> None:
        promise = request.message.promise
        if promise is not None and not self.believe(promise):
            raise Refused("old_term", f"this client obeys term {self.term.counter}", self.term)
        request.answer(ClientRequests(client=str(self.mesh.me), requests=self.book.told()))

    def _on_leader(self, token: Token, alive: bool) -> None:
        if alive:
            self._leaders.add(token)
            self.leader_came.set()
        else:
            self._leaders.discard(token)

    async def watch_lease(self) -> NoReturn:
        """Ends holds when no RCM was heard for the hold lease: their RCs have ended them as well."""
        lease = self.fleet.timing.hold_lease
        while True:
            await asyncio.sleep(lease / SECOND / LOOKS)
            if self._rcm_spoke():
                # It may have spoken right after the last look.
                self._heard = clock.now() - lease // LOOKS
            if clock.now() - self._heard < lease or self._stall.fresh():
                continue
            for arc in self.book.open:
                if arc.state == "running":
                    arc.lose("no RCM was heard for the hold lease", clock.now())
                    self.book.wake(arc)

    def _rcm_spoke(self) -> bool:
        # As at the RCs: one that was replaced, or that nobody can believe, keeps no hold alive.
        terms = [said.term for said in self._spoken.take()]
        return any(term >= self.term and not absurd(term, self.term) for term in terms)
