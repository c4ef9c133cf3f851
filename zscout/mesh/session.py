"""A process's place on the mesh: JSON messages over a transport, and one event loop for all handlers.

Items from Zenoh's threads pass one bounded inbox into the event loop, in order, with one wake-up per burst. Handlers
are plain functions that run there and must not block."""

from __future__ import annotations

import asyncio
import functools
import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple, Self, TypeAlias, TypeVar

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
    LatestByKey,
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

INBOX_DEPTH = 20_000  # items of all kinds that may wait for the event loop
BURST = 256  # items handled in a row at most
BURST_S = 0.02  # seconds after which a burst ends: timers and other services run between bursts
SHARE = 16  # queries of one host in the common queue; its surplus waits until the common queue is empty
RING_DEPTH = 32
KEPT_BY_KEY = 16  # waiting publications on one key if only the newest counts; then the newest replaces the last
MAX_REPLIES_PER_KEY = 8  # answers read per key and query, such as from the processes of one host
LINK_PERIOD = 1.0  # seconds between two checks that each linked session's token is visible
MAX_SESSIONS = 4_096  # sessions remembered
FINAL_SLACK = 0.5  # seconds after its timeout at which a query ends without the transport's report

_Subscription: TypeAlias = tuple[Backlog, list[Callable[[str, Any], None]], Undeclare]
"""A subscription that decodes once for all its handlers."""
OnReply: TypeAlias = Callable[[str, bytes, bool], bool]
"""Takes key, payload, and True for a message; returns True if no further reply is needed."""

S = TypeVar("S")
R = TypeVar("R")


class Lane(IntEnum):
    """The order in which items are handled when more arrive than the event loop can handle."""

    REPORT = 0
    """Tokens, publications, replies and ends of queries: never set aside."""
    ASK = 1
    QUESTION = 2
    """A query that changes nothing: set aside behind surplus asks."""


class _Item(NamedTuple):
    state: Backlog | None
    lane: Lane
    host: str
    call: Callable[..., None]
    args: tuple[Any, ...]


