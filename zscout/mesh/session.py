"""A process's place on the mesh: JSON messages over a transport, and one event loop for all handlers.

What arrives on Zenoh's threads goes through one bounded inbox into the event loop, in the order in which it came, with
one wake-up for a burst. Handlers are plain functions that run there and must not block."""

from __future__ import annotations

import asyncio
import functools
import logging
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Self, TypeAlias, TypeVar

from msgspec import Struct

from zscout import messages
from zscout.config.certificates import Validity
from zscout.keyexpr import MAX_NAME, BadName, FleetMember, Keys, Role, Sender, Token
from zscout.mesh.exchange import (
    QUEUE_DEPTH,
    Backlog,
    Declaration,
    HostShares,
    IncomingQuery,
    PolledSubscription,
    Publisher,
    Refused,
    Reply,
    Tally,
    refuse,
)
from zscout.mesh.frames import FramePublisher, FrameWatch
from zscout.mesh.renewal import RenewableTransport, Suspicions
from zscout.mesh.sparse_log import SparseLog
from zscout.mesh.transport import Collector, Quality, TransportQuery, Undeclare
from zscout.messages import Malformed, Problem
from zscout.types import Ns

log = logging.getLogger(__name__)

INBOX_DEPTH = 20_000
"""Items of all kinds that may wait for the event loop."""
BURST = 256
"""Items that are handled in one go at most, those included that arrive meanwhile."""
RING_DEPTH = 32
"""Publications that `poll_latest` keeps."""
LINK_PERIOD = 1.0
"""Seconds between two looks at whether each linked session shows what it has declared."""
MAX_SESSIONS = 4_096
"""Sessions that are remembered."""
FINAL_SLACK = 0.5
"""Seconds after its timeout at which a query is over though the transport has not reported that."""

_Subscription: TypeAlias = tuple[Backlog, list[Callable[[str, Any], None]], Undeclare]
"""One whose publications are decoded once for all handlers of this process."""
OnReply: TypeAlias = Callable[[str, bytes, bool], bool]
"""Called with a reply's key, payload, and whether it is a message; returns whether that is enough."""

S = TypeVar("S")
R = TypeVar("R")


@dataclass(slots=True)
class Inbox:
    """From Zenoh's threads into the event loop, waking it once for whatever has gathered."""

    loop: asyncio.AbstractEventLoop
    items: deque[tuple[Backlog | None, Callable[..., None], tuple[Any, ...]]] = field(default_factory=deque)
    scheduled: bool = False
    closed: bool = False
    after: list[Callable[[], None]] | None = None
    """What is called once the present burst has been handled; None: there is none at present."""

    def offer(self, state: Backlog, call: Callable[..., None], *args: Any) -> bool:
        """Calls `call(*args)` in the event loop, unless too much waits there: whether it will."""
        if self.closed or len(self.items) >= INBOX_DEPTH or state.pending >= state.depth:
            return False
        state.pending += 1
        return self._put(state, call, args)

    def deliver(self, call: Callable[..., None], *args: Any) -> None:
        """The same of what must not be lost, such as deaths and ends of queries. Of these there are as many
        as there are processes and own queries."""
        if not self.closed:
            self._put(None, call, args)

    def close(self) -> None:
        """Nothing is called any more, what waits included."""
        self.closed = True
        self.items.clear()

    def _put(self, *item: Any) -> bool:
        self.items.append(item)
        if not self.scheduled:
            self.scheduled = True
            try:
                self.loop.call_soon_threadsafe(self.drain)
            except RuntimeError:  # the loop is closed: the process is on its way out
                self.closed = True
                return False
        return True

    def drain(self) -> None:
        self.after = []
        try:
            for _ in range(BURST):
                if not self.items or self.closed:
                    break
                state, call, args = self.items.popleft()
                if state is not None:
                    state.pending -= 1
                guarded(call, *args)
            after, self.after = self.after, None
            for then in after:
                guarded(then)
        finally:
            self.after = None
            # In this order: a thread that offers something now either sees that nobody is coming, or is seen.
            self.scheduled = False
            if self.items and not self.closed:
                self.scheduled = True
                self.loop.call_soon(self.drain)


