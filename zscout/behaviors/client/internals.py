"""`Client.internals`: the part of a client for zscout's own modules, not for programs.

It joins and leaves the mesh, hands requests over (`handover.py`), and ends the holds whose bodies `arc.py`,
`blocking.py` or a command run."""

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

CLOSING_REPORT_TIMEOUT: Final = 0.5
"""Longest time in seconds for which a closing client still reports to RCs that its programs are gone."""
REJOIN_TIMEOUT: Final = 0.5
"""Seconds for which a command without an answer is repeated: others learn of a new mesh session within that time."""
REPEAT_AFTER: Final = 0.05
"""Seconds between two such repetitions."""
NOTICE_TIMEOUT: Final = 1.0
"""Seconds to wait for a notice of a hold's end; after that, an RC's answer or this host's clock counts."""
TOKEN_RENEWAL_INTERVAL: Final[Ns] = SECOND // 2
"""Shortest time in ns between two renewals of the token."""


class ClientInternals(MovableClient):
    def __init__(self, mesh: Mesh, fleet: Fleet) -> None:
        super().__init__(mesh, fleet, Supervisor(f"client {mesh.me}", self._failed))
        self.confirmations = Confirmations(
            mesh, fleet, self.store, self.rcm, self.supervisor, self.command, self._ask_soon
        )
        self.leaving: asyncio.Task[None] | None = None
        self.instance = ""
        """The instance in its token."""
        self._declared: list[Declaration] = []
        self._token: Declaration | None = None
        self._token_declared_at: Ns = 0
        """When the present token was declared."""
        self._command_numbers = itertools.count(1)
        self._denied: set[Grant] = set()
        """Grants that are over by an RC's answer, and not yet by a notice."""
        self._expired: set[str] = set()
        """Ids of ARCs that are over by this host's clock, and not yet by a notice."""

    def start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self._declared = [mesh.subscribe(keys.notice(mesh.me), Notice, self._on_notice), *self.rcm.start()]
        mesh.watch_links()
        self._renew_token()
        self.supervisor.spawn(self.rcm.keep_asking())
        self.supervisor.spawn(self.rcm.watch_lease())

    def _renew_token(self) -> None:
        """Show that this client lives, by a token with a new instance, which cannot count as gone."""
        mesh = self.mesh
        self.instance = new_instance()
        token = mesh.alive(Token(mesh.me.host, Role.CLIENT, mesh.me.client, self.instance))
        if self._token is not None:
            self._token.close()
        self._token, self._token_declared_at = token, mesh.now()

    def _ask_soon(self, arc: OpenArc) -> None:
        # One new token is enough for all requests that were dropped together.
        if arc.outcome == "client_lost" and self.mesh.now() - self._token_declared_at > TOKEN_RENEWAL_INTERVAL:
            self._renew_token()
        super()._ask_soon(arc)

    async def close(self) -> None:
        try:
            if self.leaving is None:
                self.store.resumed.set()
                self._may_end.set()
                await self.supervisor.close()
                await asyncio.gather(*(self.end(arc) for arc in self.store.open))
                if reporting := self.confirmations.reporting:
                    await asyncio.wait(reporting, timeout=CLOSING_REPORT_TIMEOUT)
        finally:
            await self.leave()

    async def leave(self) -> None:
        """Leave the mesh after all was handed over. The RCM ends the rest when the token disappears."""
        self.leaving = self.leaving or asyncio.create_task(self._leave())
        # Its token must go even if the caller is cancelled.
        await asyncio.shield(self.leaving)

    async def _leave(self) -> None:
        self._may_end.set()
        try:
            await self.supervisor.close()
        finally:
            for report in self.confirmations.reporting:
                report.cancel()
            for declared in (*filter(None, [self._token]), *reversed(self._declared)):
                declared.close()
            await self.mesh.close()

    def _failed(self, error: Exception) -> None:
        """End all holds here, and at the RCM by leaving the mesh, as a task of this client failed."""
        for arc in self.store.open:
            arc._finish("lost", f"this client failed: {error!r}", self.mesh.now())
            self.store.notify(arc)
        self.leaving = self.leaving or asyncio.create_task(self._leave())

    @property
    def term(self) -> Term:
        return self.rcm.term

    def watch(self, watcher: Callable[[OpenArc], None]) -> None:
        self.store.watchers.append(watcher)

    async def confirmed(self, arc: OpenArc) -> bool:
        """Wait for all RCs to confirm the present grant; return False if they don't, or if it is over."""
        if (grant := arc.grant) is None:
            return False
        confirmation = self.confirmations.begin(arc, grant)
        await confirmation.over()
        return arc.grant == grant and confirmation.all

    def direct_hold(self, grant: Grant) -> DirectHold | None:
        """None if the request is not direct, or the end of its program has been reported."""
        return self.confirmations.direct(grant)

    async def end(self, arc: OpenArc) -> None:
        """Give back a hold, or leave the queue, unless the request was handed over; wait while the client is paused.
        The program of a direct request must have ended. Tried a few times; if all fail, the RCM ends the request when
        this client's token disappears."""
        await self._may_end.wait()
        if self.leaving is not None:
            return
        if arc.state == "moved":
            self.store.forget(arc)
            return
        self.confirmations.program_is_gone(arc)
        await self.rcm.end(arc)

    def complete(self, arc: OpenArc) -> None:
        """End an ARC whose time is over by this host's clock and whose body has returned."""
        self.confirmations.program_is_gone(arc)
        self.expire(arc)

    def expire(self, arc: OpenArc) -> None:
        """End an ARC whose time is over by this host's clock, though a direct body may still clean up."""
        if arc.grant is not None:
            self._expired.add(arc.id)
            self.supervisor.call_later(NOTICE_TIMEOUT, self._give_back_unreported, arc.id)
        arc._finish("completed", "its minimum runtime is over", self.mesh.now())
        self.store.notify(arc)
        self.store.forget(arc)

    def _give_back_unreported(self, request_id: str) -> None:
        """Give back a hold that expired here without a notice: the leader's renewed grant may be lost."""
        expired = request_id in self._expired
        self._expired.discard(request_id)
        if expired and request_id not in self.store.arcs:  # it may have been submitted again
            self.supervisor.spawn(self.rcm.give_back(Release(id=request_id)))

    async def command(
        self, rc: str, grant: Grant, do: Mapping[str, Any], *, ttl: float = 1.0, timeout: float = 2.0
    ) -> Done:
        """Have an RC carry out a command, once even if it is sent repeatedly. Raises CommandRefused."""
        key = self.mesh.keys.command(rc, self.mesh.me)
        id_ = f"{self.instance}-{next(self._command_numbers)}"
        command = Command(grant=grant, do=dict(do), ttl=ttl, id=id_)
        began, gone = self.mesh.now(), 0.0
        lost: float | None = None
        while (
            reply := await self.mesh.ask_one(key, replace(command, ttl=ttl - gone), Done, timeout=timeout - gone)
        ) is None:
            gone = (self.mesh.now() - began) / SECOND + REPEAT_AFTER
            lost = gone if lost is None else lost  # a closing session also ends queries that began long ago
            if gone >= min(timeout, ttl, lost + REJOIN_TIMEOUT):
                if lost < timeout:  # no RC was found that takes it
                    self.supervisor.spawn(self.confirmations.look_at_silence(rc, DEAF, silent=True))
                raise CommandRefused(rc, Problem("unknown", "no answer; it may or may not have been done"))
            # The query ended early: the RC's process may be rejoining the mesh. Under one id, a command is done once.
            await asyncio.sleep(REPEAT_AFTER)
        self.mesh.suspicions.suspect(f"{rc} {DEAF}", so=False)
        if reply.message is None:
            refused = CommandRefused(rc, reply.problem or Problem("unknown", "no reason given"))
            arc = next((arc for arc in self.store.open if arc.grant == grant), None)
            if refused.code in NOT_HELD and arc is not None and grant not in self._denied:
                self._denied.add(grant)
                self.supervisor.call_later(NOTICE_TIMEOUT, self._end_denied, arc, grant, str(refused))
            raise refused
        return reply.message

    def _end_denied(self, arc: OpenArc, grant: Grant, reason: str) -> None:
        """End a hold that one of its RCs does not have any more, though no notice has reported that."""
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
            # This client never made the request, or ended it before a new leader learned of it.
            if notice.state == "running":
                self.supervisor.spawn(self.rcm.give_back(Release(id=notice.id)))
            elif notice.state == "queued":
                self.supervisor.spawn(self.rcm.give_back(Cancel(id=notice.id)))
