"""What a process has declared on the mesh, and how it is undeclared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import msgspec

from zscout import messages
from zscout.mesh.inbox import Backlog
from zscout.mesh.transport import TransportPublisher, Undeclare
from zscout.messages import Malformed

S = TypeVar("S")


class Publisher:
    """Publishes messages of one kind on one key."""

    def __init__(self, publisher: TransportPublisher) -> None:
        self._publisher = publisher

    def put(self, message: msgspec.Struct) -> None:
        self._publisher.put(messages.encode(message))

    def close(self) -> None:
        self._publisher.undeclare()


class Declaration:
    """A declaration that can be undeclared."""

    def __init__(self, undeclare: Undeclare, state: Backlog | None = None) -> None:
        self._undeclare: Undeclare | None = undeclare
        self._state = state or Backlog()

    @property
    def missed(self) -> int:
        """Publications that were dropped because the queue was full."""
        return self._state.missed

    def close(self) -> None:
        if self._undeclare is not None:
            undeclare: Undeclare = self._undeclare
            self._undeclare = None
            undeclare()


class Overheard(Declaration, Generic[S]):
    """The latest publications on a key, kept outside the event loop until they are taken."""

    def __init__(
        self,
        take: Callable[[], tuple[str, bytes] | None],
        undeclare: Undeclare,
        kind: type[S],
        depth: int,
    ) -> None:
        super().__init__(undeclare)
        self._take, self._kind, self._depth = take, kind, depth

    def take(self) -> list[S]:
        """What was published since the last call, oldest first; malformed messages are dropped silently."""
        return [message for _, message in self.each()]

    def each(self) -> Iterator[tuple[str, S]]:
        """The same one by one, each with its key; what is not consumed is kept for the next call. Ends after
        as many as there is room for: more may arrive meanwhile."""
        for _ in range(self._depth):
            sample = self._take()
            if sample is None:
                return
            key, payload = sample
            try:
                message: S = messages.decode(payload, self._kind, messages.MAX_STATE)
            except Malformed:
                continue
            yield key, message


@dataclass(slots=True)
class Shared:
    """A subscription whose publications are decoded once for all handlers of this process."""

    state: Backlog
    handlers: list[Callable[[str, Any], None]] = field(default_factory=list)
    undeclare: Undeclare = lambda: None
