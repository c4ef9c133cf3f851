"""The same worlds of processes on both meshes: Zenoh's on loopback, and the one in memory."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from typing import Any

from msgspec.structs import replace

from tests.hang import HANG
from tests.mesh import kit
from tests.mesh.kit import until
from zscout import messages
from zscout.config.fleet import MeshConfig, default_fleet
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.mesh import IncomingQuery, Mesh, MeshError, ZenohMesh
from zscout.mesh.transport import Collector
from zscout.messages import Message
from zscout.testing.memory import MemoryNetwork
from zscout.testing.virtual_time import VirtualTimeLoop
from zscout.types import SECOND

LONG = HANG
"""Seconds: a timeout that nothing should reach."""
SHORT = 0.3
"""Seconds: a timeout that is meant to be reached."""
ASK, NEWS, FRAMES = "test/ask", "test/news", "test/frames"


class Ping(Message, frozen=True):
    number: int = 0


class Pong(Message, frozen=True):
    number: int
    by: str = ""


class Strict(Message, frozen=True):
    number: int = 0


messages.UNIQUE_NAMES.add(Strict)


class World:
    """Processes of one fleet, all linked to each other."""

    def __init__(self, stack: AsyncExitStack) -> None:
        self.stack = stack
        self.meshes: list[Mesh] = []

    async def open(self, *names: str) -> list[Mesh]:
        for name in names:
            self.meshes.append(await self.stack.enter_async_context(await self._open(Sender(name, "test"))))
        await until(lambda: all(mesh.links() >= len(self.meshes) - 1 for mesh in self.meshes))
        return self.meshes

    async def declared(self) -> None:
        """Waits until every process knows what every other has declared so far."""
        for mesh in self.meshes:
            token = Token(mesh.me.host, Role.NODE, "fence", new_instance())
            fence = mesh.alive(token)
            for other in self.meshes:
                await _sees(other, token)
            fence.close()

    async def _open(self, me: Sender) -> Mesh:
        raise NotImplementedError

    async def occupied(self, condition: Callable[[], object]) -> None:
        """Keeps the event loop from handling what arrives, until `condition()` is true."""
        raise NotImplementedError


class Zenoh(World):
    real_time = True
    _ports: list[int]
    lease = 10.0
    """Seconds: the process of all of them may stand still for some."""

    async def _open(self, me: Sender) -> Mesh:
        self._ports = getattr(self, "_ports", [])
        endpoints = tuple(f"tcp/127.0.0.1:{port}" for port in self._ports)
        while True:
            port = random.randint(20_000, 60_000)  # noqa: S311
            config = MeshConfig(listen=(f"tcp/127.0.0.1:{port}",), connect=endpoints, multicast=False, lease=self.lease)
            try:
                mesh = await ZenohMesh.open(replace(default_fleet(), name="test", mesh=config), me)
            except MeshError:  # somebody else's port
                continue
            self._ports.append(port)
            return mesh

    async def occupied(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + kit.WITHIN
        while not condition():
            assert time.monotonic() < end
            time.sleep(0.001)  # noqa: ASYNC251 - the loop is meant to be occupied


class Memory(World):
    async def _open(self, me: Sender) -> Mesh:
        self.network: MemoryNetwork = getattr(self, "network", None) or MemoryNetwork()
        return self.network.open("test", me)

    async def occupied(self, condition: Callable[[], object]) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualTimeLoop)
        end = loop.time() + kit.WITHIN
        while not condition():
            assert loop.time() < end
            loop.jump(0.001)
            for link in self.network.links.values():
                link.pump()


def token(host: str, name: str = "one", instance: str = "i") -> Token:
    return Token(host, Role.CLIENT, name, instance)


async def _sees(mesh: Mesh, token: Token) -> None:
    seen = asyncio.Event()
    watch = mesh.watch(mesh.keys.alive(token), lambda _, alive: seen.set() if alive else None)
    await seen.wait()
    watch.close()


class Replies(Collector):
    def __init__(self) -> None:
        self.replies: list[tuple[bytes, bool]] = []
        self.over = False

    def on_reply(self, key: str, payload: bytes, ok: bool) -> None:
        self.replies.append((payload, ok))

    def on_final(self) -> None:
        self.over = True


def pong(mesh: Mesh) -> Callable[[IncomingQuery[Ping]], None]:
    return lambda query: query.answer(Pong(query.message.number, mesh.me.host))


async def timed(mesh: Mesh, asked: Awaitable[Any]) -> tuple[Any, float]:
    before = mesh.now()
    result = await asked
    return result, (mesh.now() - before) / SECOND
