"""Redis: one Lua script takes all keys or none; releases are published, and waiters try again. With fencing, the script
also counts a token, which is shown to each device before the hold counts."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import redis.asyncio

from benchmarks.peers.device import Devices, devices
from benchmarks.peers.peer import (
    HOST,
    LEASE,
    Peer,
    Session,
    Waiters,
    Waiting,
    free_port,
    package,
    program_version,
    server,
)

FREED = "freed"
TAKE = """
local longest = -2
for _, key in ipairs(KEYS) do longest = math.max(longest, redis.call('PTTL', key)) end
if longest ~= -2 then return {longest, 0} end
for _, key in ipairs(KEYS) do redis.call('SET', key, ARGV[1], 'PX', ARGV[2]) end
return {-2, redis.call('INCR', 'fence')}
"""
"""Returns -2 if all were taken, else the ms until the last conflicting key ends unless renewed; and the token of this
hold, above all earlier tokens."""
RENEW = """
for _, key in ipairs(KEYS) do
  if redis.call('GET', key) == ARGV[1] then redis.call('PEXPIRE', key, ARGV[2]) end
end
"""
GIVE = """
for _, key in ipairs(KEYS) do
  if redis.call('GET', key) == ARGV[1] then redis.call('DEL', key) end
end
redis.call('PUBLISH', 'freed', table.concat(KEYS, ' '))
"""


@dataclass(frozen=True, slots=True)
class Held:
    token: str
    keys: list[str]


class RedisSession(Session):
    def __init__(self, client: Any, listener: Any, devices: Devices | None) -> None:
        self._client, self._listener, self._devices = client, listener, devices
        self._take, self._renew, self._give = (client.register_script(text) for text in (TAKE, RENEW, GIVE))
        self._waiters = Waiters()
        self._held: dict[str, Held] = {}
        self._tasks = [asyncio.create_task(self._listen()), asyncio.create_task(self._keep())]
        self._tasks[0].add_done_callback(self._waiters.notifications_ended)

    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> Held:
        held = Held(uuid.uuid4().hex, list(rcs))
        with self._waiters.waiter(rcs) as freed:
            while (answer := await self._take(keys=held.keys, args=[held.token, LEASE * 1000]))[0] != -2:
                if waiting is not None:
                    waiting()
                    waiting = None
                # A key that ends by its own time is not published.
                with suppress(TimeoutError):
                    async with asyncio.timeout((answer[0] + 1) / 1000):
                        await self._waiters.wait(freed)
        self._held[held.token] = held
        if self._devices is not None:
            await self._devices.confirm(rcs, answer[1])
        return held

    async def release(self, hold: Held) -> None:
        del self._held[hold.token]
        await self._give(keys=hold.keys, args=[hold.token])

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._devices is not None:
            await self._devices.close()
        await self._listener.aclose()
        await self._client.aclose()

    async def _listen(self) -> None:
        async for message in self._listener.listen():
            if message["type"] == "message":
                self._waiters.freed(message["data"].decode().split())

    async def _keep(self) -> None:
        while True:
            await asyncio.sleep(LEASE / 3)
            for held in list(self._held.values()):
                await self._renew(keys=held.keys, args=[held.token, LEASE * 1000])


class Redis(Peer):
    name = "Redis, Lua script"
    lacks = (
        "no queue (the first to try after a release wins), no priorities, no preemption; a killed holder "
        "counts until its keys end; nothing is written to disk, and no device checks a hold"
    )

    def __init__(self, *, fenced: bool = False) -> None:
        self._fenced = fenced
        if fenced:
            self.name += ", fenced"
            self.lacks = self.lacks.replace(", and no device checks a hold", "")

    def version(self) -> str:
        remedy = "apt-get install redis-server"
        said = program_version("redis-server", "--version", remedy=remedy).split("v=")[1].split()[0]
        return f"redis-server {said}, {package('redis')}"

    @asynccontextmanager
    async def serve(self, folder: Path) -> AsyncIterator[str]:
        port = free_port()
        command = ["redis-server", "--bind", HOST, "--port", str(port), "--save", "", "--appendonly", "no"]
        async with server(command, folder, port=port), devices() as ports:
            yield f"redis://{HOST}:{port} {ports}"

    async def connect(self, address: str, name: str) -> Session:
        url, ports = address.split()
        client = redis.asyncio.Redis.from_url(url, socket_timeout=None)
        listener = client.pubsub()
        await listener.subscribe(FREED)
        return RedisSession(client, listener, await Devices.link(ports) if self._fenced else None)


PEERS: dict[str, Peer] = {"redis": Redis(), "redis_fenced": Redis(fenced=True)}
