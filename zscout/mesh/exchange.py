"""Queries with their replies, publishers, and other declarations of a process on the mesh."""

from __future__ import annotations

import re
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Final, Generic, TypeVar

import msgspec
from msgspec import structs

from zscout import messages
from zscout.mesh.transport import TransportPublisher, TransportQuery, Undeclare
from zscout.messages import Malformed, Problem, version_words
from zscout.messages import Refused as Refused
from zscout.types import VERSION, Ns

QUEUE_DEPTH = 1_024  # items of one declaration that may wait for the event loop
MAX_CODES: Final = 32  # refusal codes a tally counts separately: drivers and other hosts choose some of them
OTHER: Final = "other"
CODE: Final = re.compile("[a-z_]{1,32}")
NOT_UNDERSTOOD: Final = frozenset({"malformed", "bad_name", "bad_request"})
"""Codes that a version difference may explain."""

R = TypeVar("R")
S = TypeVar("S")


SPAWN: Final = 'start it with "spawn": multiprocessing.get_context("spawn")'


class MeshError(Exception):
    """The mesh can't be joined, or is closed; the message names the remedy."""


@dataclass(frozen=True, slots=True)
class Reply(Generic[R]):
    key: str
    message: R | None
    problem: Problem | None = None
    arrived: Ns = 0


def naming_versions(reply: Reply[R] | None, server: str) -> Reply[R] | None:
    """Add both versions to a refusal that a version difference may explain; return other replies unchanged."""
    problem = reply.problem if reply is not None else None
    if reply is None or problem is None or problem.code not in NOT_UNDERSTOOD or problem.version == VERSION:
        return reply
    versions = f"{server} is {version_words(problem.version)}, this is {VERSION}"
    words = f"{problem.message} ({versions}: upgrade the older one if it does not know this)"
    return replace(reply, problem=structs.replace(problem, message=words))


def refuse(query: TransportQuery, problem: Problem) -> None:
    problem = structs.replace(problem, version=VERSION) if problem.code in NOT_UNDERSTOOD else problem
    query.reply_error(messages.encode(problem), Problem)


@dataclass(slots=True, eq=False)
class Tally:
    """How queries of one purpose ended. Answers are counted in the event loop, refusals on any thread."""

    answered: int = 0
    _refused: dict[str, int] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def refused(self) -> dict[str, int]:
        with self._lock:
            return dict(self._refused)

    def refuse(self, code: str) -> None:
        with self._lock:
            known = code in self._refused or (CODE.fullmatch(code) and len(self._refused) < MAX_CODES)
            code = code if known else OTHER
            self._refused[code] = self._refused.get(code, 0) + 1


@dataclass(slots=True, eq=False)
class Answered:
    """The answer to one command, shared by its repetitions."""

    answer: msgspec.Struct | None = None
    waiting: list[IncomingQuery[Any]] = field(default_factory=list)

    def join(self, query: IncomingQuery[Any]) -> None:
        """Give `query` the same answer, now or once there is one."""
        if self.answer is None:
            self.waiting.append(query)
        else:
            query.end(self.answer)

    def settle(self, answer: msgspec.Struct) -> None:
        self.answer = answer
        while self.waiting:
            self.waiting.pop().end(answer)


@dataclass(slots=True, eq=False)
class IncomingQuery(Generic[R]):
    """A query that arrived: answer it once, now or later. Unanswered, its outcome is unknown to the sender."""

    _query: TransportQuery | None
    key: str
    _reply_key: str
    message: R
    arrived: Ns  # time of arrival by `Mesh.now`, before any wait in the inbox
    outcome: Answered | None = None
    tally: Tally | None = None
    over: Callable[[], None] | None = None
    """Called when the query is answered or dropped."""

    def answer(self, message: msgspec.Struct, encoded: bytes | None = None) -> None:
        """Answer with `message`; `encoded` is its encoding, if the caller has it."""
        self.end(message, encoded)

    def refuse(self, problem: Problem) -> None:
        self.end(problem)

    def drop(self) -> None:
        """End the query without an answer, so that its sender need not wait for the whole timeout."""
        if (query := self._taken()) is not None:
            query.drop()

    def end(self, answer: msgspec.Struct, encoded: bytes | None = None) -> None:
        if (query := self._taken()) is None:
            return
        if isinstance(answer, Problem):
            refuse(query, answer)
        else:
            query.reply(self._reply_key, encoded or messages.encode(answer), type(answer))
        if self.outcome is not None:
            self.outcome.settle(answer)
        if self.tally is not None:
            if isinstance(answer, Problem):
                self.tally.refuse(answer.code)
            else:
                self.tally.answered += 1

    def _taken(self) -> TransportQuery | None:
        """Return the query at the first call, None later."""
        query, self._query = self._query, None
        if query is not None and self.over is not None:
            self.over()
        return query


