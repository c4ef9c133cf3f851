"""A link of the mesh in memory: one direction between two sessions.

It behaves like TCP: messages arrive in order, and wait while the link is cut or a process at either end is frozen.
Messages of chosen kinds may also be lost, late, repeated, or answered with an old answer (`Disturbance`)."""

from __future__ import annotations

import asyncio
import itertools
import random
from collections.abc import Callable, Mapping
from contextvars import Context
from dataclasses import dataclass
from functools import lru_cache
from heapq import heappop, heappush
from typing import Any, Final, Protocol, TypeAlias

import msgspec

from zscout.testing.virtual_time import VirtualTimeLoop

Trace: TypeAlias = Callable[[str, str, str, tuple[Any, ...]], None]
"""Called for each message that arrives: names of the sending and receiving process, name of the handler, arguments."""
_NETWORK: Final = Context()
"""Context of the network's timers: they belong to no process, and run by virtual time."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Probabilities that a message is lost, arrives twice, or up to `by` seconds late, so that others overtake it;
    `old`: that an answer repeats the previous one on its key."""

    lost: float = 0.0
    twice: float = 0.0
    late: float = 0.0
    by: float = 0.0
    old: float = 0.0


class End(Protocol):
    """A session at one end of a link."""

    loop: VirtualTimeLoop
    frozen: bool
    gone: bool
    after: tuple[str, Callable[[Any], None]] | None
    """A kind of message or operation, and a callback: called once with the receiving session, after such a message or
    an answer to it was sent."""

    def call(self, f: Callable[..., None], *args: Any) -> None:
        """Call `f` as code of its process."""

    def disconnected(self, peer: Any) -> None:
        """Handle the loss of the link to `peer`."""


class MemoryLink:
    """One direction between two processes. A message takes `delay` s and up to `jitter` more; `loss` is a
    probability."""

    def __init__(self, source: End, target: End, delay: float, chances: random.Random, trace: Trace | None) -> None:
        self.loop = source.loop
        self.source, self.target = source, target
        self.delay, self.jitter, self.loss = delay, 0.0, 0.0
        self.cut = False
        self.lost = False
        """True after it was blocked for longer than the lease, until it is connected again."""
        self.disturbed: Mapping[str, Disturbance] = {}
        """By kind of message (`kind_of`)."""
        self.hidden: set[object] = set()
        """Declarations of the source that the target does not know."""
        self.answers: dict[str, bytes] = {}
        """Last answer on each key, while answers are disturbed."""
        self.expiry: asyncio.TimerHandle | None = None
        self.relinking: asyncio.TimerHandle | None = None
        self.queue: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._last = 0.0
        """Arrival time of the last message in order: later ones arrive no sooner."""
        self._numbers = itertools.count()
        self._random, self.trace = chances, trace
        self._timer: asyncio.TimerHandle | None = None

    @property
    def blocked(self) -> bool:
        return self.cut or self.source.frozen or self.target.frozen

    def call_in(self, seconds: float, call: Callable[..., None], *args: Any) -> asyncio.TimerHandle:
        return self.loop.call_at(self.loop.now + seconds, call, *args, context=_NETWORK)

    def chance(self, probability: float) -> bool:
        return probability > 0 and self._random.random() < probability

    def send(self, call: Callable[..., None], *args: Any, last: bool = False, late: float | None = None) -> None:
        """Deliver `call(*args)` at the target. `late`: additional seconds, in which others may overtake it. `last`:
        send it even over a lost link."""
        if self.loop.is_closed():  # garbage collection undeclares tokens even then
            return
        if self.source is self.target:
            call(*args)
        elif last or not (self.lost or self.source.gone):
            due = self.loop.now + self.delay + (self._random.random() * self.jitter if self.jitter else 0.0)
            if late is None:
                due = self._last = max(due, self._last)
            else:
                due += late
            heappush(self.queue, (due, next(self._numbers), call, args))
            self.pump()

    def send_message(self, kind: str, call: Callable[..., None], *args: Any, operation: str = "") -> bool:
        """Send a message that may be disturbed. Return False if it was lost."""
        after = self.source.after
        if after is not None and after[0] in (kind, operation) and self.source is not self.target:
            self.source.after = None
            self.loop.call_soon(after[1], self.target, context=_NETWORK)
        if self.chance(self.loss):
            return False
        fate = self.disturbed.get(kind)
        if fate is None:
            self.send(call, *args)
            return True
        if self.chance(fate.lost):
            return False
        for _ in range(2 if self.chance(fate.twice) else 1):
            self.send(call, *args, late=self._random.random() * fate.by if self.chance(fate.late) else None)
        return True

    def lose_unsent(self, sent: int | None = None) -> None:
        """Keep `sent` messages under way (None: a random number) and the notice that the source is gone."""
        if self.queue:
            queue = sorted(self.queue)
            sent = self._random.randint(0, len(queue)) if sent is None else sent
            self.queue = queue[:sent] + [entry for entry in queue[sent:] if entry[2] == self.target.disconnected]

    def pump(self) -> None:
        """Deliver due messages, and schedule itself for the next."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        while self.queue and not self.blocked:
            due = self.queue[0][0]
            if due > self.loop.now:
                self._timer = self.call_in(due - self.loop.now, self.pump)
                return
            _, _, call, args = heappop(self.queue)
            if not self.target.gone:
                if self.trace is not None:
                    self.trace(str(self.source), str(self.target), call.__name__, args)
                self.target.call(call, *args)


@lru_cache(1 << 14)
def kind_of(key: str) -> str:
    """The kind of a message on `key`: `grants`, `schedule`, `vote`, `command`, `rc/state` and so on."""
    parts = key.split("/")[2:]
    if not parts:
        return key
    at = {"rc": 3, "host": 2, "client": 3}.get(parts[0], 1)
    name = parts[at] if len(parts) > at else parts[-1]
    return f"{parts[0]}/{name}" if name == "state" else name


class _Operation(msgspec.Struct):
    op: str = ""


_decoder: Final = msgspec.json.Decoder(_Operation)


def operation_of(payload: bytes | None) -> str:
    """The operation of a query, such as `hand_over`; "" if it has none."""
    try:
        return _decoder.decode(payload or b"{}").op
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return ""
