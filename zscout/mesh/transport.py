"""The network below a mesh: bytes by key. Callbacks may run on any thread, and must not block."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Protocol, TypeAlias

OnSample: TypeAlias = Callable[[str, bytes, bytes | None], None]  # called with key, payload and attachment
Undeclare: TypeAlias = Callable[[], None]


class Quality(Enum):
    CONTROL = "control"  # the sender blocks while a peer does not read
    DATA = "data"  # dropped rather than queued; of lower priority than control
    FRAME = "frame"  # JPEG frames, dropped rather than queued


class Collector(Protocol):
    """Receives the replies to one query, and then its end, once."""

    def on_reply(self, key: str, payload: bytes, ok: bool) -> None:
        """`ok` is True for a message, False for an error."""

    def on_final(self) -> None: ...


class TransportQuery(Protocol):
    """A query that arrived. Each method ends it; until then its sender waits."""

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
        """Call back whenever subscribers appear or disappear; return True if there are any now."""

    def undeclare(self) -> None: ...


class Transport(Protocol):
    """A session on the network. Failures to send are logged; queries raise MeshError."""

    def id(self) -> str:
        """The session id that other processes see."""

    def peers(self) -> list[str]:
        """Ids of the linked sessions."""

    def links(self) -> int: ...
    def relays(self) -> int: ...
    async def close(self) -> None: ...

    def get(self, key: str, payload: bytes | None, kind: type | None, timeout: float, to: Collector) -> None:
        """Query all servers of `key`; the query ends after at most `timeout` seconds."""

    def queryable(self, key: str, on_query: Callable[[TransportQuery], None]) -> Undeclare: ...
    def publisher(self, key: str, kind: type | None, quality: Quality) -> TransportPublisher: ...
    def put(self, key: str, payload: bytes, kind: type) -> None: ...
    def subscriber(self, key: str, on_sample: OnSample) -> Undeclare:
        """Skip deletes, and publications on keys with a wildcard, as `ring` does too."""

    def ring(self, key: str, depth: int, most: int) -> tuple[Callable[[], tuple[str, bytes] | None], Undeclare]:
        """Keep the latest `depth` publications; the first function returned takes the oldest."""

    def token(self, key: str) -> Undeclare: ...
    def token_subscriber(self, key: str, on_token: Callable[[str, bool], None]) -> Undeclare: ...

    def tokens(self, key: str, timeout: float, to: Collector) -> None:
        """Query the live tokens; each is the key of a reply."""