class Publisher:
    def __init__(self, publisher: TransportPublisher) -> None:
        self._publisher = publisher
        self.close = publisher.undeclare

    def put(self, message: msgspec.Struct) -> None:
        self._publisher.put(messages.encode(message))


@dataclass(slots=True)
class Backlog:
    pending: int = 0
    missed: int = 0
    closed: bool = False  # waiting items are dropped; subscriptions that share a backlog do not check this
    depth: int = QUEUE_DEPTH


class HostShares:
    """Counts queries: at most `share` of each host, so that no host takes all the room, and `most` of all hosts
    together. Used on any thread."""

    def __init__(self, share: int, most: int | None = None) -> None:
        self._share, self._most, self._lock, self._counts = share, most, threading.Lock(), Counter[str]()

    def enter(self, host: str) -> bool:
        """Return False if there is no room. `host` is empty if the key names none: then only `most` applies."""
        with self._lock:
            if host and self._counts[host] >= self._share:
                return False
            if self._most is not None and self._counts.total() >= self._most:
                return False
            self._counts[host] += 1
            return True

    def leave(self, host: str) -> None:
        with self._lock:
            self._counts[host] -= 1
            if not self._counts[host]:
                del self._counts[host]


class LatestByKey:
    """Waiting publications by key, at most `most` of each (None: any number): beyond that a new publication replaces
    the last one, so that no publisher takes all the time. Used on any thread."""

    def __init__(self, most: int | None) -> None:
        self._most, self._lock, self._kept = most, threading.Lock(), dict[str, deque[bytes]]()

    def put(self, key: str, payload: bytes) -> bool:
        """Return False if `payload` replaced a waiting publication."""
        with self._lock:
            kept = self._kept.setdefault(key, deque())
            if self._most is not None and len(kept) >= self._most:
                kept[-1] = payload
                return False
            kept.append(payload)
            return True

    def take(self, key: str) -> bytes:
        return self._pop(key, 0)

    def withdraw(self, key: str) -> None:
        """Remove the last publication."""
        self._pop(key, -1)

    def _pop(self, key: str, at: int) -> bytes:
        with self._lock:
            kept = self._kept[key]
            payload = kept[at]
            del kept[at]
            if not kept:
                del self._kept[key]
            return payload


class Declaration:
    def __init__(self, undeclare: Undeclare, state: Backlog | None = None) -> None:
        self._undeclare: Undeclare | None = undeclare
        self._state = state or Backlog()

    @property
    def missed(self) -> int:
        """Publications dropped because the queue was full."""
        return self._state.missed

    def close(self) -> None:
        undeclare, self._undeclare = self._undeclare, None
        if undeclare is not None:
            self._state.closed = True
            undeclare()


class PolledSubscription(Declaration, Generic[S]):
    """The latest publications on a key, kept outside the event loop until the caller takes them."""

    def __init__(
        self, take: Callable[[], tuple[str, bytes] | None], undeclare: Undeclare, kind: type[S], depth: int
    ) -> None:
        super().__init__(undeclare)
        self._take, self._kind, self._depth = take, kind, depth

    def each(self) -> Iterator[tuple[str, S]]:
        """Yield the publications since the last call as (key, message), oldest first. Malformed ones are
        skipped, unread ones are kept. Ends after `depth` items, as more may arrive meanwhile."""
        for _ in range(self._depth):
            sample = self._take()
            if sample is None:
                return
            key, payload = sample
            try:
                message: S = messages.decode_received(payload, self._kind)
            except Malformed:
                continue
            yield key, message
