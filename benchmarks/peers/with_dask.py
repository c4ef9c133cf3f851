"""Dask's `MultiLock`: names at the scheduler, a queue for each name."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import distributed

from benchmarks.peers.peer import HOST, START, Peer, Session, Waiting, free_port, package, server


class DaskSession(Session):
    def __init__(self, client: Any) -> None:
        self._client = client

    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> Any:
        lock = distributed.MultiLock(list(rcs), client=self._client)
        acquired = lock.acquire()
        if waiting is not None:
            acquired = self._report_waiting(acquired, lock.id, waiting)
        await acquired
        return lock

    async def _report_waiting(self, acquired: Any, name: str, waiting: Waiting) -> None:
        """Call `waiting` once the scheduler, which is polled, knows the request `name`: Dask does not notify of waiting
        requests."""

        def known(dask_scheduler: Any) -> bool:
            return name in dask_scheduler.extensions["multi_locks"].requests

        running = asyncio.ensure_future(acquired)
        while not await self._client.run_on_scheduler(known):
            assert not running.done(), "the lock was free"
        waiting()
        await running

    async def release(self, hold: Any) -> None:
        await hold.release()

    async def close(self) -> None:
        await self._client.close()


class Dask(Peer):
    name = "Dask MultiLock"
    lacks = "no priorities, no preemption; a killed holder's locks stay locked until the scheduler ends"

    def version(self) -> str:
        return package("distributed")

    @asynccontextmanager
    async def serve(self, folder: Path) -> AsyncIterator[str]:
        port = free_port()
        command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
        async with server([*command, "--host", HOST, "--port", str(port)], folder, port=port):
            yield f"tcp://{HOST}:{port}"

    async def connect(self, address: str, name: str) -> Session:
        return DaskSession(await distributed.Client(address, asynchronous=True, timeout=START))


PEERS: dict[str, Peer] = {"dask": Dask()}
