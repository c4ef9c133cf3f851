"""A Zenoh session as asyncio sees it: typed queries, queryables, publications, liveliness.

Everything that arrives on Zenoh's threads goes through one bounded inbox into the event loop, in the order
in which it came; handlers are plain functions that run there and must not block. A query that finds its
queue full is answered "busy"; a publication that does is counted as missed, and its subscriber is told.

Declare once per purpose, never per request: Zenoh keeps memory for every key that was ever declared.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, Self, TypeAlias, TypeVar

# Zenoh reads this once, when it is loaded. With few receiving threads one cut-off host stalls every link.
os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx:(worker_threads:16),net:(worker_threads:4),acc:(worker_threads:4),tx:(worker_threads:4),"
    "app:(worker_threads:2))",
)

import msgspec
import zenoh
from zenoh.handlers import Callback, RingChannel

from zscout import clock, messages
from zscout.config import Mesh as MeshConfig
from zscout.keyexpr import BadName, Keys, Sender, Token
from zscout.messages import Malformed, Problem
from zscout.scheduling.model import Ns, Term

log = logging.getLogger(__name__)

INBOX_DEPTH = 20_000
"""Items of all kinds that may wait for the event loop."""
BURST = 256
"""Items that are handled in one go at most, those included that arrive meanwhile."""
QUEUE_DEPTH = 1_024
"""Items of one declaration that may wait for the event loop."""
BLOCK_US = 100_000
"""The longest that a publication waits for a peer that does not read, before that peer is given up."""
OVERHEARD = 32
"""Publications kept for whoever looks only now and then."""
SCOUTING_DELAY_MS = 200
CLOSE_TIMEOUT = 3.0

JSON = zenoh.Encoding.APPLICATION_JSON
S = TypeVar("S")
R = TypeVar("R")


class MeshError(Exception):
    """The mesh can't be joined, or is closed; the message names the remedy."""


class Refused(Exception):
    """Raised by a handler to answer a query with an error."""

    def __init__(self, code: str, message: str, term: Term | None = None) -> None:
        super().__init__(message)
        self.problem = Problem(code, message, term)


@dataclass(frozen=True, slots=True)
class Reply(Generic[R]):
    """One answer to a query: a message, or a problem."""

    key: str
    message: R | None
    problem: Problem | None = None


class Request(Generic[R]):
    """A query that arrived: answer it once, now or later. Not answering at all reads as "unknown"."""

    __slots__ = ("_query", "_reply_key", "arrived", "key", "message")

    def __init__(self, query: zenoh.Query, key: str, reply_key: str, message: R, arrived: Ns) -> None:
        self._query: zenoh.Query | None = query
        self._reply_key = reply_key
        self.key = key
        self.message = message
        self.arrived = arrived
        """When it came out of the network, on this host's clock."""

    def answer(self, message: msgspec.Struct) -> None:
        if self._query is not None:
            encoding = _encoding(type(message))
            try:
                self._query.reply(self._reply_key, messages.encode(message), encoding=encoding)
            except zenoh.ZError as error:
                log.debug("an answer on %s was not sent: %s", self.key, error)
            self._drop()

    def refuse(self, problem: Problem) -> None:
        if self._query is not None:
            _reply_problem(self._query, problem)
            self._drop()

    def _drop(self) -> None:
        # A query that is kept after its reply makes the asker wait for its timeout.
        if self._query is not None:
            _drop(self._query)
            self._query = None


