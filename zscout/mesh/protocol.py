"""A process's place on the mesh as services see it: typed queries, publications, liveliness, and a clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import msgspec

from zscout import messages
from zscout.keyexpr import Keys, Sender, Token
from zscout.mesh.declared import Declaration, Overheard, Publisher
from zscout.mesh.exchange import IncomingQuery, Reply
from zscout.mesh.frames import FramePublisher, FrameWatch
from zscout.mesh.inbox import QUEUE_DEPTH
from zscout.types import Ns

OVERHEARD = 32
"""Publications that `overhear` keeps."""

S = TypeVar("S")
R = TypeVar("R")


class MeshError(Exception):
    """The mesh can't be joined, or is closed; the message names the remedy."""


class Mesh(Protocol):
    """One process's place on the mesh.

    Handlers are plain functions that run in the event loop, in the order in which things arrived, and must
    not block. Declare once per purpose, never per request: Zenoh keeps memory for every key that was ever
    declared."""

    keys: Keys
    me: Sender

    def now(self) -> Ns:
        """Nanoseconds on this host's monotonic clock. Not comparable between hosts."""

    def links(self) -> int:
        """How many peers this process is linked to."""

    async def close(self) -> None:
        """Leaves the mesh: tokens die, and no handler is called any more. Bounded in time."""

    def after_burst(self, then: Callable[[], None]) -> None:
        """Calls `then` once all that has arrived together is handled: at once, where nothing arrives."""

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
        """Queries all who serve `key`, and returns the replies that came within `timeout` seconds.

        Returns as soon as a reply is `enough`. No reply at all means that the outcome is unknown: the query
        may have been carried out or not. Raises MeshError where the query can't be sent."""

    async def ask_one(
        self, key: str, message: msgspec.Struct | None, kind: type[R], *, timeout: float
    ) -> Reply[R] | None:
        """The first reply, message or problem; None if there was none within `timeout` seconds."""

    def ask_then(
        self,
        key: str,
        message: msgspec.Struct,
        kind: type[R],
        then: Callable[[Reply[R] | None], None],
        *,
        timeout: float,
    ) -> None:
        """Queries, and calls `then` once with the first reply or None: cheaper than a task that waits."""

    def serve(
        self,
        key: str,
        kind: Any,
        handler: Callable[[IncomingQuery[Any]], None],
        *,
        depth: int = QUEUE_DEPTH,
        limit: int = messages.MAX_PAYLOAD,
    ) -> Declaration:
        """Calls `handler` for queries on `key` whose message is of `kind`.

        A payload that is not one is refused before the handler sees it, with code `malformed`; a query whose
        own key holds a wildcard is answered on `key` itself where that is concrete, and refused otherwise;
        with `depth` queries waiting for the event loop, further ones are refused as `busy`."""

    # Publications

    def publisher(self, key: str, kind: type, *, data: bool = False) -> Publisher:
        """A publisher for control messages, which block rather than get lost; with `data` they are dropped
        rather than wait, and yield to control."""

    def put(self, key: str, message: msgspec.Struct) -> None:
        """Publishes one control message without a declaration: for keys of which there are many."""

    def subscribe(
        self,
        key: str,
        kind: type[S],
        handler: Callable[[str, S], None],
        *,
        depth: int = QUEUE_DEPTH,
        limit: int = messages.MAX_STATE,
    ) -> Declaration:
        """Calls `handler(key, message)` for every publication on `key`; malformed ones are logged.

        All subscriptions that are alike share one declaration and one decoding of each message."""

    def overhear(self, key: str, kind: type[S], *, depth: int = OVERHEARD) -> Overheard[S]:
        """Keeps the latest `depth` publications on `key`, without waking the event loop, until they are
        taken."""

    # Frames

    def frame_publisher(self, key: str) -> FramePublisher:
        """A publisher of JPEG frames, which knows whether there are subscribers."""

    def frames(self, key: str) -> FrameWatch:
        """The newest frame on `key`, to be taken as often as the caller can. Close it."""

    # Liveliness

    def alive(self, token: Token) -> Declaration:
        """Declares a liveliness token, until it is closed or this process is gone."""

    def watch(self, key: str, handler: Callable[[Token, bool], None]) -> Declaration:
        """Calls `handler(token, alive)` for tokens on `key`, those that live already included."""

    async def living(self, key: str, *, timeout: float) -> list[Token]:
        """The tokens on `key` that live now, sorted."""