@dataclass(slots=True)
class Inbox:
    """Carries calls from Zenoh's threads into the event loop, with one wake-up per burst. Calls keep their order,
    except the surplus of a host: of its queries in one lane the first SHARE wait in the common queue, the others until
    that is empty."""

    loop: asyncio.AbstractEventLoop
    items: deque[_Item] = field(default_factory=deque)  # just arrived
    ready: deque[_Item] = field(default_factory=deque)
    surplus: dict[tuple[Lane, str], deque[_Item]] = field(default_factory=dict)
    shares: Counter[tuple[Lane, str]] = field(default_factory=Counter)  # queries of each host in `ready`
    set_aside: int = 0  # items in `surplus`
    scheduled: bool = False
    closed: bool = False
    after: list[Callable[[], None]] | None = None  # called after the present burst; None: outside a burst

    def offer(
        self, state: Backlog, call: Callable[..., None], *args: Any, lane: Lane = Lane.REPORT, host: str = ""
    ) -> bool:
        """Call `call(*args)` in the event loop; return False if too much waits."""
        waiting = len(self.items) + len(self.ready) + self.set_aside
        if self.closed or waiting >= INBOX_DEPTH or state.pending >= state.depth:
            return False
        state.pending += 1
        return self._put(_Item(state, lane, host, call, args))

    def behind(self, lane: Lane, host: str, call: Callable[..., None], *args: Any) -> bool:
        """Queue `call(*args)` in the surplus of `host`. Return False, without queueing, if the call need not wait: the
        host has no surplus, and, for a question, nothing else waits. Raises Refused if this surplus is too long."""
        of = lane, host
        if of not in self.surplus and not (lane is Lane.QUESTION and (self.ready or self.items or self.surplus)):
            return False
        waiting = self.surplus.setdefault(of, deque())
        if len(waiting) >= QUEUE_DEPTH // 2:
            raise Refused("busy", f"too many requests of {host[:MAX_NAME]} are waiting here; ask again")
        waiting.append(_Item(None, lane, host, call, args))
        self.set_aside += 1
        return True

    def deliver(self, call: Callable[..., None], *args: Any) -> None:
        """Like `offer`, without a limit: for items that must not be lost and whose number is bounded, such as
        disappeared tokens and ends of queries."""
        if not self.closed:
            self._put(_Item(None, Lane.REPORT, "", call, args))

    def close(self) -> None:
        """Drop all calls, waiting ones included."""
        self.closed = True
        for waiting in (self.items, self.ready, self.surplus):
            waiting.clear()
        self.set_aside = 0

    def _put(self, item: _Item) -> bool:
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
        over = self.loop.time() + BURST_S
        try:
            for _ in range(BURST):
                if self.closed or (item := self._next()) is None:
                    break
                if item.state is not None:
                    item.state.pending -= 1
                guarded(item.call, *item.args)
                if not (self.items or self.ready or self.surplus):
                    break
                # A question that was set aside may take long once the burst is over: others run before the next.
                if self.loop.time() >= over or (item.lane is Lane.QUESTION and item.state is None):
                    break
            after, self.after = self.after, None
            for then in after:
                guarded(then)
        finally:
            self.after = None
            # In this order, another thread sees the flag cleared, or its item is seen here.
            self.scheduled = False
            if (self.items or self.ready or self.surplus) and not self.closed:
                self.scheduled = True
                self.loop.call_soon(self.drain)

    def _next(self) -> _Item | None:
        if len(self.items) == 1 and not self.ready and not self.surplus:
            return self.items.popleft()  # the usual case
        while self.items:
            self._sort(self.items.popleft())
        if not self.ready:
            if not self.surplus:
                return None
            self._admit_surplus()
        item = self.ready.popleft()
        if item.lane is not Lane.REPORT:
            self.shares[item.lane, item.host] -= 1
        return item

    def _sort(self, item: _Item) -> None:
        of = item.lane, item.host
        if item.lane is Lane.REPORT:
            self.ready.append(item)
        elif self.shares[of] < SHARE and of not in self.surplus:
            self.shares[of] += 1
            self.ready.append(item)
        else:
            self.surplus.setdefault(of, deque()).append(item)
            self.set_aside += 1

    def _admit_surplus(self) -> None:
        """Move surplus of each host to the common queue, asks first."""
        self.shares.clear()
        lane = min((lane for lane, _ in self.surplus), default=None)
        for of in [of for of in self.surplus if of[0] is lane]:
            for _ in range(min(SHARE if lane is Lane.ASK else 1, len(self.surplus[of]))):
                self.ready.append(self.surplus[of].popleft())
                self.shares[of] += 1
                self.set_aside -= 1
            if not self.surplus[of]:
                del self.surplus[of]


def guarded(call: Callable[..., None], *args: Any) -> None:
    """Call a handler, and log the exception that it raises."""
    try:
        call(*args)
    except Refused:  # by a supervised handler, which has logged the cause
        pass
    except BadName as error:
        log.warning("ignored a message under a bad name: %s", error)
    except Exception:
        log.exception("a handler failed")


