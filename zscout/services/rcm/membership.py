"""Which clients and RCs are there: liveliness tokens and what RCs report, as events.

An RC may be granted once it has promised to obey this term; a client with requests must have a token within a lease.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable

from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Declaration, Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import RcAsk, RcState
from zscout.scheduling.model import ArcStatus, ClientLost, Event, RcJoined, RcLost, RcReported
from zscout.types import SECOND, ArcId, ClientId, Grant, Ns, RcName, Term

log = logging.getLogger(__name__)

NEAR_END: Ns = SECOND // 20
"""A hold with less than this left may have ended at its RC already: clocks differ a little."""


class Membership:
    """Follows the clients and RCs of one fleet for one term."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        term: Term,
        supervisor: Supervisor,
        emit: Callable[[Event], None],
        on_reported: Callable[[RcName, RcState], None],
        on_newer: Callable[[Term], None],
    ) -> None:
        self.mesh, self.term = mesh, term
        self._lease = fleet.mesh.lease
        self._timeout = fleet.timing.rebuild / SECOND
        self._supervisor = supervisor
        self._emit, self._on_reported, self._on_newer = emit, on_reported, on_newer
        self.clients: dict[ClientId, set[str]] = {}
        """Instances alive of each client that has a token."""
        self._unseen: dict[ClientId, asyncio.TimerHandle] = {}
        self._rc_tokens: dict[RcName, dict[str, Token]] = {}
        self._joined: dict[RcName, RcState] = {}
        """The RCs that count as there, as they reported themselves last."""

    def join(self, rcs: dict[RcName, RcState]) -> list[Event]:
        """The RCs that promised to obey before the term began."""
        self._joined.update(rcs)
        # One that died before its token was watched would never be seen to go.
        self._supervisor.call_later(self._lease, self._drop_unseen)
        return [RcJoined(name, state.sharable) for name, state in rcs.items() if state.health == "ok"]

    def watch(self) -> list[Declaration]:
        keys, mesh, guard = self.mesh.keys, self.mesh, self._supervisor.guard
        return [
            mesh.subscribe(keys.rc_state_any, RcState, guard(self._on_rc_state)),
            mesh.watch(keys.alive_any(Role.CLIENT), guard(self._on_client)),
            mesh.watch(keys.alive_any(Role.RC), guard(self._on_rc_token)),
        ]

    # Clients

    def expect(self, client: ClientId) -> None:
        """A client with requests must live: one that is not among `clients` yet gets a lease to show itself."""
        if client not in self._unseen:
            self._unseen[client] = self._supervisor.call_later(self._lease, self._client_lost, client)

    def find(self, client: ClientId, then: Callable[[bool], None]) -> None:
        """Calls `then` with whether a client has a token: at once where it was seen, else once the mesh was
        queried, because a new leader does not know all tokens yet."""
        if client in self.clients:
            then(True)
        else:
            self._supervisor.spawn(self._find(client, then))

    async def _find(self, client: ClientId, then: Callable[[bool], None]) -> None:
        tokens = await self.mesh.living(self.mesh.keys.alive_any(Role.CLIENT), timeout=self._timeout)
        then(any(f"{token.host}/{token.name}" == client for token in tokens))

    def _on_client(self, token: Token, alive: bool) -> None:
        client = f"{token.host}/{token.name}"
        instances = self.clients.setdefault(client, set())
        if alive:
            instances.add(token.instance)
            if timer := self._unseen.pop(client, None):
                timer.cancel()
            return
        instances.discard(token.instance)
        if not instances:
            del self.clients[client]
            self._client_lost(client)

    def _client_lost(self, client: ClientId) -> None:
        self._unseen.pop(client, None)
        self._emit(ClientLost(client))

    # RCs

    def _on_rc_token(self, token: Token, alive: bool) -> None:
        tokens = self._rc_tokens.setdefault(token.name, {})
        current = self._joined.get(token.name)
        if alive:
            tokens[token.instance] = token
            if current is None:
                self._supervisor.spawn(self._join(token))
            elif current.instance != token.instance:
                log.warning("%s is offered twice; the one at %s is used", token.name, current.host)
            return
        tokens.pop(token.instance, None)
        if current is not None and current.instance == token.instance:
            self._drop(token.name)
        if not tokens:
            del self._rc_tokens[token.name]

    def _drop(self, name: RcName) -> None:
        del self._joined[name]
        self._emit(RcLost(name))
        for other in self._rc_tokens.get(name, {}).values():
            self._supervisor.spawn(self._join(other))

    def _drop_unseen(self) -> None:
        for name, state in list(self._joined.items()):
            if state.instance not in self._rc_tokens.get(name, {}):
                self._drop(name)

    async def _join(self, token: Token) -> None:
        """Asks a new RC for its promise to obey this term, until it has joined or is gone."""
        key = self.mesh.keys.rc_state(token.name)
        while self._is_wanted(token):
            for reply in await self.mesh.ask(key, RcAsk(promise=self.term), RcState, timeout=self._timeout):
                if reply.problem is not None and reply.problem.term is not None:
                    self._see(reply.problem.term)
                state = reply.message
                if state is not None and state.instance == token.instance and self._is_wanted(token):
                    self._joined[token.name] = state
                    if state.health == "ok":
                        self._emit(RcJoined(token.name, state.sharable))
                    self._on_reported(token.name, state)
                    return
            # No answer can come at once, and again and again: a token may outlive its RC.
            await asyncio.sleep(self._timeout)

    def _is_wanted(self, token: Token) -> bool:
        """Whether an RC lives and has not joined. Once the term is over, no RC is asked any more."""
        living = self._rc_tokens.get(token.name, {})
        return self._supervisor.active and token.instance in living and token.name not in self._joined

    def _on_rc_state(self, key: str, state: RcState) -> None:
        self._see(state.term)
        name = self.mesh.keys.rc_of(key)
        known = self._joined.get(name)
        if known is None or known.instance != state.instance:
            return
        self._joined[name] = state
        if state.health != "ok":
            if known.health == "ok":
                self._emit(RcLost(name, state.health))
            return
        if known.health != "ok":
            self._emit(RcJoined(name, state.sharable))
        if state.rules != known.rules:
            self._emit(RcReported(name, rules_changed=True))
        self._on_reported(name, state)

    def _see(self, term: Term) -> None:
        if term > self.term:
            self._on_newer(term)


def discrepancies(
    state: RcState, holders: Iterable[ArcStatus], now: Ns, *, current: bool
) -> tuple[tuple[ArcId, ...], bool]:
    """Compares the holds that an RC reports with its `holders` in the core: which ARCs' holds it has
    ended, and whether it has any that it should not have.

    `current`: it knows all that was published about it, so that what it does not name it does not hold."""
    known = {arc.hold.grant: arc for arc in holders if arc.hold is not None}
    held = {holder.grant for holder in state.holders}
    unknown = not held <= known.keys()
    # One that reports an unknown hold may have read the RCM's state before it received the publication that
    # ends this hold: what it does not hold yet is not lost. Its list, published again, settles both.
    complete = current and not unknown
    timely = {hold.grant for hold in state.ended if hold.why == "time"}
    ended = {hold.grant for hold in state.ended} - timely

    def is_lost(grant: Grant, arc: ArcStatus) -> bool:
        due = arc.hold is not None and not arc.request.keep and arc.hold.end - now < NEAR_END
        return grant in ended or (complete and grant not in held and grant not in timely and not due)

    lost = tuple(arc.id for grant, arc in known.items() if is_lost(grant, arc))
    return lost, current and unknown
