"""labgrid: a place for each set, whose resources the coordinator acquires at their exporters, all or none."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import grpc
from labgrid.remote.generated import labgrid_coordinator_pb2 as words
from labgrid.remote.generated.labgrid_coordinator_pb2_grpc import CoordinatorStub
from labgrid.util import labgrid_version

from benchmarks.peers.peer import HOST, RCS, START, Peer, Session, Waiters, Waiting, free_port, package, server

EXPORTERS = {"left": RCS[0::2], "right": RCS[1::2]}


def place_of(rcs: Sequence[str]) -> str:
    return "+".join(sorted(rc.split("/")[1] for rc in rcs))


def rcs_of(place: str) -> list[str]:
    return [f"robot/{name}" for name in place.split("+")]


class LabgridSession(Session):
    """Uses the protocol of labgrid's own client, and subscribes to places only."""

    def __init__(self, address: str, name: str) -> None:
        self._channel = grpc.aio.insecure_channel(address)
        self._stub = CoordinatorStub(self._channel)
        self._name = f"bench/{name}"
        self._waiters = Waiters()
        self._synced = asyncio.Event()
        self._resources: set[str] = set()
        self._resources_changed = asyncio.Event()
        self._outgoing: asyncio.Queue[Any] = asyncio.Queue()

    async def start(self, *, resources: bool = False) -> None:
        """Open the stream; with `resources`, subscribe to them too, and wait until all ten are exported."""
        startup = words.StartupDone(version=labgrid_version(), name=self._name)
        self._outgoing.put_nowait(words.ClientInMessage(startup=startup))
        self._outgoing.put_nowait(words.ClientInMessage(subscribe=words.Subscribe(all_places=True)))
        if resources:
            self._outgoing.put_nowait(words.ClientInMessage(subscribe=words.Subscribe(all_resources=True)))
        self._outgoing.put_nowait(words.ClientInMessage(sync=words.Sync(id=1)))
        self._task = asyncio.create_task(self._listen())
        self._task.add_done_callback(self._waiters.notifications_ended)
        async with asyncio.timeout(START):
            await self._synced.wait()
            while resources and len(self._resources) < len(RCS):
                self._resources_changed.clear()
                await self._resources_changed.wait()

    async def prepare(self, rcs: Sequence[str]) -> None:
        place = place_of(rcs)
        try:
            await self._stub.AddPlace(words.AddPlaceRequest(name=place))
        except grpc.aio.AioRpcError:
            return  # another behavior with the same set made it
        for rc in rcs:
            pattern = f"*/robot/NetworkService/{rc.split('/')[1]}"
            await self._stub.AddPlaceMatch(words.AddPlaceMatchRequest(placename=place, pattern=pattern))

    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> str:
        place = place_of(rcs)
        with self._waiters.waiter(rcs) as freed:
            while not await self._try(place):
                if waiting is not None:
                    waiting()
                    waiting = None
                await self._waiters.wait(freed)
        return place

    async def _try(self, place: str) -> bool:
        try:
            await self._stub.AcquirePlace(words.AcquirePlaceRequest(placename=place))
        except grpc.aio.AioRpcError as error:
            if error.code() is grpc.StatusCode.FAILED_PRECONDITION:
                return False
            raise
        return True

    async def release(self, hold: str) -> None:
        await self._stub.ReleasePlace(words.ReleasePlaceRequest(placename=hold))

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self._channel.close()

    async def _outgoing_messages(self) -> AsyncIterator[Any]:
        while True:
            yield await self._outgoing.get()

    async def _listen(self) -> None:
        async for message in self._stub.ClientStream(self._outgoing_messages()):
            if message.HasField("sync"):
                self._synced.set()
            for update in message.updates:
                kind = update.WhichOneof("kind")
                if kind == "place" and not update.place.acquired:
                    self._waiters.freed(rcs_of(update.place.name))
                elif kind == "resource":
                    self._resources.add(update.resource.path.resource_name)
                    self._resources_changed.set()


class Labgrid(Peer):
    name = "labgrid"
    lacks = (
        "no queue for a set (reservations are for one place), no preemption; a killed client's place stays "
        "acquired until it is released by hand"
    )

    def version(self) -> str:
        return package("labgrid")

    @asynccontextmanager
    async def serve(self, folder: Path) -> AsyncIterator[str]:
        port = free_port()
        address = f"{HOST}:{port}"
        async with AsyncExitStack() as stack:
            coordinator = [sys.executable, "-m", "labgrid.remote.coordinator", "--listen", address]
            await stack.enter_async_context(server(coordinator, folder, port=port))
            for name, rcs in EXPORTERS.items():
                lines = ["robot:"]
                for rc in rcs:
                    lines += [f"  {rc.split('/')[1]}:", "    cls: NetworkService"]
                    lines += ["    address: 127.0.0.1", "    username: nobody"]
                file = folder / f"{name}.yaml"
                file.write_text("\n".join(lines) + "\n")
                exporter = [sys.executable, "-m", "labgrid.remote.exporter", "--coordinator", address]
                exporter += ["--name", name, "--hostname", "localhost", str(file)]
                await stack.enter_async_context(server(exporter, folder))
            first = LabgridSession(address, "first")
            await first.start(resources=True)
            await first.close()
            yield address

    async def connect(self, address: str, name: str) -> Session:
        session = LabgridSession(address, name)
        await session.start()
        return session


PEERS: dict[str, Peer] = {"labgrid": Labgrid()}
