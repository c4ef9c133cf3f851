"""One query and its replies, as messages."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Generic, TypeVar

import msgspec

from zscout import messages
from zscout.mesh.transport import TransportQuery
from zscout.messages import Malformed, Problem
from zscout.types import Ns, Term

log = logging.getLogger(__name__)

R = TypeVar("R")


class Refused(Exception):
    """Raised by a handler to answer a query with an error."""

    def __init__(self, code: str, message: str, term: Term | None = None) -> None:
        super().__init__(message)
        self.problem = Problem(code, message, term)


@dataclass(frozen=True, slots=True)
class Reply(Generic[R]):
    """One reply to a query: a message, or a problem."""

    key: str
    message: R | None
    problem: Problem | None = None


class IncomingQuery(Generic[R]):
    """A query that arrived: answer it once, now or later. No answer at all reads as "unknown"."""

    __slots__ = ("_query", "_reply_key", "arrived", "key", "message")

    def __init__(self, query: TransportQuery, key: str, reply_key: str, message: R, arrived: Ns) -> None:
        self._query: TransportQuery | None = query
        self._reply_key = reply_key
        self.key = key
        self.message = message
        self.arrived = arrived
        """When it came out of the network, by `Mesh.now`."""

    def answer(self, message: msgspec.Struct) -> None:
        query, self._query = self._query, None
        if query is not None:
            query.reply(self._reply_key, messages.encode(message), type(message))

    def refuse(self, problem: Problem) -> None:
        query, self._query = self._query, None
        if query is not None:
            refuse(query, problem)


def refuse(query: TransportQuery, problem: Problem) -> None:
    query.reply_error(messages.encode(problem), Problem)


def read_reply(key: str, payload: bytes, ok: bool, kind: type[R], limit: int) -> Reply[R] | None:
    try:
        if ok:
            return Reply(key, messages.decode(payload, kind, limit))
        if payload == b"Timeout":
            return None
        problem: Problem = messages.decode(payload, Problem)
        return Reply("", None, problem)
    except Malformed as error:
        log.warning("a reply was malformed: %s", error)
        return None
