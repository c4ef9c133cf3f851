"""Ray placement groups: a bundle for each RC, which is a custom resource of one node."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import ray
from ray.util import placement_group, remove_placement_group

from benchmarks.peers.peer import HOST, RCS, Peer, Session, Waiting, free_port, package, server

THREADS = 5
SETTLE = 0.005


class RaySession(Session):
    def __init__(self) -> None:
        # Calls block their thread until the server has answered.
        self._threads = ThreadPoolExecutor(THREADS)

    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> Any:
        loop = asyncio.get_running_loop()
        bundles = [{rc: 1.0} for rc in rcs]
        group = await loop.run_in_executor(self._threads, placement_group, bundles, "PACK")
        if waiting is not None:
            waiting()
        await group.ready()
        return group

    async def release(self, hold: Any) -> None:
        await asyncio.get_running_loop().run_in_executor(self._threads, remove_placement_group, hold)

    async def settle(self, rcs: Sequence[str]) -> None:
        # The server learns of a removal from the node's next report; a group requested before that is retried up to a
        # second later. There is no event for it.
        while any(ray.available_resources().get(rc, 0) < 1 for rc in rcs):  # noqa: ASYNC110
            await asyncio.sleep(SETTLE)

    async def close(self) -> None:
        ray.shutdown()


class Ray(Peer):
    name = "Ray placement groups"
    lacks = (
        "no priorities, no preemption, no promised order among waiting groups; the server learns of a release "
        "0.1 s later, and retries waiting groups up to a second after that; a group holds a number at the "
        "server, which no device checks"
    )

    def version(self) -> str:
        return package("ray")

    @asynccontextmanager
    async def serve(self, folder: Path) -> AsyncIterator[str]:
        port = free_port()
        command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block"]
        command += ["--node-ip-address", HOST, "--port", str(port), "--num-cpus", "0"]
        command += ["--resources", json.dumps(dict.fromkeys(RCS, 1)), "--include-dashboard", "false"]
        command += ["--disable-usage-stats", "--object-store-memory", "100000000"]
        command += ["--temp-dir", str(folder / "ray")]
        async with server(command, folder, port=port):
            yield f"{HOST}:{port}"

    async def connect(self, address: str, name: str) -> Session:
        await asyncio.to_thread(
            ray.init, address=address, log_to_driver=False, logging_level="ERROR", namespace="bench"
        )
        return RaySession()


PEERS: dict[str, Peer] = {"ray": Ray()}
