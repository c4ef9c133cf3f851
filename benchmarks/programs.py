"""Two programs in a fleet of their own, in one process: `python -P programs.py FOLDER STRATEGY`, which takes the names
of measurements as JSON lines and prints seconds. It uses only what every commit of zscout has, so that PYTHONPATH can
choose the `zscout` and `tests` of an earlier commit."""

from __future__ import annotations

import asyncio
import inspect
import json
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import uvloop

from tests.live.lab import Lab
from zscout.behaviors.client.arc import hold

EXCLUSIVE = [f"robot/r{number}" for number in range(10)]
SHARABLE = ["radio/rf0", "video/ch1"]
HOT = 3
"""Consecutive runs of each measurement, of which the last counts: an idle processor and cold caches cost more than the
measured work, most of all with many processes."""
HOLD = 60.0
NEEDS: dict[str, dict[str, dict[str, Any]]] = {
    "1 RC": {EXCLUSIVE[0]: {}},
    "5 RCs": {name: {} for name in EXCLUSIVE[:5]},
    "2 votes": {name: {"rate": 4} for name in SHARABLE},
}


def start(lab: Lab) -> None:
    """Start the RCM on one node, the RCs on two others."""
    lab.node("lead")
    lab.node("left", *EXCLUSIVE[0::2], f"{SHARABLE[0]}:rate=10")
    lab.node("right", *EXCLUSIVE[1::2], f"{SHARABLE[1]}:rate=10")


async def running(client: Any, arc: Any) -> None:
    """Wait for the grant, without confirmations."""
    while arc.state != "running":
        assert arc.open, f"{arc.name} ended: {arc.reason}"
        await client.changed(arc)


class Programs:
    def __init__(self, client: Any, second: Any) -> None:
        self.client, self.second = client, second
        # Older versions entered a body only after the confirmations, and don't have the argument.
        waits = "confirmed" in inspect.signature(client.granted).parameters
        self._confirmed: dict[str, Any] = {"confirmed": True} if waits else {}

    async def grant(self, needs: Any) -> float:
        began = time.perf_counter()
        arc = await self.client.request("bench", needs, min_runtime=HOLD)
        await running(self.client, arc)
        took = time.perf_counter() - began
        await self.client.end(arc)
        return took

    async def body(self, needs: Any) -> float:
        return await self._entered(hold(self.client, "bench", needs, min_runtime=HOLD))

    async def confirmed(self, needs: Any) -> float:
        return await self._entered(hold(self.client, "bench", needs, min_runtime=HOLD, **self._confirmed))

    @staticmethod
    async def _entered(attempt: Any) -> float:
        began = entered = time.perf_counter()
        async with attempt as held:
            entered = time.perf_counter()
            if hasattr(held, "confirmed"):
                # Confirmations of this hold must not overlap the next request.
                await held.confirmed()
        return entered - began

    async def release(self, needs: Any) -> float:
        """Measure the time from a release to the next grant."""
        holder = await self.client.request("holder", needs, min_runtime=HOLD)
        await running(self.client, holder)
        waiter = await self.second.request("waiter", needs, min_runtime=HOLD)
        assert waiter.state == "queued"
        began = time.perf_counter()
        released = asyncio.create_task(self.client.end(holder))
        await running(self.second, waiter)
        took = time.perf_counter() - began
        await released
        await self.second.end(waiter)
        return took


async def serve(folder: Path, strategy: Any) -> None:
    async with Lab(folder, candidates=["lead"], strategy=strategy) as lab:
        start(lab)
        programs = Programs(await lab.client("bench"), await lab.client("second"))
        await lab.ready(programs.client, *EXCLUSIVE, *SHARABLE)
        measured: dict[str, Callable[[Any], Awaitable[float]]] = {
            "grant": programs.grant,
            "body entered": programs.body,
            "body confirmed": programs.confirmed,
            "release to next grant": programs.release,
        }
        print(json.dumps("ready"), flush=True)
        while line := await asyncio.to_thread(sys.stdin.readline):
            what, needs = json.loads(line)
            for _ in range(HOT):
                took = await measured[what](NEEDS[needs])
            print(json.dumps(took), flush=True)


if __name__ == "__main__":
    uvloop.run(serve(Path(sys.argv[1]), sys.argv[2]))
