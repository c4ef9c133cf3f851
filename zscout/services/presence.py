"""Who is there: the RCM's eye on clients and RCs.

Liveliness tokens become the core's events. An RC may be granted once it has promised to obey this term; a
client that asks must show a token within a lease. What an RC says of itself is compared with what the core
believes, and corrected by name.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any, Protocol

from zscout import clock
from zscout.config import Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Declared, Mesh
from zscout.messages import RcAsk, RcState
from zscout.scheduling.core import Core
from zscout.scheduling.events import ClientLost, Event, RcJoined, RcLost, RcReported
from zscout.scheduling.model import SECOND, Arc, Term

log = logging.getLogger(__name__)

NEAR_END = SECOND // 20
"""A hold with less than this left may have ended at its RC already: clocks differ a little."""


class Reign(Protocol):
    """What presence needs of the RCM that it serves."""

    term: Term
    core: Core

    def feed(self, *events: Event) -> None: ...
    def repeat(self, rc: str) -> None:
        """Publishes all holders of an RC again."""
        ...

    def published_at(self, rc: str) -> int:
        """The number of the last publication that named an RC."""
        ...

    def newer(self, term: Term) -> None:
        """Somebody knows of a higher term: this reign is over."""
        ...

    def spawn(self, coroutine: Coroutine[Any, Any, None]) -> None: ...


class Presence:
    """Follows the clients and RCs of one fleet for one reign."""

    def __init__(self, mesh: Mesh, fleet: Fleet, reign: Reign) -> None:
        self.mesh, self.fleet, self.reign = mesh, fleet, reign
        self._clients: dict[str, set[str]] = {}
        """Instances alive of each client."""
        self._unseen: dict[str, asyncio.TimerHandle] = {}
        self._rc_tokens: dict[str, dict[str, Token]] = {}
        self._joined: dict[str, RcState] = {}
        """The RCs that count as there, as they last told of themselves."""
        self._look_back: asyncio.TimerHandle | None = None

    def watch(self) -> list[Declared]:
        keys, mesh = self.mesh.keys, self.mesh
        return [
            mesh.subscribe(keys.rc_state_any, RcState, self._on_rc_state),
            mesh.watch(keys.alive_any(Role.CLIENT), self._on_client),
            mesh.watch(keys.alive_any(Role.RC), self._on_rc_token),
        ]

    def inherit(self, rcs: dict[str, RcState]) -> list[Event]:
        """The RCs that promised to obey before the reign began."""
        self._joined.update(rcs)
        # One that died before its token was watched would never be seen to go.
        loop = asyncio.get_running_loop()
        self._look_back = loop.call_later(self.fleet.mesh.lease, self._lose_unseen)
        return [RcJoined(name, state.sharable) for name, state in rcs.items() if state.health == "ok"]

    def stop(self) -> None:
        for timer in self._unseen.values():
            timer.cancel()
        if self._look_back is not None:
            self._look_back.cancel()

    @property
    def rcs(self) -> set[str]:
        return set(self._joined)

    def alive(self, client: str) -> bool:
        return client in self._clients

    def find(self, client: str, then: Callable[[bool], None]) -> None:
        """Calls `then` with whether a client has a token: at once where it was seen, else once the mesh was
        asked, because a new leader has not yet heard of all."""
        if self.alive(client):
            then(True)
        else:
            self.reign.spawn(self._find(client, then))

    async def _find(self, client: str, then: Callable[[bool], None]) -> None:
        timeout = self.fleet.timing.rebuild / SECOND
        tokens = await self.mesh.living(self.mesh.keys.alive_any(Role.CLIENT), timeout=timeout)
        then(any(f"{token.host}/{token.name}" == client for token in tokens))

    def expect(self, client: str) -> None:
        """A client with requests must live; one that nobody has seen yet gets a lease to show itself."""
        if client not in self._clients and client not in self._unseen:
            loop = asyncio.get_running_loop()
            self._unseen[client] = loop.call_later(self.fleet.mesh.lease, self._client_lost, client)

    def _on_client(self, token: Token, alive: bool) -> None:
        client = f"{token.host}/{token.name}"
        instances = self._clients.setdefault(client, set())
        if alive:
            instances.add(token.instance)
            if timer := self._unseen.pop(client, None):
                timer.cancel()
            return
        instances.discard(token.instance)
        if not instances:
            del self._clients[client]
            self._client_lost(client)

    def _client_lost(self, client: str) -> None:
        self._unseen.pop(client, None)
        if self.reign.core.arcs_of(client):
            self.reign.feed(ClientLost(client))

    def _on_rc_token(self, token: Token, alive: bool) -> None:
        tokens = self._rc_tokens.setdefault(token.name, {})
        current = self._joined.get(token.name)
        if alive:
            tokens[token.instance] = token
            if current is None:
                self.reign.spawn(self._join(token))
            elif current.instance != token.instance:
                log.warning("%s is offered twice; the one at %s is used", token.name, current.host)
            return
        tokens.pop(token.instance, None)
        if current is not None and current.instance == token.instance:
            self._rc_lost(token.name)
        if not tokens:
            del self._rc_tokens[token.name]

    def _rc_lost(self, name: str) -> None:
        del self._joined[name]
        self.reign.feed(RcLost(name))
        for other in self._rc_tokens.get(name, {}).values():
            self.reign.spawn(self._join(other))

    def _lose_unseen(self) -> None:
        for name, state in list(self._joined.items()):
            if state.instance not in self._rc_tokens.get(name, {}):
                self._rc_lost(name)

    async def _join(self, token: Token) -> None:
        """Asks a new RC how it stands; it may be granted once it has promised to obey this term."""
        timeout = self.fleet.timing.rebuild / SECOND
        while token.instance in self._rc_tokens.get(token.name, {}) and token.name not in self._joined:
            key = self.mesh.keys.rc_state(token.name)
            replies = await self.mesh.ask(key, RcAsk(promise=self.reign.term), RcState, timeout=timeout)
            for reply in replies:
                if reply.problem is not None and reply.problem.term is not None:
                    self._see(reply.problem.term)
                state = reply.message
                if state is not None and state.instance == token.instance and token.name not in self._joined:
                    self._take_in(token.name, state)
                    return
            # No answer can come at once, and again and again: a token may stand for nothing.
            await asyncio.sleep(timeout)

    def _take_in(self, name: str, state: RcState) -> None:
        self._joined[name] = state
        if state.health == "ok":
            self.reign.feed(RcJoined(name, state.sharable))
        self._correct(name, state)

    def _on_rc_state(self, key: str, state: RcState) -> None:
        self._see(state.term)
        name = self.mesh.keys.rc_of(key)
        known = self._joined.get(name)
        if known is None or known.instance != state.instance:
            return
        self._joined[name] = state
        if state.health != "ok":
            if known.health == "ok":
                self.reign.feed(RcLost(name, state.health))
            return
        if known.health != "ok":
            self.reign.feed(RcJoined(name, state.sharable))
        if state.rules != known.rules:
            self.reign.feed(RcReported(name, rules_changed=True))
        self._correct(name, state)

    def _correct(self, name: str, state: RcState) -> None:
        """Makes an RC's word and the core's agree: what it lost has ended, what is too much is revoked."""
        holders = self.reign.core.floor.rc(name).holders
        ours = {arc.hold.grant: arc for arc in holders.values() if arc.hold is not None}
        theirs = {holder.grant for holder in state.holders}
        ended = {hold.grant for hold in state.ended if hold.why != "time"}
        heard_all = state.term == self.reign.term and state.seq >= self.reign.published_at(name)
        timely = {hold.grant for hold in state.ended if hold.why == "time"}
        lost = [
            arc.id
            for grant, arc in ours.items()
            if grant in ended
            or (heard_all and grant not in theirs and grant not in timely and not self._due(arc))
        ]
        if lost:
            self.reign.feed(RcReported(name, ended=tuple(lost)))
        if heard_all and theirs - ours.keys():
            self.reign.repeat(name)

    def _due(self, arc: Arc) -> bool:
        """Whether a hold is about to end by time anyway: the RC's clock may be a little ahead."""
        return arc.hold is not None and not arc.request.keep and arc.hold.end - clock.now() < NEAR_END

    def _see(self, term: Term) -> None:
        if term > self.reign.term:
            self.reign.newer(term)