class Publisher:
    """Publishes messages of one kind on one key."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher

    def put(self, message: msgspec.Struct) -> None:
        try:
            self._publisher.put(messages.encode(message))
        except zenoh.ZError as error:
            log.warning("a publication on %s was not sent: %s", self._publisher.key_expr, error)

    def close(self) -> None:
        self._publisher.undeclare()  # type: ignore[no-untyped-call]


@dataclass(slots=True)
class _Declaration:
    """Bookkeeping of one declaration: how many of its items wait, and whether any was dropped."""

    pending: int = 0
    missed: int = 0
    closed: bool = False
    depth: int = QUEUE_DEPTH


class Declared:
    """A declaration that can be taken back."""

    def __init__(self, undeclare: Callable[[], Any], state: _Declaration | None = None) -> None:
        self._undeclare: Callable[[], Any] | None = undeclare
        self._state = state or _Declaration()

    @property
    def missed(self) -> int:
        """Publications that were dropped because the queue was full."""
        return self._state.missed

    def close(self) -> None:
        if self._undeclare is not None:
            undeclare: Callable[[], Any] = self._undeclare
            self._undeclare = None
            try:
                undeclare()
            except zenoh.ZError as error:
                log.debug("undeclaring failed: %s", error)


_Item: TypeAlias = tuple[_Declaration | None, Callable[..., None], tuple[Any, ...]]


class Overheard(Declared, Generic[S]):
    """Publications that wake nobody: the latest are kept, outside Python, until somebody looks."""

    def __init__(self, subscriber: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]], kind: type[S]) -> None:
        super().__init__(subscriber.undeclare)
        self._subscriber, self._kind = subscriber, kind

    def take(self) -> list[S]:
        """What came since the last look, oldest first; malformed ones are dropped without a word."""
        found: list[S] = []
        while (sample := self._subscriber.try_recv()) is not None:
            try:
                found.append(messages.decode(sample.payload.to_bytes(), self._kind, messages.MAX_STATE))
            except Malformed:
                continue
        return found


@dataclass(slots=True)
class _Shared:
    """A subscription whose publications are read once for all handlers of this process."""

    state: _Declaration
    handlers: list[Callable[[str, Any], None]] = field(default_factory=list)
    undeclare: Callable[[], Any] = lambda: None


@dataclass(slots=True)
class _Inbox:
    """From Zenoh's threads into the event loop, waking it once for whatever has gathered."""

    loop: asyncio.AbstractEventLoop
    items: deque[tuple[_Declaration | None, Callable[..., None], tuple[Any, ...]]] = field(
        default_factory=deque
    )
    scheduled: bool = False
    closed: bool = False
    draining: bool = False
    after: list[Callable[[], None]] = field(default_factory=list)
    """What is called once the present burst has been handled."""

    def offer(self, state: _Declaration | None, call: Callable[..., None], *args: Any) -> bool:
        if self.closed or len(self.items) >= INBOX_DEPTH:
            return False
        if state is not None:
            if state.pending >= state.depth:
                return False
            state.pending += 1
        self.items.append((state, call, args))
        if not self.scheduled:
            self.scheduled = True
            try:
                self.loop.call_soon_threadsafe(self.drain)
            except RuntimeError:  # the loop is closed: the process is on its way out
                self.closed = True
                return False
        return True

    def drain(self) -> None:
        self.draining = True
        try:
            for _ in range(BURST):
                if not self.items:
                    break
                state, call, args = self.items.popleft()
                if state is not None:
                    state.pending -= 1
                    if state.closed:
                        continue
                _guarded(call, *args)
            self.draining = False
            after, self.after = self.after, []
            for then in after:
                _guarded(then)
        finally:
            self.draining = False
            # In this order: who offers something now either sees that nobody is coming, or is seen.
            self.scheduled = False
            if self.items:
                self.scheduled = True
                self.loop.call_soon(self.drain)


