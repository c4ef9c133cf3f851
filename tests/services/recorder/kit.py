"""A recorder on a mesh in memory."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from tests.mesh.kit import until
from zscout.config.fleet import Fleet, default_fleet
from zscout.keyexpr import Role, Sender, Token
from zscout.services.recorder.recorder import Recorder
from zscout.services.recorder.timeline import Timeline
from zscout.testing.memory import MemoryMesh, MemoryNetwork


def ears(network: MemoryNetwork, fleet: str = "lab") -> MemoryMesh:
    """A recorder's place."""
    return network.open(fleet, Sender("basil", "recorder"))


@asynccontextmanager
async def recording(
    path: Path, here: MemoryMesh, watcher: MemoryMesh, fleet: Fleet | None = None, *, clock: bool = False, **how: Any
) -> AsyncIterator[Timeline]:
    """A recorder at `here`, once `watcher` sees it, and until it has written all."""
    stop, seen = asyncio.Event(), list[Token]()
    with Timeline("lab", path=path, wall=clock) as timeline:
        running = asyncio.create_task(Recorder(here, fleet or default_fleet(), timeline, **how).run(stop))
        watcher.watch(watcher.keys.alive_any(Role.RECORDER), lambda token, _: seen.append(token))
        await until(lambda: seen)
        yield timeline
        stop.set()
        await running
