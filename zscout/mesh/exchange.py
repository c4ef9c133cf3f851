"""One question and its answers, as messages."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Generic, TypeVar

import msgspec
import zenoh

from zscout import messages
from zscout.messages import Malformed, Problem
from zscout.scheduling.model import Ns, Term

log = logging.getLogger(__name__)

JSON = zenoh.Encoding.APPLICATION_JSON
R = TypeVar("R")


class Refused(Exception):
    """Raised by a handler to answer a query with an error."""

    def __init__(self, code: str, message: str, term: Term | None = None) -> None:
        super().__init__(message)
        self.problem = Problem(code, message, term)


@dataclass(frozen=True, slots=True)
class Reply(Generic[R]):
    """One answer to a query: a message, or a problem."""

    key: str
    message: R | None
    problem: Problem | None = None


class Request(Generic[R]):
    """A query that arrived: answer it once, now or later. Not answering at all reads as "unknown"."""

    __slots__ = ("_query", "_reply_key", "arrived", "key", "message")

    def __init__(self, query: zenoh.Query, key: str, reply_key: str, message: R, arrived: Ns) -> None:
        self._query: zenoh.Query | None = query
        self._reply_key = reply_key
        self.key = key
        self.message = message
        self.arrived = arrived
        """When it came out of the network, on this host's clock."""

    def answer(self, message: msgspec.Struct) -> None:
        if self._query is not None:
            encoding = encoding_of(type(message))
            try:
                self._query.reply(self._reply_key, messages.encode(message), encoding=encoding)
            except zenoh.ZError as error:
                log.debug("an answer on %s was not sent: %s", self.key, error)
            self._drop()

    def refuse(self, problem: Problem) -> None:
        if self._query is not None:
            reply_problem(self._query, problem)
            self._drop()

    def _drop(self) -> None:
        # A query that is kept after its reply makes the asker wait for its timeout.
        if self._query is not None:
            drop(self._query)
            self._query = None


_ENCODINGS: dict[type, zenoh.Encoding] = {}


def encoding_of(kind: type) -> zenoh.Encoding:
    encoding = _ENCODINGS.get(kind)
    if encoding is None:
        encoding = _ENCODINGS[kind] = JSON.with_schema(messages.schema(kind))
    return encoding


def read_reply(reply: zenoh.Reply, kind: type[R], limit: int) -> Reply[R] | None:
    sample = reply.ok
    try:
        if sample is not None:
            return Reply(str(sample.key_expr), messages.decode(sample.payload.to_bytes(), kind, limit))
        raw = reply.err.payload.to_bytes() if reply.err is not None else b""
        if raw == b"Timeout":
            return None
        problem: Problem = messages.decode(raw, Problem)
        return Reply("", None, problem)
    except Malformed as error:
        log.warning("an answer was not understood: %s", error)
        return None


def reply_problem(query: zenoh.Query, problem: Problem) -> None:
    try:
        query.reply_err(messages.encode(problem), encoding=encoding_of(Problem))
    except zenoh.ZError as error:
        log.debug("an error answer was not sent: %s", error)


def drop(query: zenoh.Query) -> None:
    query.drop()  # type: ignore[no-untyped-call]
