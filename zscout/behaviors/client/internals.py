"""What zscout's own modules do with a client, beside what programs do with it: `Client.internals`.

Its time on the mesh, from its token on; how it moves (`handover.py`); and what becomes of a hold whose body is run by
`arc.py`, `blocking.py` or a command."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Mapping
from typing import Any, Final

from msgspec.structs import replace

from zscout.behaviors.client.confirmation import DEAF, NOT_HELD, Confirmations
from zscout.behaviors.client.direct import DirectHold
from zscout.behaviors.client.handover import MovableClient
from zscout.behaviors.client.request import CommandRefused, OpenArc
from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token, new_instance
from zscout.mesh import Declaration, Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import Cancel, Command, Done, Notice, Problem, Release
from zscout.types import SECOND, Grant, Ns, Term

LAST_WORD: Final = 0.5
"""Seconds at most for which a client that closes tells RCs that its programs are gone."""
REJOINS: Final = 0.5
"""Seconds for which a command is sent again that ended without an answer: others know a new session by then."""
AGAIN: Final = 0.05
TOLD_WITHIN: Final = 1.0
"""Seconds within which a notice says so too; else the RC is believed."""
RENEW_TOKEN: Final[Ns] = SECOND // 2
"""A client that is dropped again after its token was renewed renews it no sooner."""


class ClientInternals(MovableClient):
    """Of one client."""

    def __init__(self, mesh: Mesh, fleet: Fleet) -> None:
        super().__init__(mesh, fleet, Supervisor(f"client {mesh.me}", self._failed))
        self.confirmations = Confirmations(
            mesh, fleet, self.store, self.rcm, self.supervisor, self.command, self._ask_soon
        )
        self.leaving: asyncio.Task[None] | None = None
        self.instance = ""
        """Of its token."""
        self._declared: list[Declaration] = []
        self._token: Declaration | None = None
        self._shown: Ns = 0
        """When the present token was declared."""
        self._commanded = itertools.count(1)
        self._denied: set[Grant] = set()
        """Grants that an RC says are over, and no notice yet."""
        self._expired: set[str] = set()
        """Ids of ARCs that are over by this host's clock, and by no notice yet."""

    # On the mesh

    def start(self) -> None:
        """Declares on the mesh what a client has."""
        keys, mesh = self.mesh.keys, self.mesh
        self._declared = [mesh.subscribe(keys.notice(mesh.me), Notice, self._on_notice), *self.rcm.start()]
        mesh.watch_links()
        self._renew_token()
        self.supervisor.spawn(self.rcm.keep_asking())
        self.supervisor.spawn(self.rcm.watch_lease())

    def _renew_token(self) -> None:
        """Shows that this client lives, by a token that nobody can have taken for gone."""
        mesh = self.mesh
        self.instance = new_instance()
        token = mesh.alive(Token(mesh.me.host, Role.CLIENT, mesh.me.client, self.instance))
        if self._token is not None:
            self._token.close()
        self._token, self._shown = token, mesh.now()

    def _ask_soon(self, arc: OpenArc) -> None:
        # All that was dropped together is asked for with one token.
        if arc.outcome == "client_lost" and self.mesh.now() - self._shown > RENEW_TOKEN:
            self._renew_token()
        super()._ask_soon(arc)

    async def close(self) -> None:
        """Gives back everything and leaves the mesh."""
        try:
            if self.leaving is None:
                self.store.resumed.set()
                self._may_end.set()
                await self.supervisor.close()
                await asyncio.gather(*(self.end(arc) for arc in self.store.open))
                if telling := self.confirmations.telling:
                    await asyncio.wait(telling, timeout=LAST_WORD)
        finally:
            await self.leave()

    async def leave(self) -> None:
        """Leaves the mesh without ending anything or giving it back: for who has handed over all. What is
        still this client's goes when the RCM sees that its token has gone."""
        self.leaving = self.leaving or asyncio.create_task(self._leave())
        # Its token must go even if the caller is cancelled.
        await asyncio.shield(self.leaving)

    async def _leave(self) -> None:
        self._may_end.set()
        try:
            await self.supervisor.close()
        finally:
            for telling in self.confirmations.telling:
                telling.cancel()
            for declared in (*filter(None, [self._token]), *reversed(self._declared)):
                declared.close()
            await self.mesh.close()

    def _failed(self, error: Exception) -> None:
        """A task of this client failed: its holds end here, and at the RCM when its token has gone."""
        for arc in self.store.open:
            arc._finish("lost", f"this client failed: {error!r}", self.mesh.now())
            self.store.notify(arc)
        self.leaving = self.leaving or asyncio.create_task(self._leave())

    @property
    def term(self) -> Term:
        """The highest term received or promised; what is of an older one is ignored."""
        return self.rcm.term

    # Its holds

    def watch(self, watcher: Callable[[OpenArc], None]) -> None:
        """Calls `watcher(arc)` whenever there is news of any of this client's requests."""
        self.store.watchers.append(watcher)

    async def confirmed(self, arc: OpenArc) -> bool:
        """Waits until all RCs of the present grant have confirmed it. False: they do not, or it is over."""
        if (grant := arc.grant) is None:
            return False
        confirmation = self.confirmations.begin(arc, grant)
        await confirmation.over()
        return arc.grant == grant and confirmation.all

    def direct_hold(self, grant: Grant) -> DirectHold | None:
        """For who runs the program of a direct request: how long its hold may be relied on, and what is to be told when
        the program is gone. None where the request was not direct, or that has been told."""
        return self.confirmations.direct(grant)

    async def end(self, arc: OpenArc) -> None:
        """Gives back a hold, or leaves the queue: once the client is no longer paused, if that was not handed over
        then. The program of a direct one is gone by then. Tried a few times; the RCM sees our token die otherwise."""
        await self._may_end.wait()
        if self.leaving is not None:
            return
        if arc.state == "moved":
            self.store.forget(arc)
            return
        self.confirmations.program_is_gone(arc)
        await self.rcm.end(arc)

    def complete(self, arc: OpenArc) -> None:
        """An ARC has had its time by this host's clock, and its body has returned; RCs and RCM end it by theirs."""
        self.confirmations.program_is_gone(arc)
        self.expire(arc)

    def expire(self, arc: OpenArc) -> None:
        """An ARC has had its time by this host's clock: it is not asked for any more, though a direct body may clear
        up yet."""
        if arc.grant is not None:
            self._expired.add(arc.id)
            self.supervisor.call_later(TOLD_WITHIN, self._give_up, arc.id)
        arc._finish("completed", "its minimum runtime is over", self.mesh.now())
        self.store.notify(arc)
        self.store.forget(arc)

    def _give_up(self, request_id: str) -> None:
        """No notice has reported the end of a hold that is over by this host's clock. The leader may have granted it
        again meanwhile, and that notice was lost."""
        expired = request_id in self._expired
        self._expired.discard(request_id)
        if expired and request_id not in self.store.arcs:  # it may have been asked for anew
            self.supervisor.spawn(self.rcm.give_back(Release(id=request_id)))

    # Commands, and notices

    async def command(
        self, rc: str, grant: Grant, do: Mapping[str, Any], *, ttl: float = 1.0, timeout: float = 2.0
    ) -> Done:
        """Have an RC carry out a command once. Raises CommandRefused."""
        key = self.mesh.keys.command(rc, self.mesh.me)
        id_ = f"{self.instance}-{next(self._commanded)}"
        command = Command(grant=grant, do=dict(do), ttl=ttl, id=id_)
        began, gone = self.mesh.now(), 0.0
        lost: float | None = None
        while (
            reply := await self.mesh.ask_one(key, replace(command, ttl=ttl - gone), Done, timeout=timeout - gone)
        ) is None:
            gone = (self.mesh.now() - began) / SECOND + AGAIN
            lost = gone if lost is None else lost  # a session that closes ends what was under way for long
            if gone >= min(timeout, ttl, lost + REJOINS):
                if lost < timeout:  # nobody was found who takes it
                    self.supervisor.spawn(self.confirmations.look_at_silence(rc, DEAF, silent=True))
                raise CommandRefused(rc, Problem("unknown", "no answer; it may or may not have been done"))
            # It ended early: its RC's process may be joining the mesh anew. Under one id it is done once.
            await asyncio.sleep(AGAIN)
        self.mesh.suspicions.suspect(f"{rc} {DEAF}", so=False)
        if reply.message is None:
            refused = CommandRefused(rc, reply.problem or Problem("unknown", "no reason given"))
            arc = next((arc for arc in self.store.open if arc.grant == grant), None)
            if refused.code in NOT_HELD and arc is not None and grant not in self._denied:
                self._denied.add(grant)
                self.supervisor.call_later(TOLD_WITHIN, self._lose, arc, grant, str(refused))
            raise refused
        return reply.message

    def _lose(self, arc: OpenArc, grant: Grant, reason: str) -> None:
        """An RC of this grant does not know it any more, and no notice has said so."""
        self._denied.discard(grant)
        if arc.grant == grant and arc.id in self.store.arcs and self.store.resumed.is_set():
            arc._lose(reason, self.mesh.now())
            self.store.notify(arc)
            self.supervisor.spawn(self.ask_again(arc))

    def _on_notice(self, _key: str, notice: Notice) -> None:
        if not self.rcm.accept(notice.term):
            return
        if notice.state == "ended":
            self._expired.discard(notice.id)
        if (arc := self.store.arcs.get(notice.id)) is not None:
            self.store.take(arc, notice)
        elif not self.take_moving(notice) and notice.id not in self.store.withdrawn:
            # What nobody here asked for, or what was over here before an RCM that took the lead heard of it.
            if notice.state == "running":
                self.supervisor.spawn(self.rcm.give_back(Release(id=notice.id)))
            elif notice.state == "queued":
                self.supervisor.spawn(self.rcm.give_back(Cancel(id=notice.id)))
