"""The RCs of a node over reloads of its file."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.mesh.kit import run
from zscout.behaviors.client.arc import Revoked
from zscout.config.node import Node, load_node
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.registry import driver_for
from zscout.keyexpr import Sender
from zscout.mesh.supervision import StallWatch
from zscout.services.node import local_rcs
from zscout.services.node.local_rcs import LocalRcs, RcNotOpened
from zscout.testing import MemoryFleet

Files = Callable[..., Node]


@pytest.fixture
def files(tmp_path: Path) -> Files:
    file = tmp_path / "anvil.toml"

    def write(*rcs: str, **settle: float) -> Node:
        tables = [f'[[rc]]\nname = "{rc}"\ndriver = "exclusive"\nsettle = {settle.get(rc[-1], 5.0)}\n' for rc in rcs]
        file.write_text(f'[node]\nhost = "anvil"\nstate = "{tmp_path}"\n' + "".join(tables))
        return load_node(file)

    return write


@asynccontextmanager
async def anvil(fleet: MemoryFleet, node: Node, folder: Path) -> AsyncIterator[LocalRcs]:
    mesh = fleet.network.open(fleet.config.name, Sender("anvil", "node"))
    stall, failures = StallWatch(mesh.now).start(), list[Exception]()
    rcs = LocalRcs(mesh, node, lambda: folder, stall, failures.append)
    await rcs.start()
    yield rcs
    await rcs.stop()
    stall.stop()
    await mesh.close()
    assert not failures


def names(rcs: LocalRcs) -> list[str]:
    return sorted(rc.name for rc in rcs.controllers)


async def present(fleet: MemoryFleet, *rcs: str) -> None:
    client, seen = fleet.client(), set[str]()
    while seen != set(rcs):  # the leader's word comes by a query
        await asyncio.sleep(0.01)
        state = await client.state()
        seen = {view.rc for view in state.rcs if view.present} if state is not None else set()


async def ended_by(fleet: MemoryFleet, why: str, taking: Coroutine[Any, Any, None]) -> None:
    """A hold of arm/b ends as a reload is taken."""
    ended, task = "", None
    try:
        async with fleet.hold("ended", {"arm/b": {}}):
            task = asyncio.create_task(taking)
            await asyncio.sleep(60)
    except Revoked as revoked:
        ended = str(revoked)
    assert f"arm/b was lost: {why}" in ended
    assert task is not None
    await task


def test_new_tables_are_started_and_removed_ones_stopped_while_others_go_on(files: Files, tmp_path: Path) -> None:
    async def story() -> None:
        async with MemoryFleet() as fleet, anvil(fleet, files("arm/a", "arm/b"), tmp_path) as rcs:
            await present(fleet, "arm/a", "arm/b")
            async with fleet.hold("kept", {"arm/a": {}}) as held:
                await ended_by(fleet, "it was removed from the node file of anvil", rcs.take(files("arm/a", "arm/c")))
                await present(fleet, "arm/a", "arm/c")
                assert names(rcs) == ["arm/a", "arm/c"]
                await held.command("arm/a", {"name": "confirm"})
            async with fleet.hold("new", {"arm/c": {}}, confirmed=True):
                pass

    run(story())


def test_a_changed_table_is_removed_and_added(files: Files, tmp_path: Path) -> None:
    async def story() -> None:
        async with MemoryFleet() as fleet, anvil(fleet, files("arm/a", "arm/b"), tmp_path) as rcs:
            await present(fleet, "arm/a", "arm/b")
            before = {rc.name: rc for rc in rcs.controllers}
            taking = rcs.take(files("arm/a", "arm/b", b=1.0))
            await ended_by(fleet, "it was changed in the node file of anvil", taking)
            after = {rc.name: rc for rc in rcs.controllers}
            assert after["arm/a"] is before["arm/a"]
            assert after["arm/b"] is not before["arm/b"]
            await present(fleet, "arm/a", "arm/b")
            async with fleet.hold("again", {"arm/b": {}}, confirmed=True):
                pass

    run(story())


def test_one_that_can_not_be_opened_keeps_no_other_from_it_and_is_tried_at_the_next_reload(
    files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Unopened(ExclusiveDriver):
        async def open(self, _rc: object) -> None:
            raise OSError("no such port")

    broken = [True]
    monkeypatch.setattr(
        local_rcs, "driver_for", lambda spec: Unopened() if spec.name == "arm/b" and broken[0] else driver_for(spec)
    )

    async def story() -> None:
        async with MemoryFleet() as fleet, anvil(fleet, files("arm/a"), tmp_path) as rcs:
            with pytest.raises(RcNotOpened, match=r"arm/b can't be opened: OSError\('no such port'\); see the log"):
                await rcs.take(files("arm/a", "arm/b", "arm/c"))
            assert names(rcs) == ["arm/a", "arm/c"]
            broken[0] = False
            await rcs.take(files("arm/a", "arm/b", "arm/c"))
            assert names(rcs) == ["arm/a", "arm/b", "arm/c"]
            await present(fleet, "arm/a", "arm/b", "arm/c")

    run(story())