class Mesh:
    """One process's place on the mesh, an async context manager: typed queries, publications, liveliness, and a clock.

    Declare once per purpose, never per request: Zenoh never frees the memory of a declared key."""

    validity: Validity | None = None  # of this process's present certificate; None on a plain mesh

    def __init__(self, transport: RenewableTransport, keys: Keys, me: Sender, now: Callable[[], Ns]) -> None:
        self.keys, self.me, self.now = keys, me, now  # `now()`: ns on this host's monotonic clock
        self.suspicions = Suspicions(now, transport.renew)
        self._transport = transport
        self._malformed_log = SparseLog(log, now)
        self._inbox = Inbox(asyncio.get_running_loop())
        self._shared: dict[tuple[Any, ...], _Subscription] = {}
        self._kept: list[object] = []  # objects that live as long as this mesh

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    def links(self) -> int:
        """Links to peers."""
        return self._transport.links()

    def relays(self) -> int:
        """Links to relays."""
        return self._transport.relays()

    async def close(self) -> None:
        """Leave the mesh within a bounded time: tokens disappear, and no handler is called afterwards."""
        self._inbox.close()
        await self._transport.close()

    def admit(self, members: Iterable[FleetMember]) -> None:
        """Replace the members that are admitted, with their rights. A mesh without certificates admits all."""

    def after_burst(self, then: Callable[[], None]) -> None:
        """Call `then` after the present burst; at once outside a burst."""
        if self._inbox.after is None:
            then()
        else:
            self._inbox.after.append(then)

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
        """Query all servers of `key`; return the replies of `timeout` seconds, or up to the first that is `enough`.

        Without a reply it is unknown whether the query was carried out. Raises MeshError if it can't be sent."""
        replies: list[Reply[R]] = []
        answers: dict[str, int] = {}

        def on_reply(of: str, payload: bytes, ok: bool) -> bool:
            answers[of] = answers.get(of, 0) + 1
            if of and answers[of] > MAX_REPLIES_PER_KEY:
                return False
            reply = self._read_reply(of or key, payload, ok, kind, limit)
            if reply is None:
                return False
            replies.append(reply)
            return enough is not None and enough(reply)

        most = messages.largest(kind, limit)
        await self._all(lambda to: self._get(key, message, timeout, to), on_reply, timeout, most)
        return replies

    async def ask_one(self, key: str, message: Struct | None, kind: type[R], *, timeout: float) -> Reply[R] | None:
        """The first reply, message or problem; None if there was none within `timeout` seconds."""
        replies = await self.ask(key, message, kind, timeout=timeout, enough=lambda _: True)
        return replies[0] if replies else None

    def ask_then(
        self, key: str, message: Struct, kind: type[R], then: Callable[[Reply[R] | None], None], *, timeout: float
    ) -> None:
        """Query, and call `then` once with the first reply or None; cheaper than a waiting task."""
        first: Reply[R] | None = None

        def on_reply(of: str, payload: bytes, ok: bool) -> bool:
            nonlocal first
            first = self._read_reply(of or key, payload, ok, kind, messages.MAX_STATE)
            return first is not None

        most = messages.largest(kind)
        self._get(key, message, timeout, _Collector(self._inbox, on_reply, lambda: then(first), most))

    def _read_reply(self, key: str, payload: bytes, ok: bool, kind: type[R], limit: int) -> Reply[R] | None:
        """Return None for a timeout or a malformed reply. `key` is the query's for a problem, which has no key."""
        now = self.now()
        try:
            if ok:
                return Reply(key, messages.decode_received(payload, kind, limit), arrived=now)
            if payload == b"Timeout":
                return None
            return Reply("", None, messages.decode(payload, Problem), now)
        except Malformed as error:
            self._malformed_log.warning(key, "a reply on %.200r was malformed: %s", key, error)
            return None

    def _get(self, key: str, message: Struct | None, timeout: float, to: Collector) -> None:
        payload = None if message is None else messages.encode(message)
        self._transport.get(key, payload, None if message is None else type(message), timeout, to)

    async def _all(
        self, query: Callable[[Collector], None], on_reply: OnReply, timeout: float, most: int = messages.MAX_STATE
    ) -> None:
        """Query, and return when the query ends or `on_reply` returns True."""
        loop = self._inbox.loop
        done: asyncio.Future[None] = loop.create_future()  # cheaper than an Event: every request comes by here

        def finish() -> None:
            if not done.done():
                done.set_result(None)

        query(_Collector(self._inbox, on_reply, finish, most))
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
        lane: Lane = Lane.ASK,
        concerns: Callable[[IncomingQuery[Any]], tuple[Lane, str]] | None = None,
        unanswered: int | None = None,
    ) -> Declaration:
        """Call `handler` for queries on `key` with a message of `kind`; `tally` counts how they end. `concerns` returns
        the lane of a decoded query, and the host whose surplus it waits behind (see `Inbox`).

        Queries with a wildcard key are refused, unless `key` is concrete: then they are answered on `key`. Refused as
        `busy`: queries while `depth` others wait, or half of it from one host if the key names the sender; and queries
        while `unanswered` others have no answer yet. Bad payloads are refused as `malformed`."""
        state = Backlog(depth=depth)
        wild, names_sender = "*" in key, key.endswith("/*/*")
        shares = HostShares(depth // 2)
        open_ = None if unanswered is None else HostShares(unanswered // 2, unanswered)

        def reject(query: TransportQuery, code: str, message: str) -> None:
            if tally is not None:
                tally.refuse(code)
            refuse(query, Problem(code, message))

        def on_query(query: TransportQuery) -> None:
            asked = query.key
            host = asked.rsplit("/", 2)[-2] if names_sender else ""
            if state.closed:
                query.drop()
            elif host and not shares.enter(host):
                reject(query, "busy", f"too many requests of {host[:MAX_NAME]} are waiting here; ask again")
            elif not self._inbox.offer(state, handle, query, asked, self.now(), host, lane=lane, host=host):
                if host:
                    shares.leave(host)
                reject(query, "busy", "too many requests are waiting here; ask again")

        def handle(query: TransportQuery, asked: str, arrived: Ns, host: str) -> None:
            if host:
                shares.leave(host)
            if state.closed:
                # Dropped now, or its sender waits for the whole timeout.
                query.drop()
                return
            if wild and "*" in asked:
                reject(query, "bad_key", f"name yourself in the key {key}: no wildcards")
                return
            payload = query.payload
            try:
                message = messages.decode(b"{}" if payload is None else payload, kind, limit)
            except Malformed as error:
                reject(query, "malformed", str(error))
                return
            incoming: IncomingQuery[Any] = IncomingQuery(
                query, asked, asked if wild else key, message, arrived, tally=tally
            )
            carry_out(incoming, host, waited=concerns is None)

        def carry_out(incoming: IncomingQuery[Any], host: str, *, waited: bool) -> None:
            if state.closed:
                incoming.drop()
                return
            try:
                if not waited and concerns is not None:
                    lane, of = concerns(incoming)
                    later = functools.partial(carry_out, incoming, host, waited=True)
                    if (lane is Lane.QUESTION or of != host) and self._inbox.behind(lane, of, later):
                        return
                if open_ is not None:
                    if not open_.enter(host):
                        raise Refused("busy", "too many requests are being answered here; ask again")
                    incoming.over = functools.partial(open_.leave, host)
                handler(incoming)
            except Refused as refused:
                incoming.refuse(refused.problem)
            except BadName as error:
                incoming.refuse(Problem("bad_name", str(error)))
            except Exception:
                incoming.refuse(Problem("internal", "the request failed here; see this node's log"))
                raise

        return Declaration(self._transport.queryable(key, on_query), state)

    def publisher(self, key: str, kind: type, *, data: bool = False) -> Publisher:
        """A publisher for control messages, which block rather than get lost, or for `data`, which is dropped rather
        than queued and has a lower priority."""
        return Publisher(self._transport.publisher(key, kind, Quality.DATA if data else Quality.CONTROL))

    def put(self, key: str, message: Struct) -> None:
        """Publish one control message without a declaration: for purposes with many keys."""
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
        """Call `handler(key, message)` for every publication on `key`. Malformed ones are logged; while `depth` of them
        wait, further ones are dropped and counted as missed. Equal subscriptions share declaration and decoding."""
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
        most = messages.largest(kind, limit)

        waiting = LatestByKey(KEPT_BY_KEY if kind in messages.NEWEST_COUNTS else None)

        def on_sample(name: str, payload: bytes, _: bytes | None) -> None:
            # A payload over the limit is cut, and refused when it is decoded.
            if not waiting.put(name, payload[: most + 1]):
                state.missed += 1
            elif not self._inbox.offer(state, handle, name):
                waiting.withdraw(name)
                state.missed += 1

        def handle(name: str) -> None:
            payload = waiting.take(name)
            if not handlers:
                return
            try:
                message: S = messages.decode_received(payload, kind, limit)
            except Malformed as error:
                self._malformed_log.warning(name, "ignored a publication on %.200r: %s", name, error)
                return
            for handler in tuple(handlers):
                guarded(self._call, handler, name, message)

        return state, handlers, self._transport.subscriber(key, on_sample)

    def _call(self, handler: Callable[[str, S], None], name: str, message: S) -> None:
        try:
            handler(name, message)
        except BadName as error:
            self._malformed_log.warning(name, "ignored a message under a bad name: %s", error)

    def poll_latest(self, key: str, kind: type[S], *, depth: int = RING_DEPTH) -> PolledSubscription[S]:
        """Keep the latest `depth` publications on `key` until the caller takes them, without waking the event loop."""
        return PolledSubscription(*self._transport.ring(key, depth, messages.largest(kind)), kind, depth)

    def frame_publisher(self, key: str) -> FramePublisher:
        """A publisher of JPEG frames, which knows whether there are subscribers."""
        return FramePublisher(self._transport.publisher(key, None, Quality.FRAME), self._inbox.deliver)

    def frames(self, key: str) -> FrameWatch:
        """Watch the newest frame on `key`. The caller takes frames at its own pace, and closes the watch."""
        return FrameWatch(self._transport, key, self._inbox.deliver, self.now)

    def alive(self, token: Token) -> Declaration:
        """Declare the liveliness token until the declaration is closed or garbage-collected."""
        return Declaration(self._transport.token(self.keys.alive(token)))

    def watch(self, key: str, handler: Callable[[Token, bool], None]) -> Declaration:
        """Call `handler(token, alive)` for each token on `key` that lives, appears or disappears."""
        state = Backlog()

        def handle(text: str, alive: bool) -> None:
            if not state.closed and (token := self._token_of(text)) is not None:
                handler(token, alive)

        deliver = functools.partial(self._inbox.deliver, handle)
        return Declaration(self._transport.token_subscriber(key, deliver), state)

    async def living(self, key: str, *, timeout: float) -> list[Token]:
        """The live tokens on `key`, sorted."""
        found: set[str] = set()

        def on_reply(text: str, *_: object) -> bool:
            found.add(text)
            return False

        await self._all(lambda to: self._transport.tokens(key, timeout, to), on_reply, timeout)
        return sorted(token for token in map(self._token_of, found) if token is not None)

    def watch_links(self) -> None:
        """Declare a token for this session, and suspect links to sessions whose token disappeared, unless their program
        shows another session (Zenoh may not close the old one). For long-running programs."""
        name = functools.partial(Token, self.me.host, Role.SESSION, self.me.client)
        own = self._transport.own_token(lambda session: self.keys.alive(name(session)))
        # By session: the programs that show a token of it, and the program of the last change.
        shown: dict[str, tuple[set[Sender], Sender]] = {}

        def on_token(token: Token, alive: bool) -> None:
            program = Sender(token.host, token.name)
            by, _ = shown.pop(token.instance, (set[Sender](), program))
            (by.add if alive else by.discard)(program)
            shown[token.instance] = by, program
            if len(shown) > MAX_SESSIONS:
                del shown[next(iter(shown))]

        def look() -> None:
            if self._inbox.closed:
                return
            self._inbox.loop.call_later(LINK_PERIOD, look)
            about = "the token is missing of the linked session "
            gone = {peer: shown[peer][1] for peer in self._transport.peers() if peer in shown and not shown[peer][0]}
            there = {program for by, _ in shown.values() for program in by} if gone else ()
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
            self._malformed_log.warning(text, "ignored a liveliness token: %s", error)
            return None


class _Collector(Collector):
    """Pass replies to `each` in the event loop until it returns True; then, or at the end, call `over` once."""

    def __init__(self, inbox: Inbox, each: OnReply, over: Callable[[], None], most: int) -> None:
        self._inbox, self._each, self._over, self._most = inbox, each, over, most
        self._state = Backlog(depth=INBOX_DEPTH)
        self._open = True

    def on_reply(self, key: str, payload: bytes, ok: bool) -> None:
        self._inbox.offer(self._state, self._take, key, payload[: self._most + 1], ok)

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
