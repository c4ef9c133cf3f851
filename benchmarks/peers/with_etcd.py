"""etcd: one transaction puts all keys under the session's lease or none; waiters watch for deletions."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from etcd3aio import Etcd3Client
from etcd3aio.kv import KVService, prefix_range_end
from etcd3aio.watch import WatchFilter

from benchmarks.peers.peer import (
    HOST,
    LEASE,
    START,
    Peer,
    Session,
    Waiters,
    Waiting,
    free_port,
    package,
    program_version,
    server,
)

PREFIX = "robot/"


@dataclass(frozen=True, slots=True)
class Held:
    token: str
    keys: list[str]


class EtcdSession(Session):
    def __init__(self, client: Any, lease: int, stack: AsyncExitStack) -> None:
        self._client, self._lease, self._stack = client, lease, stack
        self._waiters = Waiters()
        self._watching = asyncio.Event()
        self._task = asyncio.create_task(self._watch())
        self._task.add_done_callback(self._waiters.deaf)

    async def ready(self) -> None:
        async with asyncio.timeout(START):
            await self._watching.wait()

    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> Held:
        held = Held(uuid.uuid4().hex, list(rcs))
        free = [KVService.txn_compare_create_revision(rc, 0) for rc in rcs]
        take = [KVService.txn_op_put(rc, held.token, lease=self._lease) for rc in rcs]
        with self._waiters.waiter(rcs) as freed:
            while not (await self._client.kv.txn(free, take)).succeeded:
                if waiting is not None:
                    waiting()
                    waiting = None
                await self._waiters.wait(freed)
        return held

    async def release(self, hold: Held) -> None:
        mine = [KVService.txn_compare_value(key, hold.token) for key in hold.keys]
        await self._client.kv.txn(mine, [KVService.txn_op_delete(key) for key in hold.keys])

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self._stack.aclose()

    async def _watch(self) -> None:
        end = prefix_range_end(PREFIX)
        async for response in self._client.watch.watch(PREFIX, end, filters=[WatchFilter.NOPUT]):
            self._watching.set()
            self._waiters.freed(event.kv.key.decode() for event in response.events)


class Etcd(Peer):
    name = "etcd, transactions"
    lacks = (
        "no queue (whoever tries first after a release wins), no priorities, no preemption; a killed holder "
        "counts until its lease ends; one member here, which writes every change to disk"
    )

    def version(self) -> str:
        said = program_version("etcd", "--version", mend="apt-get install etcd-server")
        return f"etcd {said.split(':')[-1].strip()}, {package('etcd3aio')}"

    @asynccontextmanager
    async def serve(self, folder: Path) -> AsyncIterator[str]:
        port, other = free_port(), free_port()
        clients, members = f"http://{HOST}:{port}", f"http://{HOST}:{other}"
        command = ["etcd", "--data-dir", str(folder / "data"), "--listen-client-urls", clients]
        command += ["--advertise-client-urls", clients, "--listen-peer-urls", members]
        command += ["--initial-advertise-peer-urls", members, "--initial-cluster", f"default={members}"]
        async with server(command, folder, port=port):
            yield f"{HOST}:{port}"

    async def connect(self, address: str, name: str) -> Session:
        stack = AsyncExitStack()
        client = await stack.enter_async_context(Etcd3Client([address]))
        lease = (await client.lease.grant(LEASE, timeout=START)).ID
        await stack.enter_async_context(client.lease.keep_alive_context(lease, LEASE))
        session = EtcdSession(client, lease, stack)
        await session.ready()
        return session


PEERS: dict[str, Peer] = {"etcd": Etcd()}
