"""Many hosts that report their load once a second, each on its own key, over a few sessions.

`python -m studies.host_reports FLEET_FILE HOSTS` is a child process (see child.py). On `start` it reports at an even
pace; on `stop` it prints the number of sent reports.
"""

from __future__ import annotations

import asyncio
import json
import random
import sys
from contextlib import AsyncExitStack
from pathlib import Path

from benchmarks.child import ready
from benchmarks.loop import run
from zscout.config.fleet import load_fleet
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.mesh import ZenohMesh
from zscout.mesh.exchange import Publisher
from zscout.messages import ComponentUse, LoadReport

SESSIONS = 4
STEP = 0.01
"""Seconds between two batches of reports."""
MOST = 500
"""Largest batch of reports."""
COMPONENTS = 4
"""Number on each host."""
KINDS = ("camera", "servo", "watcher", "planner")
GIGABYTE = 1_000_000_000


class Host:
    """A host with a random walk as load."""

    def __init__(self, name: str, publisher: Publisher, rng: random.Random) -> None:
        self._name, self._publisher, self._rng = name, publisher, rng
        self._number = 0
        self._load = rng.uniform(0, 4)
        self._uses = tuple(
            ComponentUse(f"{name}-{kind}", kind, 1_001, rng.uniform(0, 0.5), 64_000_000, 3, 0.98)
            for kind in KINDS[:COMPONENTS]
        )

    def report(self) -> None:
        self._number += 1
        self._load = min(8.0, max(0.0, self._load + self._rng.uniform(-0.1, 0.1)))
        self._publisher.put(
            LoadReport(
                host=self._name,
                number=self._number,
                cores=4,
                load_average=(self._load, self._load, self._load),
                cpu=min(100.0, self._load * 25),
                memory_available=round(self._rng.uniform(1, 7) * GIGABYTE),
                memory_total=8 * GIGABYTE,
                speed=1.0,
                clock=2_400.0,
                clock_rated=3_200.0,
                labels=("camera",),
                components=self._uses,
            )
        )


async def reports(hosts: list[Host], stop: asyncio.Event) -> int:
    """Report for each host once a second, evenly spaced, until `stop`. Return the number of reports. Late ones are
    caught up, at most MOST at once, so that a machine that is too slow sends fewer."""
    loop = asyncio.get_running_loop()
    start, sent = loop.time(), 0
    while not stop.is_set():
        for _ in range(min(MOST, round((loop.time() - start) * len(hosts)) - sent)):
            hosts[sent % len(hosts)].report()
            sent += 1
        await asyncio.sleep(STEP)
    return sent


async def main(fleet_file: Path, count: int) -> None:
    fleet, rng = load_fleet(fleet_file), random.Random(count)  # noqa: S311
    async with AsyncExitStack() as stack:
        meshes = [
            await stack.enter_async_context(await ZenohMesh.open(fleet, Sender("crowd", f"s{number}")))
            for number in range(SESSIONS)
        ]
        hosts = []
        for number in range(count):
            mesh, name = meshes[number % SESSIONS], f"host{number}"
            hosts.append(Host(name, mesh.publisher(mesh.keys.load(name), LoadReport, data=True), rng))
            mesh.alive(Token(name, Role.LOAD, "node", new_instance()))
        ready()
        stop = asyncio.Event()
        task: asyncio.Task[int] | None = None
        while line := await asyncio.to_thread(sys.stdin.readline):
            if json.loads(line)["do"] == "start":
                task = asyncio.create_task(reports(hosts, stop))
                ready()
            elif task is not None:
                stop.set()
                print(json.dumps(await task), flush=True)


if __name__ == "__main__":
    run(main(Path(sys.argv[1]), int(sys.argv[2])))