class Mesh:
    """One process's place on the mesh. `await Mesh.open(...)`; an async context manager."""

    def __init__(
        self, session: zenoh.Session, keys: Keys, me: Sender, loop: asyncio.AbstractEventLoop
    ) -> None:
        self._session = session
        self._inbox = _Inbox(loop)
        self._shared: dict[tuple[Any, ...], _Shared] = {}
        self.keys = keys
        self.me = me

    @classmethod
    async def open(cls, fleet: str, me: Sender, config: MeshConfig | None = None) -> Self:
        """Joins the mesh of `fleet`. Raises MeshError where an address can't be had."""
        keys = Keys(fleet)
        settings = zenoh_config(config or MeshConfig())
        try:
            session = await asyncio.to_thread(zenoh.open, settings)
        except zenoh.ZError as error:
            raise MeshError(
                f"the mesh can't be joined: {error}; check listen and connect under [mesh]"
            ) from None
        return cls(session, keys, me, asyncio.get_running_loop())

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    def links(self) -> int:
        """How many peers this process is linked to; 0 means that nobody can be heard."""
        return len(self._session.info.links())

    async def close(self) -> None:
        """Leaves the mesh: tokens die, nothing arrives any more. Bounded by CLOSE_TIMEOUT."""
        self._inbox.closed = True
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await asyncio.to_thread(self._session.close)
        except (TimeoutError, zenoh.ZError) as error:
            log.warning("the mesh session did not close cleanly: %r", error)

    def after_burst(self, then: Callable[[], None]) -> None:
        """Calls `then` once all that has arrived together is handled: at once, where nothing arrives."""
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
        """Asks all who answer on `key`, and returns what came within `timeout` seconds.

        Returns as soon as an answer is `enough`. No answer at all means "unknown": the question may have been
        carried out or not."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[None] = loop.create_future()
        replies: list[Reply[R]] = []

        def arrived(reply: zenoh.Reply) -> None:
            got = _reply(reply, kind, limit)
            if got is not None and not done.done():
                replies.append(got)
                if enough is not None and enough(got):
                    done.set_result(None)

        def over() -> None:
            if not done.done():
                done.set_result(None)

        def on_reply(reply: zenoh.Reply) -> None:
            self._inbox.offer(None, arrived, reply)

        def on_final() -> None:
            if not done.done():
                self._inbox.offer(None, over)

        self._get(key, message, Callback(on_reply, on_final, indirect=False), timeout)
        guard = loop.call_later(timeout + 0.5, over)
        try:
            await done
        finally:
            guard.cancel()
        return replies

    async def ask_one(
        self, key: str, message: msgspec.Struct | None, kind: type[R], *, timeout: float
    ) -> Reply[R] | None:
        """The first answer, message or problem; None if there was none within `timeout` seconds."""
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
        """Asks, and calls `then` once with the first answer, or with None: cheaper than a task that waits."""
        open_: list[Callable[[Reply[R] | None], None]] = [then]

        def tell(answer: Reply[R] | None) -> None:
            if open_:
                open_.pop()(answer)

        def arrived(reply: zenoh.Reply) -> None:
            got = _reply(reply, kind, messages.MAX_STATE)
            if got is not None:
                tell(got)

        def on_reply(reply: zenoh.Reply) -> None:
            self._inbox.offer(None, arrived, reply)

        def on_final() -> None:
            if open_:
                self._inbox.offer(None, tell, None)

        self._get(key, message, Callback(on_reply, on_final, indirect=False), timeout)

    def _get(
        self, key: str, message: msgspec.Struct | None, handler: Callback[zenoh.Reply], timeout: float
    ) -> None:
        try:
            self._session.get(
                key,
                handler,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
                payload=None if message is None else messages.encode(message),
                encoding=None if message is None else _encoding(type(message)),
            )
        except zenoh.ZError as error:
            raise MeshError(f"{key} can't be asked: {error}") from None

    def serve(
        self,
        key: str,
        kind: Any,
        handler: Callable[[Request[Any]], None],
        *,
        depth: int = QUEUE_DEPTH,
        limit: int = messages.MAX_PAYLOAD,
    ) -> Declared:
        """Answers queries on `key`. `handler` gets a Request whose message is of `kind`.

        A payload that is not one is refused before the handler sees it, with code `malformed`; a query whose
        own key holds a wildcard is answered on `key` itself where that is concrete, and refused otherwise."""
        state = _Declaration(depth=depth)
        wild = "*" in key

        def on_query(query: zenoh.Query) -> None:
            if not self._inbox.offer(state, handle, query, clock.now()):
                _reply_problem(query, Problem("busy", "too many requests are waiting here; ask again"))
                _drop(query)

        def handle(query: zenoh.Query, arrived: Ns) -> None:
            asked = str(query.key_expr)
            if wild and "*" in asked:
                _reply_problem(query, Problem("bad_key", f"name yourself in the key {key}: no wildcards"))
                _drop(query)
                return
            payload = query.payload
            try:
                raw = payload.to_bytes() if payload is not None else b"{}"
                message = messages.decode(raw, kind, limit)
                request: Request[Any] = Request(query, asked, asked if wild else key, message, arrived)
            except Malformed as error:
                _reply_problem(query, Problem("malformed", str(error)))
                _drop(query)
                return
            try:
                handler(request)
            except Refused as refused:
                request.refuse(refused.problem)
            except BadName as error:
                request.refuse(Problem("bad_name", str(error)))
            except Exception:
                request.refuse(Problem("internal", "the request failed here; see this node's log"))
                raise

        queryable = self._session.declare_queryable(key, Callback(on_query, _nothing, indirect=False))

        def leave() -> None:
            state.closed = True
            queryable.undeclare()  # type: ignore[no-untyped-call]

        return Declared(leave, state)

    # Publications

    def publisher(self, key: str, kind: type, *, data: bool = False) -> Publisher:
        """A publisher for control messages, which block rather than get lost; with `data` they are dropped
        rather than wait, and yield to control."""
        control = zenoh.CongestionControl.BLOCK, zenoh.Priority.INTERACTIVE_HIGH
        bulk = zenoh.CongestionControl.DROP, zenoh.Priority.DATA_LOW
        congestion, priority = bulk if data else control
        return Publisher(
            self._session.declare_publisher(
                key,
                encoding=_encoding(kind),
                congestion_control=congestion,
                priority=priority,
                express=not data,
            )
        )

    def put(self, key: str, message: msgspec.Struct) -> None:
        """Publishes one control message without a declaration: for keys of which there are many."""
        try:
            self._session.put(
                key,
                messages.encode(message),
                encoding=_encoding(type(message)),
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
            )
        except zenoh.ZError as error:
            log.warning("a publication on %s was not sent: %s", key, error)

    def subscribe(
        self,
        key: str,
        kind: type[S],
        handler: Callable[[str, S], None],
        *,
        depth: int = QUEUE_DEPTH,
        limit: int = messages.MAX_STATE,
    ) -> Declared:
        """Calls `handler(key, message)` for every publication on `key`; malformed ones are logged.

        All who subscribe alike share one subscription and one reading of each message."""
        alike = (key, kind, depth, limit)
        shared = self._shared.get(alike)
        if shared is None:
            shared = self._shared[alike] = _Shared(_Declaration(depth=depth))
            shared.undeclare = self._subscribe(key, kind, shared, limit)
        handlers, state, undeclare = shared.handlers, shared.state, shared.undeclare
        handlers.append(handler)

        def leave() -> None:
            handlers.remove(handler)
            if not handlers:
                state.closed = True
                del self._shared[alike]
                undeclare()

        return Declared(leave, state)

    def _subscribe(self, key: str, kind: type[S], shared: _Shared, limit: int) -> Callable[[], Any]:
        state = shared.state

        def on_sample(sample: zenoh.Sample) -> None:
            if not self._inbox.offer(state, handle, sample):
                state.missed += 1

        def handle(sample: zenoh.Sample) -> None:
            try:
                message: S = messages.decode(sample.payload.to_bytes(), kind, limit)
            except Malformed as error:
                log.warning("ignored a publication on %.200r: %s", str(sample.key_expr), error)
                return
            name = str(sample.key_expr)
            for handler in tuple(shared.handlers):
                try:
                    handler(name, message)
                except BadName as error:
                    log.warning("ignored a publication on %.200r: %s", name, error)
                except Exception:
                    log.exception("a handler failed")

        return self._session.declare_subscriber(key, Callback(on_sample, _nothing, indirect=False)).undeclare

    def overhear(self, key: str, kind: type[S]) -> Overheard[S]:
        """Keeps the latest publications on `key` for whoever looks: with a `kind` of few fields, to know now
        and then who spoke costs next to nothing that way."""
        return Overheard(self._session.declare_subscriber(key, RingChannel(OVERHEARD)), kind)

    # Liveliness

    def alive(self, token: Token) -> Declared:
        """Declares that something lives, until it is closed or this process is gone."""
        held = self._session.liveliness().declare_token(self.keys.alive(token))
        return Declared(held.undeclare)

    def watch(self, key: str, handler: Callable[[Token, bool], None]) -> Declared:
        """Calls `handler(token, alive)` for tokens on `key`, those that live already included."""

        # Not bounded like data: a lost death would be a leak. There are as many as there are processes.
        def on_sample(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            self._inbox.offer(None, handle, str(sample.key_expr), alive)

        def handle(text: str, alive: bool) -> None:
            try:
                token = self.keys.token_of(text)
            except BadName as error:
                log.warning("ignored a liveliness token: %s", error)
                return
            handler(token, alive)

        subscriber = self._session.liveliness().declare_subscriber(
            key, Callback(on_sample, _nothing, indirect=False), history=True
        )
        return Declared(subscriber.undeclare)

    async def living(self, key: str, *, timeout: float) -> list[Token]:
        """The tokens on `key` that live now, sorted."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[None] = loop.create_future()
        found: set[Token] = set()

        def arrived(text: str) -> None:
            try:
                found.add(self.keys.token_of(text))
            except BadName as error:
                log.warning("ignored a liveliness token: %s", error)

        def over() -> None:
            if not done.done():
                done.set_result(None)

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._inbox.offer(None, arrived, str(reply.ok.key_expr))

        def on_final() -> None:
            self._inbox.offer(None, over)

        self._session.liveliness().get(key, Callback(on_reply, on_final, indirect=False), timeout=timeout)
        try:
            async with asyncio.timeout(timeout + 0.5):
                await done
        except TimeoutError:
            pass
        return sorted(found)


