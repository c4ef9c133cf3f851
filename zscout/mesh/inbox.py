"""From Zenoh's threads into the event loop: bounded, in order, one wake-up for a burst."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from zscout.mesh.exchange import Refused

log = logging.getLogger(__name__)

INBOX_DEPTH = 20_000
"""Items of all kinds that may wait for the event loop."""
QUEUE_DEPTH = 1_024
"""Items of one declaration that may wait for the event loop."""
BURST = 256
"""Items that are handled in one go at most, those included that arrive meanwhile."""


@dataclass(slots=True)
class Backlog:
    """Bookkeeping of one declaration: how many of its items wait, and whether any was dropped."""

    pending: int = 0
    missed: int = 0
    closed: bool = False
    depth: int = QUEUE_DEPTH


_Item: TypeAlias = tuple[Backlog | None, Callable[..., None], tuple[Any, ...]]


@dataclass(slots=True)
class Inbox:
    """From Zenoh's threads into the event loop, waking it once for whatever has gathered."""

    loop: asyncio.AbstractEventLoop
    items: deque[_Item] = field(default_factory=deque)
    scheduled: bool = False
    closed: bool = False
    draining: bool = False
    after: list[Callable[[], None]] = field(default_factory=list)
    """What is called once the present burst has been handled."""

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
        self.draining = True
        try:
            for _ in range(BURST):
                if not self.items or self.closed:
                    break
                state, call, args = self.items.popleft()
                if state is not None:
                    state.pending -= 1
                guarded(call, *args)
            self.draining = False
            after, self.after = self.after, []
            for then in after:
                guarded(then)
        finally:
            self.draining = False
            # In this order: who offers something now either sees that nobody is coming, or is seen.
            self.scheduled = False
            if self.items and not self.closed:
                self.scheduled = True
                self.loop.call_soon(self.drain)


def guarded(call: Callable[..., None], *args: Any) -> None:
    try:
        call(*args)
    except Refused:  # by a supervised handler: it is logged there
        pass
    except Exception:
        log.exception("a handler failed")
