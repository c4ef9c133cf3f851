"""One program of a contender: `python -m benchmarks.peers.program NAME ADDRESS PROGRAM LOG`.

A child process (see benchmarks/child.py): it reports its process id, takes orders as JSON lines, and reports times on
the clock that all processes of a host share. Output of the peer's libraries goes to LOG.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.loop import run
from benchmarks.peers.peer import START, Session, load

LIMIT = 60.0
"""Seconds that an order may take beyond its own `seconds`."""
END = 5.0

Say = Callable[[Any], None]


class Program:
    """Carries out the orders of one program."""

    def __init__(self, session: Session, say: Say) -> None:
        self._session, self._say = session, say
        self._hold: Any = None

    async def obey(self, order: dict[str, Any]) -> None:
        do = getattr(self, f"_{order.pop('do')}")
        async with asyncio.timeout(LIMIT + order.get("seconds", 0.0)):
            await do(**order)

    async def _time(self, rcs: list[str], times: int) -> None:
        """Report the seconds of the last of `times` acquisitions; releases are not timed."""
        await self._session.prepare(rcs)
        took = 0.0
        for _ in range(times):
            start = time.perf_counter()
            hold = await self._session.acquire(rcs, None)
            took = time.perf_counter() - start
            await self._session.release(hold)
            await self._session.settle(rcs)
        self._say(took)

    async def _hold_on(self, rcs: list[str]) -> None:
        """Report once it holds `rcs`."""
        await self._session.prepare(rcs)
        self._hold = await self._session.acquire(rcs, None)
        self._say("holds")

    async def _let_go(self) -> None:
        """Give the hold back; report the time before that."""
        start = time.monotonic()
        await self._session.release(self._hold)
        self._say(start)

    async def _wait(self, rcs: list[str], seconds: float) -> None:
        """Report that it waits, then the time at which it got `rcs`, and give them back; null after `seconds`."""
        await self._session.prepare(rcs)
        try:
            async with asyncio.timeout(seconds):
                hold = await self._session.acquire(rcs, lambda: self._say("waits"))
        except TimeoutError:
            self._say(None)
            return
        self._say(time.monotonic())
        await self._session.release(hold)

    async def _crowd(self, sets: list[list[str]], seconds: float, hold: float) -> None:
        """Report the spans in which each behavior held its set, as lists of [from, to], and the end of the time."""
        for rcs in sets:
            await self._session.prepare(rcs)
        until = time.monotonic() + seconds
        held = await asyncio.gather(*(self._behave(rcs, until, hold) for rcs in sets))
        self._say({"held": held, "until": until})

    async def _behave(self, rcs: list[str], until: float, keep: float) -> list[tuple[float, float]]:
        held: list[tuple[float, float]] = []
        while time.monotonic() < until:
            hold = await self._session.acquire(rcs, None)
            start = time.monotonic()
            if keep:
                await asyncio.sleep(keep)
            held.append((start, time.monotonic()))
            await self._session.release(hold)
        return held


async def program(peer: str, address: str, name: str, say: Say) -> None:
    async with asyncio.timeout(START):
        session = await load(peer).connect(address, name)
    does = Program(session, say)
    say(os.getpid())
    while line := await asyncio.to_thread(sys.stdin.readline):
        await does.obey(json.loads(line))
    async with asyncio.timeout(END):
        await session.close()


def main() -> None:
    peer, address, name, log = sys.argv[1:]
    # Libraries may print; only reports may reach the parent process.
    reports = os.fdopen(os.dup(1), "w", buffering=1)
    with Path(log).open("ab") as out:
        os.dup2(out.fileno(), 1)
        os.dup2(out.fileno(), 2)

    def say(what: Any) -> None:
        print(json.dumps(what), file=reports)

    code = 1
    try:
        run(program(peer, address, name, say))
        code = 0
    finally:
        if code:
            traceback.print_exc()
        sys.stderr.flush()
        # Some peers' libraries leave threads that never end.
        os._exit(code)


if __name__ == "__main__":
    main()