def zenoh_config(config: MeshConfig) -> zenoh.Config:
    """The Zenoh settings behind a `[mesh]` table."""
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": config.multicast,
        "scouting/multicast/address": config.multicast_address,
        "scouting/multicast/interface": config.interface,
        "scouting/delay": SCOUTING_DELAY_MS,
        "transport/link/tx/lease": round(config.lease * 1000),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": BLOCK_US,
        "transport/shared_memory/enabled": False,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5},
    }
    if config.listen:
        settings["listen/endpoints"] = list(config.listen)
    if config.connect:
        settings["connect/endpoints"] = list(config.connect)
    result = zenoh.Config()
    for key, value in settings.items():
        result.insert_json5(key, json.dumps(value))
    return result


_ENCODINGS: dict[type, zenoh.Encoding] = {}


def _encoding(kind: type) -> zenoh.Encoding:
    encoding = _ENCODINGS.get(kind)
    if encoding is None:
        encoding = _ENCODINGS[kind] = JSON.with_schema(messages.schema(kind))
    return encoding


def _reply(reply: zenoh.Reply, kind: type[R], limit: int) -> Reply[R] | None:
    sample = reply.ok
    try:
        if sample is not None:
            return Reply(str(sample.key_expr), messages.decode(sample.payload.to_bytes(), kind, limit))
        raw = reply.err.payload.to_bytes() if reply.err is not None else b""
        if raw == b"Timeout":
            return None
        problem: Problem = messages.decode(raw, Problem)
        return Reply("", None, problem)
    except Malformed as error:
        log.warning("an answer was not understood: %s", error)
        return None


def _reply_problem(query: zenoh.Query, problem: Problem) -> None:
    try:
        query.reply_err(messages.encode(problem), encoding=_encoding(Problem))
    except zenoh.ZError as error:
        log.debug("an error answer was not sent: %s", error)


def _guarded(call: Callable[..., None], *args: Any) -> None:
    try:
        call(*args)
    except Exception:
        log.exception("a handler failed")


def _drop(query: zenoh.Query) -> None:
    query.drop()  # type: ignore[no-untyped-call]


def _nothing() -> None:
    pass
