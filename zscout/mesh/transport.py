"""What a mesh needs of the network below it: bytes by key.

Callbacks may come on any thread, and must not block."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Protocol, TypeAlias

OnSample: TypeAlias = Callable[[str, bytes, bytes | None], None]
"""Called with key, payload and attachment."""
Undeclare: TypeAlias = Callable[[], None]


class Quality(Enum):
    CONTROL = "control"
    """Waits for a peer that does not read."""
    DATA = "data"
    """Is dropped rather than wait, and yields to control."""
    FRAME = "frame"
    """JPEG frames, likewise."""


class Collector(Protocol):
    """Takes the replies to one query, and then its end, once."""

    def on_reply(self, key: str, payload: bytes, ok: bool) -> None:
        """`ok`: `payload` is a message rather than an error."""

    def on_final(self) -> None: ...


class TransportQuery(Protocol):
    """A query that arrived. Each of the methods ends it: one that is kept makes its sender wait."""

    @property
    def key(self) -> str: ...
    @property
    def payload(self) -> bytes | None: ...
    def reply(self, key: str, payload: bytes, kind: type) -> None: ...
    def reply_error(self, payload: bytes, kind: type) -> None: ...
    def drop(self) -> None: ...


class TransportPublisher(Protocol):
    def put(self, payload: bytes, attachment: bytes | None = None) -> None: ...

    def match(self, on_matching: Callable[[bool], None]) -> bool:
        """Calls back whenever subscribers appear or are gone; returns whether there are any now."""

    def undeclare(self) -> None: ...


class Transport(Protocol):
    """A session on the network. What can't be sent is logged, but for queries, which raise MeshError."""

    def id(self) -> str:
        """Of this session, as the network tells it to others."""

    def peers(self) -> list[str]:
        """The ids of the sessions that this one is linked to."""

    def links(self) -> int: ...
    def relays(self) -> int: ...
    async def close(self) -> None: ...

    def get(self, key: str, payload: bytes | None, kind: type | None, timeout: float, to: Collector) -> None:
        """Queries all that serve `key`; it is over after `timeout` seconds at the latest."""

    def queryable(self, key: str, on_query: Callable[[TransportQuery], None]) -> Undeclare: ...
    def publisher(self, key: str, kind: type | None, quality: Quality) -> TransportPublisher: ...
    def put(self, key: str, payload: bytes, kind: type) -> None: ...
    def subscriber(self, key: str, on_sample: OnSample) -> Undeclare:
        """Of deletes, and of publications on keys with a wildcard, nothing is heard, here and by `ring`."""

    def ring(self, key: str, depth: int) -> tuple[Callable[[], tuple[str, bytes] | None], Undeclare]:
        """Keeps the latest `depth` publications; returns what takes the oldest of them."""

    def token(self, key: str) -> Undeclare: ...
    def token_subscriber(self, key: str, on_token: Callable[[str, bool], None]) -> Undeclare: ...

    def tokens(self, key: str, timeout: float, to: Collector) -> None:
        """The tokens that live, as keys of replies."""
