"""The bare cost: a plain Zenoh query, without zscout.

`python -m benchmarks.bare ADDRESS KEY --bytes N` is the other end, a child process (see child.py): a queryable whose
direct callback sends N bytes. `--answer TEXT` sends TEXT instead; if TEXT begins with an id, the query's id replaces
it, as clients take no other answer.
"""

from __future__ import annotations

import argparse
import queue
import sys
import time

import zenoh
from zenoh.handlers import Callback

from benchmarks.child import ready
from benchmarks.programs import HOT
from benchmarks.stats import Samples

KEY = "bench/bare"
START = 20.0
WARM_UP = 200
ID, ID_LENGTH = b'"id":"', 12


def settings(address: str) -> zenoh.Config:
    """Return the configuration of a peer that finds others by multicast at `address`, on loopback."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/address", f'"{address}"')
    config.insert_json5("scouting/multicast/interface", '"lo"')
    config.insert_json5("transport/shared_memory/enabled", "false")
    return config


class BareQuery:
    """A bare query, made in the faster of two ways."""

    def __init__(self, payload: bytes) -> None:
        self._payload = payload
        self.once, self.way = self._blocking, ""

    def hot(self) -> float:
        """Return the seconds of the last of HOT consecutive queries."""
        return [self.once() for _ in range(HOT)][-1]

    def choose(self, session: zenoh.Session) -> None:
        """Wait for the other end, try both ways, and use the faster from then on."""
        self._session = session
        deadline = time.monotonic() + START
        while not self._answered():
            if time.monotonic() > deadline:
                raise TimeoutError("the bare queryable was not found")
        ways = {"blocking handler": self._blocking, "callback and queue": self._callback}
        tried = {name: Samples() for name in ways}
        for _ in range(WARM_UP):
            for name, way in ways.items():
                tried[name].add(way())
        self.way = min(ways, key=lambda name: tried[name].median)
        self.once = ways[self.way]

    def _answered(self) -> bool:
        return any(reply.ok is not None for reply in self._session.get(KEY, payload=self._payload, timeout=1.0))

    def _blocking(self) -> float:
        start = time.perf_counter()
        reply = self._session.get(KEY, payload=self._payload, express=True).recv()
        took = time.perf_counter() - start
        assert reply.ok is not None, "the bare query failed"
        return took

    def _callback(self) -> float:
        arrived: queue.SimpleQueue[zenoh.Reply] = queue.SimpleQueue()
        handler = Callback(arrived.put, _nothing, indirect=False)
        start = time.perf_counter()
        self._session.get(KEY, handler, payload=self._payload, express=True)
        reply = arrived.get(timeout=START)
        took = time.perf_counter() - start
        assert reply.ok is not None, "the bare query failed"
        return took


def _nothing() -> None:
    pass


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("address")
    parser.add_argument("key")
    parser.add_argument("--bytes", type=int, default=0)
    parser.add_argument("--answer")
    args = parser.parse_args()
    reply = args.answer.encode() if args.answer is not None else b"x" * args.bytes
    concrete = "*" not in args.key
    head, tail = reply[: len(ID) + 1], reply[len(ID) + 1 + ID_LENGTH :]

    def answer(query: zenoh.Query) -> None:
        said = reply
        if head.endswith(ID) and query.payload is not None:
            asked = query.payload.to_bytes()
            at = asked.find(ID) + len(ID)
            said = head + asked[at : at + ID_LENGTH] + tail
        query.reply(args.key if concrete else query.key_expr, said, express=True)
        query.drop()  # type: ignore[no-untyped-call]

    with zenoh.open(settings(args.address)) as session:
        session.declare_queryable(args.key, Callback(answer, _nothing, indirect=False), complete=False)
        ready()
        sys.stdin.read()


if __name__ == "__main__":
    main()
