"""etcd: one transaction puts all keys under the session's lease or none; waiters watch for deletions. With fencing,
each device is shown the revision of that transaction before the hold counts."""

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

from benchmarks.peers.device import Devices, devices
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
    def __init__(self, client: Any, lease: int, stack: AsyncExitStack, devices: Devices | None) -> None:
        self._client, self._lease, self._stack, self._devices = client, lease, stack, devices
        self._waiters = Waiters()
        self._watching = asyncio.Event()
        self._task = asyncio.create_task(self._watch())
        self._task.add_done_callback(self._waiters.notifications_ended)

    async def ready(self) -> None:
        async with asyncio.timeout(START):
            await self._watching.wait()

    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> Held:
        held = Held(uuid.uuid4().hex, list(rcs))
        free = [KVService.txn_compare_create_revision(rc, 0) for rc in rcs]
        take = [KVService.txn_op_put(rc, held.token, lease=self._lease) for rc in rcs]
        with self._waiters.waiter(rcs) as freed:
            while not (taken := await self._client.kv.txn(free, take)).succeeded:
                if waiting is not None:
                    waiting()
                    waiting = None
                await self._waiters.wait(freed)
        if self._devices is not None:
            await self._devices.confirm(rcs, taken.header.revision)
        return held

    async def release(self, hold: Held) -> None:
        mine = [KVService.txn_compare_value(key, hold.token) for key in hold.keys]
        await self._client.kv.txn(mine, [KVService.txn_op_delete(key) for key in hold.keys])

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        if self._devices is not None:
            await self._devices.close()
        await self._stack.aclose()

    async def _watch(self) -> None:
        end = prefix_range_end(PREFIX)
        async for response in self._client.watch.watch(PREFIX, end, filters=[WatchFilter.NOPUT]):
            self._watching.set()
            self._waiters.freed(event.kv.key.decode() for event in response.events)


class Etcd(Peer):
    name = "etcd, transactions"
    lacks = (
        "no queue (the first to try after a release wins), no priorities, no preemption; a killed holder "
        "counts until its lease ends; one member here, which writes every change to disk"
    )

    def __init__(self, *, fenced: bool = False) -> None:
        self._fenced = fenced
        if fenced:
            self.name += ", fenced"

    def version(self) -> str:
        said = program_version("etcd", "--version", remedy="apt-get install etcd-server")
        return f"etcd {said.split(':')[-1].strip()}, {package('etcd3aio')}"

    @asynccontextmanager
    async def serve(self, folder: Path) -> AsyncIterator[str]:
        port, other = free_port(), free_port()
        clients, members = f"http://{HOST}:{port}", f"http://{HOST}:{other}"
        command = ["etcd", "--data-dir", str(folder / "data"), "--listen-client-urls", clients]
        command += ["--advertise-client-urls", clients, "--listen-peer-urls", members]
        command += ["--initial-advertise-peer-urls", members, "--initial-cluster", f"default={members}"]
        async with server(command, folder, port=port), devices() as ports:
            yield f"{HOST}:{port} {ports}"

    async def connect(self, address: str, name: str) -> Session:
        stack = AsyncExitStack()
        endpoint, ports = address.split()
        client = await stack.enter_async_context(Etcd3Client([endpoint]))
        lease = (await client.lease.grant(LEASE, timeout=START)).ID
        await stack.enter_async_context(client.lease.keep_alive_context(lease, LEASE))
        session = EtcdSession(client, lease, stack, await Devices.link(ports) if self._fenced else None)
        await session.ready()
        return session


PEERS: dict[str, Peer] = {"etcd": Etcd(), "etcd_fenced": Etcd(fenced=True)}
