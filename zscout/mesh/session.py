"""A mesh over a transport: JSON messages, bounded queues, and one thread for all handlers."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any, Self, TypeAlias, TypeVar

import msgspec

from zscout import messages
from zscout.keyexpr import BadName, Keys, Sender, Token
from zscout.mesh.declared import Declaration, Overheard, Publisher, Shared
from zscout.mesh.exchange import IncomingQuery, Refused, Reply, read_reply, refuse
from zscout.mesh.frames import FramePublisher, FrameWatch
from zscout.mesh.inbox import INBOX_DEPTH, QUEUE_DEPTH, Backlog, Inbox
from zscout.mesh.protocol import OVERHEARD, Mesh
from zscout.mesh.transport import Collector, Quality, Transport, TransportQuery, Undeclare
from zscout.messages import Malformed, Problem
from zscout.types import Ns

log = logging.getLogger(__name__)

FINAL_SLACK = 0.5
"""Seconds after its timeout at which a query is over though the transport has not said so."""

OnReply: TypeAlias = Callable[[str, bytes, bool], bool]
"""Called with a reply's key, payload, and whether it is a message; returns whether that is enough."""

S = TypeVar("S")
R = TypeVar("R")


class SessionMesh(Mesh):
    """What the mesh does alike on every transport. An async context manager."""

    def __init__(self, transport: Transport, keys: Keys, me: Sender, loop: asyncio.AbstractEventLoop) -> None:
        self._transport = transport
        self._inbox = Inbox(loop)
        self._shared: dict[tuple[Any, ...], Shared] = {}
        self.keys = keys
        self.me = me

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    def links(self) -> int:
        return self._transport.links()

    async def close(self) -> None:
        self._inbox.close()
        await self._transport.close()

    def after_burst(self, then: Callable[[], None]) -> None:
        if self._inbox.draining:
            self._inbox.after.append(then)
        else:
            then()

    # Queries

    async def ask(
        self,
        key: str,
        message: msgspec.Struct | None,
        kind: type[R],
        *,
        timeout: float,
        enough: Callable[[Reply[R]], bool] | None = None,
        limit: int = messages.MAX_STATE,
    ) -> list[Reply[R]]:
        replies: list[Reply[R]] = []

        def on_reply(key: str, payload: bytes, ok: bool) -> bool:
            reply = read_reply(key, payload, ok, kind, limit)
            if reply is None:
                return False
            replies.append(reply)
            return enough is not None and enough(reply)

        await self._all(lambda to: self._get(key, message, timeout, to), on_reply, timeout)
        return replies

    async def ask_one(
        self, key: str, message: msgspec.Struct | None, kind: type[R], *, timeout: float
    ) -> Reply[R] | None:
        replies = await self.ask(key, message, kind, timeout=timeout, enough=lambda _: True)
        return replies[0] if replies else None

    def ask_then(
        self,
        key: str,
        message: msgspec.Struct,
        kind: type[R],
        then: Callable[[Reply[R] | None], None],
        *,
        timeout: float,
    ) -> None:
        first: Reply[R] | None = None

        def on_reply(key: str, payload: bytes, ok: bool) -> bool:
            nonlocal first
            first = read_reply(key, payload, ok, kind, messages.MAX_STATE)
            return first is not None

        self._get(key, message, timeout, _Collector(self._inbox, on_reply, lambda: then(first)))

    def _get(self, key: str, message: msgspec.Struct | None, timeout: float, to: Collector) -> None:
        payload = None if message is None else messages.encode(message)
        kind = None if message is None else type(message)
        self._transport.get(key, payload, kind, timeout, to)

    async def _all(self, query: Callable[[Collector], None], on_reply: OnReply, timeout: float) -> None:
        """Makes a query, and returns when it is over, or when `on_reply` says that it is enough."""
        loop = self._inbox.loop
        done: asyncio.Future[None] = loop.create_future()

        def finish() -> None:
            if not done.done():
                done.set_result(None)

        query(_Collector(self._inbox, on_reply, finish))
        guard = loop.call_later(timeout + FINAL_SLACK, finish)
        try:
            await done
        finally:
            guard.cancel()

    def serve(
        self,
        key: str,
        kind: Any,
        handler: Callable[[IncomingQuery[Any]], None],
        *,
        depth: int = QUEUE_DEPTH,
        limit: int = messages.MAX_PAYLOAD,
    ) -> Declaration:
        state = Backlog(depth=depth)
        wild = "*" in key

        def on_query(query: TransportQuery) -> None:
            if state.closed:
                query.drop()
            elif not self._inbox.offer(state, handle, query, self.now()):
                refuse(query, Problem("busy", "too many requests are waiting here; ask again"))

        def handle(query: TransportQuery, arrived: Ns) -> None:
            if state.closed:
                # Unless it is dropped here and now, its sender waits for the whole of its timeout.
                query.drop()
                return
            asked = query.key
            if wild and "*" in asked:
                refuse(query, Problem("bad_key", f"name yourself in the key {key}: no wildcards"))
                return
            payload = query.payload
            try:
                message = messages.decode(b"{}" if payload is None else payload, kind, limit)
            except Malformed as error:
                refuse(query, Problem("malformed", str(error)))
                return
            incoming: IncomingQuery[Any] = IncomingQuery(
                query, asked, asked if wild else key, message, arrived
            )
            try:
                handler(incoming)
            except Refused as refused:
                incoming.refuse(refused.problem)
            except BadName as error:
                incoming.refuse(Problem("bad_name", str(error)))
            except Exception:
                incoming.refuse(Problem("internal", "the request failed here; see this node's log"))
                raise

        return _closing(state, self._transport.queryable(key, on_query))

    # Publications

    def publisher(self, key: str, kind: type, *, data: bool = False) -> Publisher:
        quality = Quality.DATA if data else Quality.CONTROL
        return Publisher(self._transport.publisher(key, kind, quality))

    def put(self, key: str, message: msgspec.Struct) -> None:
        self._transport.put(key, messages.encode(message), type(message))

    def subscribe(
        self,
        key: str,
        kind: type[S],
        handler: Callable[[str, S], None],
        *,
        depth: int = QUEUE_DEPTH,
        limit: int = messages.MAX_STATE,
    ) -> Declaration:
        alike = (key, kind, depth, limit)
        shared = self._shared.get(alike)
        if shared is None:
            shared = self._shared[alike] = Shared(Backlog(depth=depth))
            shared.undeclare = self._subscribe(key, kind, shared, limit)
        handlers, state, undeclare = shared.handlers, shared.state, shared.undeclare
        handlers.append(handler)

        def leave() -> None:
            handlers.remove(handler)
            if not handlers:
                state.closed = True
                del self._shared[alike]
                undeclare()

        return Declaration(leave, state)

    def _subscribe(self, key: str, kind: type[S], shared: Shared, limit: int) -> Undeclare:
        state = shared.state

        def on_sample(name: str, payload: bytes, _: bytes | None) -> None:
            if not self._inbox.offer(state, handle, name, payload):
                state.missed += 1

        def handle(name: str, payload: bytes) -> None:
            if state.closed:
                return
            try:
                message: S = messages.decode(payload, kind, limit)
            except Malformed as error:
                log.warning("ignored a publication on %.200r: %s", name, error)
                return
            for handler in tuple(shared.handlers):
                try:
                    handler(name, message)
                except BadName as error:
                    log.warning("ignored a publication on %.200r: %s", name, error)
                except Refused:  # by a supervised handler: it is logged there
                    pass
                except Exception:
                    log.exception("a handler failed")

        return self._transport.subscriber(key, on_sample)

    def overhear(self, key: str, kind: type[S], *, depth: int = OVERHEARD) -> Overheard[S]:
        return Overheard(*self._transport.ring(key, depth), kind, depth)

    # Frames

    def frame_publisher(self, key: str) -> FramePublisher:
        return FramePublisher(self._transport.publisher(key, None, Quality.FRAME), self._inbox)

    def frames(self, key: str) -> FrameWatch:
        return FrameWatch(self._transport, key, self._inbox, self.now)

    # Liveliness

    def alive(self, token: Token) -> Declaration:
        return Declaration(self._transport.token(self.keys.alive(token)))

    def watch(self, key: str, handler: Callable[[Token, bool], None]) -> Declaration:
        state = Backlog()

        def on_token(text: str, alive: bool) -> None:
            self._inbox.deliver(handle, text, alive)

        def handle(text: str, alive: bool) -> None:
            token = None if state.closed else self._token_of(text)
            if token is not None:
                handler(token, alive)

        return _closing(state, self._transport.token_subscriber(key, on_token))

    async def living(self, key: str, *, timeout: float) -> list[Token]:
        found: set[str] = set()

        def on_reply(text: str, *_: object) -> bool:
            found.add(text)
            return False

        await self._all(lambda to: self._transport.tokens(key, timeout, to), on_reply, timeout)
        return sorted(token for token in map(self._token_of, found) if token is not None)

    def _token_of(self, text: str) -> Token | None:
        try:
            return self.keys.token_of(text)
        except BadName as error:
            log.warning("ignored a liveliness token: %s", error)
            return None


class _Collector(Collector):
    """Passes replies to `each` in the event loop, until that returns true. Calls `over` then, or at the end,
    once."""

    def __init__(self, inbox: Inbox, each: OnReply, over: Callable[[], None]) -> None:
        self._inbox, self._each, self._over = inbox, each, over
        self._state = Backlog(depth=INBOX_DEPTH)
        self._open = True

    def on_reply(self, key: str, payload: bytes, ok: bool) -> None:
        self._inbox.offer(self._state, self._take, key, payload, ok)

    def on_final(self) -> None:
        if self._open:
            self._inbox.deliver(self._end)

    def _take(self, key: str, payload: bytes, ok: bool) -> None:
        if self._open and self._each(key, payload, ok):
            self._end()

    def _end(self) -> None:
        if self._open:
            self._open = False
            self._over()


def _closing(state: Backlog, undeclare: Undeclare) -> Declaration:
    """A declaration after whose end nothing that still waits is handled."""

    def leave() -> None:
        state.closed = True
        undeclare()

    return Declaration(leave, state)
