"""A transport whose session can be opened anew: all that was declared on the old one is declared on the new one.

Zenoh links can come back without all that was declared on the other side (docs/zenoh.md). A process that finds its own
view of the mesh in contradiction leaves it, in effect, and joins again; its callers notice nothing but that tokens
which it had missed appear, and that others go."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Final

from zscout.mesh.transport import Collector, OnSample, Quality, Transport, TransportPublisher, TransportQuery, Undeclare

log = logging.getLogger(__name__)

SETTLE: Final = 1.0
"""Seconds after which tokens that a new session has not shown are gone."""

OnToken = Callable[[str, bool], None]


class RenewableTransport(Transport):
    """`opening` opens another session. Raises what that raises."""

    def __init__(self, transport: Transport, opening: Callable[[], Awaitable[Transport]]) -> None:
        self._transport, self._opening = transport, opening
        self._declared: dict[_Declared, None] = {}
        self._renewing = False
        self._closed = False

    async def renew(self) -> None:
        """Opens a new session, declares on it all that is declared, and closes the old one. Once at a time."""
        if self._renewing or self._closed:
            return
        self._renewing = True
        try:
            fresh = await self._opening()
            if self._closed:
                await fresh.close()
                return
            old, self._transport = self._transport, fresh
            # First the new ones, so that no token of this process goes in between.
            for one in tuple(self._declared):
                one.declare(fresh)
            await old.close()
        finally:
            self._renewing = False

    def _keep(self, declare: Callable[[Transport], Undeclare]) -> Undeclare:
        one = _Declared(declare, self._declared)
        one.declare(self._transport)
        return one.close

    # The transport of now

    def links(self) -> int:
        return self._transport.links()

    async def close(self) -> None:
        self._closed = True
        await self._transport.close()

    def get(self, key: str, payload: bytes | None, kind: type | None, timeout: float, to: Collector) -> None:
        self._transport.get(key, payload, kind, timeout, to)

    def put(self, key: str, payload: bytes, kind: type) -> None:
        self._transport.put(key, payload, kind)

    def tokens(self, key: str, timeout: float, to: Collector) -> None:
        self._transport.tokens(key, timeout, to)

    # What is declared, on each

    def queryable(self, key: str, on_query: Callable[[TransportQuery], None]) -> Undeclare:
        return self._keep(lambda transport: transport.queryable(key, on_query))

    def subscriber(self, key: str, on_sample: OnSample) -> Undeclare:
        return self._keep(lambda transport: transport.subscriber(key, on_sample))

    def token(self, key: str) -> Undeclare:
        return self._keep(lambda transport: transport.token(key))

    def ring(self, key: str, depth: int) -> tuple[Callable[[], tuple[str, bytes] | None], Undeclare]:
        taking: list[Callable[[], tuple[str, bytes] | None]] = []

        def declare(transport: Transport) -> Undeclare:
            take, undeclare = transport.ring(key, depth)
            taking.append(take)
            return undeclare

        undeclare = self._keep(declare)

        def take() -> tuple[str, bytes] | None:
            # What the old session still had comes first.
            while len(taking) > 1:
                if (found := taking[0]()) is not None:
                    return found
                del taking[0]
            return taking[0]()

        return take, undeclare

    def publisher(self, key: str, kind: type | None, quality: Quality) -> TransportPublisher:
        publisher = _RenewablePublisher(lambda transport: transport.publisher(key, kind, quality))
        publisher.undeclare = self._keep(publisher.declare)  # type: ignore[method-assign]
        return publisher

    def token_subscriber(self, key: str, on_token: OnToken) -> Undeclare:
        return self._keep(_TokenView(key, on_token).declare)


class _Declared:
    """One declaration, on whichever session there is."""

    def __init__(self, declare: Callable[[Transport], Undeclare], among: dict[_Declared, None]) -> None:
        self._declare, self._among = declare, among
        self._undeclare: Undeclare | None = None
        among[self] = None

    def declare(self, transport: Transport) -> None:
        self._undeclare = self._declare(transport)

    def close(self) -> None:
        self._among.pop(self, None)
        undeclare, self._undeclare = self._undeclare, None
        if undeclare is not None:
            undeclare()


class _RenewablePublisher(TransportPublisher):
    def __init__(self, declare: Callable[[Transport], TransportPublisher]) -> None:
        self._declare = declare
        self._on_matching: Callable[[bool], None] | None = None

    def declare(self, transport: Transport) -> Undeclare:
        self._publisher = self._declare(transport)
        if self._on_matching is not None:
            self._on_matching(self._publisher.match(self._on_matching))
        return self._publisher.undeclare

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        self._publisher.put(payload, attachment)

    def match(self, on_matching: Callable[[bool], None]) -> bool:
        self._on_matching = on_matching
        return self._publisher.match(on_matching)


class _TokenView:
    """The tokens on a key as their watcher knows them: on a new session only differences are told."""

    def __init__(self, key: str, on_token: OnToken) -> None:
        self._key, self._on_token = key, on_token
        self._session = 0
        self._alive: dict[str, int] = {}
        """By token: the last session that showed it."""

    def declare(self, transport: Transport) -> Undeclare:
        self._session += 1
        session = self._session
        loop = asyncio.get_running_loop()

        def on_token(token: str, alive: bool) -> None:
            if session != self._session:  # of the old one, which is being closed
                return
            known = token in self._alive
            if alive:
                self._alive[token] = session
            else:
                self._alive.pop(token, None)
            if known != alive:
                self._on_token(token, alive)

        undeclare = transport.token_subscriber(self._key, on_token)
        if session > 1:
            loop.call_later(SETTLE, self._forget, session)
        return undeclare

    def _forget(self, session: int) -> None:
        for token in [token for token, shown in self._alive.items() if shown < session]:
            del self._alive[token]
            self._on_token(token, False)
