"""What a process has declared on the mesh, and how it is taken back."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import msgspec
import zenoh

from zscout import messages
from zscout.mesh.inbox import Backlog
from zscout.messages import Malformed

log = logging.getLogger(__name__)

S = TypeVar("S")


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


class Declared:
    """A declaration that can be taken back."""

    def __init__(self, undeclare: Callable[[], Any], state: Backlog | None = None) -> None:
        self._undeclare: Callable[[], Any] | None = undeclare
        self._state = state or Backlog()

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


class Overheard(Declared, Generic[S]):
    """Publications that wake nobody: the latest are kept, outside Python, until somebody looks."""

    def __init__(
        self, subscriber: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]], kind: type[S], depth: int
    ) -> None:
        super().__init__(subscriber.undeclare)
        self._subscriber, self._kind, self._depth = subscriber, kind, depth

    def take(self) -> list[S]:
        """What came since the last look, oldest first; malformed ones are dropped without a word."""
        return [message for _, message in self.each()]

    def each(self) -> Iterator[tuple[str, S]]:
        """The same one by one, each with its key; what is not asked for is kept for the next look. Ends after
        as many as there is room for: more may come while one looks."""
        for _ in range(self._depth):
            sample = self._subscriber.try_recv()
            if sample is None:
                return
            try:
                message: S = messages.decode(sample.payload.to_bytes(), self._kind, messages.MAX_STATE)
            except Malformed:
                continue
            yield str(sample.key_expr), message


@dataclass(slots=True)
class Shared:
    """A subscription whose publications are read once for all handlers of this process."""

    state: Backlog
    handlers: list[Callable[[str, Any], None]] = field(default_factory=list)
    undeclare: Callable[[], Any] = lambda: None
