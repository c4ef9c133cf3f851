"""One process's place on the mesh."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any, Self, TypeVar

import msgspec
import zenoh
from zenoh.handlers import Callback, RingChannel

from zscout import clock, messages
from zscout.config import Mesh as MeshConfig
from zscout.keyexpr import BadName, Keys, Sender, Token
from zscout.mesh.declared import Declared, Overheard, Publisher, Shared
from zscout.mesh.exchange import Refused, Reply, Request, drop, encoding_of, read_reply, reply_problem
from zscout.mesh.frames import FramePublisher, FrameWatch
from zscout.mesh.inbox import QUEUE_DEPTH, Backlog, Inbox
from zscout.mesh.settings import zenoh_config
from zscout.messages import Malformed, Problem
from zscout.scheduling.model import Ns

log = logging.getLogger(__name__)

OVERHEARD = 32
"""Publications kept for whoever looks only now and then."""
CLOSE_TIMEOUT = 3.0

S = TypeVar("S")
R = TypeVar("R")


class MeshError(Exception):
    """The mesh can't be joined, or is closed; the message names the remedy."""


class Mesh:
    """One process's place on the mesh. `await Mesh.open(...)`; an async context manager."""

    def __init__(
        self, session: zenoh.Session, keys: Keys, me: Sender, loop: asyncio.AbstractEventLoop
    ) -> None:
        self._session = session
        self._inbox = Inbox(loop)
        self._shared: dict[tuple[Any, ...], Shared] = {}
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
            got = read_reply(reply, kind, limit)
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
            got = read_reply(reply, kind, messages.MAX_STATE)
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
                encoding=None if message is None else encoding_of(type(message)),
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
        state = Backlog(depth=depth)
        wild = "*" in key

        def on_query(query: zenoh.Query) -> None:
            if state.closed:
                drop(query)
            elif not self._inbox.offer(state, handle, query, clock.now()):
                reply_problem(query, Problem("busy", "too many requests are waiting here; ask again"))
                drop(query)

        def handle(query: zenoh.Query, arrived: Ns) -> None:
            if state.closed:
                # Unless it is dropped here and now, its asker waits for the whole of its timeout.
                drop(query)
                return
            asked = str(query.key_expr)
            if wild and "*" in asked:
                reply_problem(query, Problem("bad_key", f"name yourself in the key {key}: no wildcards"))
                drop(query)
                return
            payload = query.payload
            try:
                raw = payload.to_bytes() if payload is not None else b"{}"
                message = messages.decode(raw, kind, limit)
                request: Request[Any] = Request(query, asked, asked if wild else key, message, arrived)
            except Malformed as error:
                reply_problem(query, Problem("malformed", str(error)))
                drop(query)
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
                encoding=encoding_of(kind),
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
                encoding=encoding_of(type(message)),
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

        return Declared(leave, state)

    def _subscribe(self, key: str, kind: type[S], shared: Shared, limit: int) -> Callable[[], Any]:
        state = shared.state

        def on_sample(sample: zenoh.Sample) -> None:
            if not self._inbox.offer(state, handle, sample):
                state.missed += 1

        def handle(sample: zenoh.Sample) -> None:
            if state.closed:
                return
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

    def overhear(self, key: str, kind: type[S], *, depth: int = OVERHEARD) -> Overheard[S]:
        """Keeps the latest `depth` publications on `key` for whoever looks: with a `kind` of few fields, to
        know now and then who spoke costs next to nothing that way."""
        return Overheard(self._session.declare_subscriber(key, RingChannel(depth)), kind, depth)

    # Frames

    def frame_publisher(self, key: str) -> FramePublisher:
        """A publisher of JPEG frames, which knows whether anybody looks."""
        return FramePublisher(self._session, key, self._inbox)

    def frames(self, key: str) -> FrameWatch:
        """The newest frame on `key`, for whoever looks as often as it can. Close it."""
        return FrameWatch(self._session, key, self._inbox)

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


def _nothing() -> None:
    pass