def guarded(call: Callable[..., None], *args: Any) -> None:
    """Calls a handler; what it raises is logged, if it was not yet."""
    try:
        call(*args)
    except Refused:  # by a supervised handler: it is logged there
        pass
    except BadName as error:
        log.warning("ignored what came under a bad name: %s", error)
    except Exception:
        log.exception("a handler failed")


class Mesh:
    """One process's place on the mesh, an async context manager: typed queries, publications, liveliness, and a clock.

    Declare once per purpose, never per request: Zenoh keeps memory for every key that was ever declared."""

    validity: Validity | None = None
    """Of this process's certificate as it is now; None on a plain mesh."""

    def __init__(self, transport: RenewableTransport, keys: Keys, me: Sender, now: Callable[[], Ns]) -> None:
        self.keys, self.me, self.now = keys, me, now
        """`now()` is in nanoseconds on this host's monotonic clock. Not comparable between hosts."""
        self.suspicions = Suspicions(now, transport.renew)
        self._transport = transport
        self._strange = SparseLog(log, now)
        self._inbox = Inbox(asyncio.get_running_loop())
        self._shared: dict[tuple[Any, ...], _Subscription] = {}
        self._kept: list[object] = []
        """What lives as long as this place."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    def links(self) -> int:
        """How many peers this process is linked to."""
        return self._transport.links()

    def relays(self) -> int:
        """How many of those are relays."""
        return self._transport.relays()

    async def close(self) -> None:
        """Leaves the mesh: tokens die, and no handler is called any more. Bounded in time."""
        self._inbox.close()
        await self._transport.close()

    def admit(self, members: Iterable[FleetMember]) -> None:
        """From now on these are let in, with their rights, and nobody else. A mesh without certificates lets in all."""

    def after_burst(self, then: Callable[[], None]) -> None:
        """Calls `then` once all that has arrived together is handled: at once, where nothing arrives."""
        if self._inbox.after is None:
            then()
        else:
            self._inbox.after.append(then)

    # Queries

    async def ask(
        self,
        key: str,
        message: Struct | None,
        kind: type[R],
        *,
        timeout: float,
        enough: Callable[[Reply[R]], bool] | None = None,
        limit: int = messages.MAX_STATE,
    ) -> list[Reply[R]]:
        """Queries all who serve `key`, and returns the replies that came within `timeout` seconds.

        Returns as soon as a reply is `enough`. No reply at all means that the outcome is unknown: the query
        may have been carried out or not. Raises MeshError where the query can't be sent."""
        replies: list[Reply[R]] = []

        def on_reply(of: str, payload: bytes, ok: bool) -> bool:
            reply = self._read_reply(of or key, payload, ok, kind, limit)
            if reply is None:
                return False
            replies.append(reply)
            return enough is not None and enough(reply)

        await self._all(lambda to: self._get(key, message, timeout, to), on_reply, timeout)
        return replies

    async def ask_one(self, key: str, message: Struct | None, kind: type[R], *, timeout: float) -> Reply[R] | None:
        """The first reply, message or problem; None if there was none within `timeout` seconds."""
        replies = await self.ask(key, message, kind, timeout=timeout, enough=lambda _: True)
        return replies[0] if replies else None

    def ask_then(
        self, key: str, message: Struct, kind: type[R], then: Callable[[Reply[R] | None], None], *, timeout: float
    ) -> None:
        """Queries, and calls `then` once with the first reply or None: cheaper than a task that waits."""
        first: Reply[R] | None = None

        def on_reply(of: str, payload: bytes, ok: bool) -> bool:
            nonlocal first
            first = self._read_reply(of or key, payload, ok, kind, messages.MAX_STATE)
            return first is not None

        self._get(key, message, timeout, _Collector(self._inbox, on_reply, lambda: then(first)))

    def _read_reply(self, key: str, payload: bytes, ok: bool, kind: type[R], limit: int) -> Reply[R] | None:
        """`key` is the answer's, or the question's where a problem has none."""
        now = self.now()
        try:
            if ok:
                return Reply(key, messages.decode_told(payload, kind, limit), arrived=now)
            if payload == b"Timeout":
                return None
            return Reply("", None, messages.decode(payload, Problem), now)
        except Malformed as error:
            self._strange.warning(key, "a reply on %.200r was malformed: %s", key, error)
            return None

    def _get(self, key: str, message: Struct | None, timeout: float, to: Collector) -> None:
        payload = None if message is None else messages.encode(message)
        self._transport.get(key, payload, None if message is None else type(message), timeout, to)

    async def _all(self, query: Callable[[Collector], None], on_reply: OnReply, timeout: float) -> None:
        """Makes a query, and returns when it is over, or when `on_reply` says that it is enough."""
        loop = self._inbox.loop
        done: asyncio.Future[None] = loop.create_future()  # not an Event: this is the way of every request

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
        tally: Tally | None = None,
    ) -> Declaration:
        """Calls `handler` for queries on `key` whose message is of `kind`. `tally` counts how they end.

        A payload that is not one is refused before the handler sees it, with code `malformed`; a query whose
        own key holds a wildcard is answered on `key` itself where that is concrete, and refused otherwise;
        with `depth` queries waiting for the event loop, or half as many of one host where the key names its sender,
        further ones are refused as `busy`, undecoded."""
        state = Backlog(depth=depth)
        wild, names_sender = "*" in key, key.endswith("/*/*")
        shares = HostShares(depth // 2)

        def turn_away(query: TransportQuery, code: str, message: str) -> None:
            if tally is not None:
                tally.refuse(code)
            refuse(query, Problem(code, message))

        def on_query(query: TransportQuery) -> None:
            asked = query.key
            host = asked.rsplit("/", 2)[-2] if names_sender else ""
            if state.closed:
                query.drop()
            elif host and not shares.enter(host):
                turn_away(query, "busy", f"too many requests of {host[:MAX_NAME]} are waiting here; ask again")
            elif not self._inbox.offer(state, handle, query, asked, self.now(), host):
                if host:
                    shares.leave(host)
                turn_away(query, "busy", "too many requests are waiting here; ask again")

        def handle(query: TransportQuery, asked: str, arrived: Ns, host: str) -> None:
            if host:
                shares.leave(host)
            if state.closed:
                # Unless it is dropped here and now, its sender waits for the whole of its timeout.
                query.drop()
                return
            if wild and "*" in asked:
                turn_away(query, "bad_key", f"name yourself in the key {key}: no wildcards")
                return
            payload = query.payload
            try:
                message = messages.decode(b"{}" if payload is None else payload, kind, limit)
            except Malformed as error:
                turn_away(query, "malformed", str(error))
                return
            incoming: IncomingQuery[Any] = IncomingQuery(
                query, asked, asked if wild else key, message, arrived, tally=tally
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

        return Declaration(self._transport.queryable(key, on_query), state)

    # Publications

    def publisher(self, key: str, kind: type, *, data: bool = False) -> Publisher:
        """A publisher for control messages, which block rather than get lost; with `data` they are dropped
        rather than wait, and yield to control."""
        return Publisher(self._transport.publisher(key, kind, Quality.DATA if data else Quality.CONTROL))

    def put(self, key: str, message: Struct) -> None:
        """Publishes one control message without a declaration: for keys of which there are many."""
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
        """Calls `handler(key, message)` for every publication on `key`; malformed ones are logged, those that
        find `depth` waiting are dropped, and counted as missed.

        All subscriptions that are alike share one declaration and one decoding of each message."""
        alike = (key, kind, depth, limit)
        if alike not in self._shared:
            self._shared[alike] = self._subscribe(key, kind, depth, limit)
        state, handlers, undeclare = self._shared[alike]
        handlers.append(handler)

        def leave() -> None:
            handlers.remove(handler)
            if not handlers:
                del self._shared[alike]
                undeclare()

        return Declaration(leave, state)

    def _subscribe(self, key: str, kind: type[S], depth: int, limit: int) -> _Subscription:
        state, handlers = Backlog(depth=depth), list[Callable[[str, Any], None]]()

        def on_sample(name: str, payload: bytes, _: bytes | None) -> None:
            if not self._inbox.offer(state, handle, name, payload):
                state.missed += 1

        def handle(name: str, payload: bytes) -> None:
            if not handlers:
                return
            try:
                message: S = messages.decode_told(payload, kind, limit)
            except Malformed as error:
                self._strange.warning(name, "ignored a publication on %.200r: %s", name, error)
                return
            for handler in tuple(handlers):
                guarded(self._tell, handler, name, message)

        return state, handlers, self._transport.subscriber(key, on_sample)

    def _tell(self, handler: Callable[[str, S], None], name: str, message: S) -> None:
        try:
            handler(name, message)
        except BadName as error:
            self._strange.warning(name, "ignored what came under a bad name: %s", error)

    def poll_latest(self, key: str, kind: type[S], *, depth: int = RING_DEPTH) -> PolledSubscription[S]:
        """Keeps the latest `depth` publications on `key`, without waking the event loop, until they are taken."""
        return PolledSubscription(*self._transport.ring(key, depth), kind, depth)

    def frame_publisher(self, key: str) -> FramePublisher:
        """A publisher of JPEG frames, which knows whether there are subscribers."""
        return FramePublisher(self._transport.publisher(key, None, Quality.FRAME), self._inbox.deliver)

    def frames(self, key: str) -> FrameWatch:
        """The newest frame on `key`, to be taken as often as the caller can. Close it."""
        return FrameWatch(self._transport, key, self._inbox.deliver, self.now)

    # Liveliness

    def alive(self, token: Token) -> Declaration:
        """Declares the liveliness token: it lives until the declaration is closed or this process is gone."""
        return Declaration(self._transport.token(self.keys.alive(token)))

    def watch(self, key: str, handler: Callable[[Token, bool], None]) -> Declaration:
        """Subscribes to liveliness: calls `handler(token, alive)` for each token on `key` that comes or
        goes, and for those that live already."""
        state = Backlog()

        def handle(text: str, alive: bool) -> None:
            if not state.closed and (token := self._token_of(text)) is not None:
                handler(token, alive)

        deliver = functools.partial(self._inbox.deliver, handle)
        return Declaration(self._transport.token_subscriber(key, deliver), state)

    async def living(self, key: str, *, timeout: float) -> list[Token]:
        """Queries liveliness once: the tokens on `key` that live now, sorted."""
        found: set[str] = set()

        def on_reply(text: str, *_: object) -> bool:
            found.add(text)
            return False

        await self._all(lambda to: self._transport.tokens(key, timeout, to), on_reply, timeout)
        return sorted(token for token in map(self._token_of, found) if token is not None)

    def watch_links(self) -> None:
        """Shows this session by a token that names it, until the mesh is left, and suspects links over which the token
        of the other's session, seen before, has not come back; unless its program shows another session: it has left
        that one, which Zenoh may not close. For programs that stay."""
        name = functools.partial(Token, self.me.host, Role.SESSION, self.me.client)
        own = self._transport.own_token(lambda session: self.keys.alive(name(session)))
        shown: dict[str, tuple[Sender, bool]] = {}

        def on_token(token: Token, alive: bool) -> None:
            shown.pop(token.instance, None)
            shown[token.instance] = Sender(token.host, token.name), alive
            if len(shown) > MAX_SESSIONS:
                del shown[next(iter(shown))]

        def look() -> None:
            if self._inbox.closed:
                return
            self._inbox.loop.call_later(LINK_PERIOD, look)
            about = "the token is missing of the linked session "
            gone = {peer: shown[peer][0] for peer in self._transport.peers() if peer in shown and not shown[peer][1]}
            there = {program for program, alive in shown.values() if alive} if gone else ()
            missing = [about + peer for peer, program in gone.items() if program not in there]
            self.suspicions.keep(missing, about)
            for what in missing:
                self.suspicions.suspect(what)

        self._kept += [own, self.watch(self.keys.alive_any(Role.SESSION), on_token)]
        look()

    def _token_of(self, text: str) -> Token | None:
        try:
            return self.keys.token_of(text)
        except BadName as error:
            self._strange.warning(text, "ignored a liveliness token: %s", error)
            return None


class _Collector(Collector):
    """Passes replies to `each` in the event loop, until that returns true. Calls `over` then, or at the end, once."""

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
