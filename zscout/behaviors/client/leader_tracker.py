"""Who leads, in which term, and whether an RCM still publishes: what a client knows of the RCM."""

from __future__ import annotations

import asyncio
from typing import NoReturn

import msgspec

from zscout.behaviors.client.request import RequestStore
from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Declaration, IncomingQuery, Mesh, Refused
from zscout.mesh.stall import StallWatch
from zscout.messages import ClientRequests, RcAsk, absurd
from zscout.types import (
    NO_TERM,
    SECOND,
    Ns,
    Term,
)

LOOKS = 10
"""How often within a hold lease a client checks whether an RCM published."""


class _TermOnly(msgspec.Struct, frozen=True):
    """What a client reads of the RCM's publications."""

    term: Term


class LeaderTracker:
    """Follows the RCM for one client; answers it when it takes the lead."""

    def __init__(self, mesh: Mesh, fleet: Fleet, store: RequestStore) -> None:
        self.mesh, self.fleet, self.store = mesh, fleet, store
        self.term: Term = NO_TERM
        """The highest term received or promised; what is of an older one is ignored."""
        self.leader_came = asyncio.Event()
        self._leaders: set[Token] = set()
        self._last_contact: Ns = mesh.now()
        self._stall = StallWatch(mesh.now)

    def start(self) -> list[Declaration]:
        self._stall.start()
        keys, mesh = self.mesh.keys, self.mesh
        self._published = mesh.overhear(keys.grants, _TermOnly)
        return [
            mesh.serve(keys.requests(mesh.me), RcAsk, self._on_requests),
            self._published,
            mesh.watch(keys.alive_any(Role.RCM), self._on_leader),
        ]

    def stop(self) -> None:
        self._stall.stop()

    @property
    def leader(self) -> str | None:
        """The host whose node leads, or None where no RCM is seen."""
        return next((token.host for token in sorted(self._leaders)), None)

    def accept(self, term: Term) -> bool:
        """Whether what is of `term` counts; the highest term is kept."""
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

    def _on_requests(self, request: IncomingQuery[RcAsk]) -> None:
        promise = request.message.promise
        if promise is not None and not self.accept(promise):
            raise Refused("old_term", f"this client obeys term {self.term.counter}", self.term)
        request.answer(ClientRequests(client=str(self.mesh.me), requests=self.store.open_requests()))

    def _on_leader(self, token: Token, alive: bool) -> None:
        if alive:
            self._leaders.add(token)
            self.leader_came.set()
        else:
            self._leaders.discard(token)

    async def watch_lease(self) -> NoReturn:
        """Ends holds when no RCM published for the hold lease: their RCs have ended them as well."""
        lease = self.fleet.timing.hold_lease
        while True:
            await asyncio.sleep(lease / SECOND / LOOKS)
            now = self.mesh.now()
            if self._rcm_published():
                # It may have done so right after the last check.
                self._last_contact = now - lease // LOOKS
            if now - self._last_contact < lease or self._stall.fresh():
                continue
            for arc in self.store.open:
                if arc.state == "running":
                    arc.lose("no RCM was heard for the hold lease", now)
                    self.store.notify(arc)

    def _rcm_published(self) -> bool:
        # As at the RCs: one that was replaced, or whose term is absurd, keeps no hold alive.
        terms = [one.term for one in self._published.take()]
        return any(term >= self.term and not absurd(term, self.term) for term in terms)
