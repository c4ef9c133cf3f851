"""Check one of the last terms (`messages.LAST_TERMS`) against the terms that other processes have promised."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

from zscout.keyexpr import BadName, Role, Token, client_of
from zscout.mesh.exchange import Reply
from zscout.mesh.session import Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import LAST_TERMS, MAX_COUNTER, ClientRequests, RcAsk, RcmState, RcState, StateAsk, of_the_last
from zscout.types import NO_TERM, Term

MAX_RC_COUNTER: Final = (LAST_TERMS + MAX_COUNTER) // 2
"""With certificates: a higher term that RCs report is ignored, so that two lying hosts can't use up all terms."""


class LastTerms:
    """When one of the last terms appears, queries other processes, a round at a time; `believe` gets the highest."""

    def __init__(
        self, mesh: Mesh, supervisor: Supervisor, believe: Callable[[Term], object], *, timeout: float
    ) -> None:
        self._mesh, self._supervisor, self._believe, self._timeout = mesh, supervisor, believe, timeout
        self._asking: asyncio.Task[None] | None = None

    def shown(self, term: Term, known: Term) -> bool:
        """Return True, and query other processes, if `term` is one of the last terms and not credible after `known`."""
        if not of_the_last(term, known):
            return False
        if self._asking is None or self._asking.done():
            self._asking = self._supervisor.spawn(self._ask())
        return True

    async def _ask(self) -> None:
        self._believe(await promised_elsewhere(self._mesh, timeout=self._timeout))


async def promised_elsewhere(mesh: Mesh, *, timeout: float) -> Term:
    """The highest term that RCs and clients with live tokens have promised, or in which a live RCM leads. Of
    contradicting replies of one witness the lowest counts, so an impostor can only lower the result."""
    keys = mesh.keys
    tokens, rcs, clients, leaders = await asyncio.gather(
        mesh.living(keys.alive_any(), timeout=timeout),
        mesh.ask(keys.rc_state_any, RcAsk(), RcState, timeout=timeout),
        mesh.ask(keys.requests_any, RcAsk(), ClientRequests, timeout=timeout),
        mesh.ask(keys.ask_state(mesh.me), StateAsk(holds_only=True), RcmState, timeout=timeout),
    )
    seen = {key for token in tokens if (key := _key_of(mesh, token)) is not None}
    # A leader's instance has one term, so its own report counts.
    seen |= {token.instance for token in tokens if token.role == Role.RCM}
    if keys.closed:
        # On a fleet with certificates, a leader counts, or RCs of two hosts.
        rcs, clients = _confirmed(rcs, tokens), []
    reported = [(reply.key, reply.message.term) for reply in rcs if reply.message is not None]
    reported += [(reply.key, reply.message.term) for reply in clients if reply.message is not None]
    reported += [(reply.message.term.rcm, reply.message.term) for reply in leaders if reply.message is not None]
    lowest = dict[str, Term]()
    for witness, term in reported:
        if witness in seen and term.counter <= MAX_COUNTER:
            lowest[witness] = min(term, lowest.get(witness, term))
    return max(lowest.values(), default=NO_TERM)


def _confirmed(replies: list[Reply[RcState]], tokens: list[Token]) -> list[Reply[RcState]]:
    """Replies of live RCs whose term is at most MAX_RC_COUNTER and no higher than the term of an RC on another host."""
    hosts = {(token.name, token.instance): token.host for token in tokens if token.role == Role.RC}
    live = [
        (reply, reply.message.term, host)
        for reply in replies
        if reply.message is not None and (host := hosts.get((reply.message.rc, reply.message.instance))) is not None
    ]
    return [
        reply
        for reply, term, host in live
        if term.counter <= MAX_RC_COUNTER and any(other != host and another >= term for _, another, other in live)
    ]


def _key_of(mesh: Mesh, token: Token) -> str | None:
    """The key on which the owner of `token` answers."""
    try:
        if token.role == Role.RC:
            return mesh.keys.rc_state(token.name)
        if token.role == Role.CLIENT:
            return mesh.keys.requests(client_of(f"{token.host}/{token.name}"))
    except BadName:
        pass
    return None
