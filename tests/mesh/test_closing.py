"""Leaving the mesh takes a bounded time, whatever Zenoh does, and nothing is handled afterwards."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace

from tests.hang import HANG
from tests.mesh.both_meshes import ASK, LONG, NEWS, Ping, Pong, World, token
from tests.mesh.kit import until
from zscout.config.fleet import Fleet, MeshConfig, default_fleet
from zscout.keyexpr import Role, Sender
from zscout.mesh import MeshError, ZenohMesh, links, zenoh_mesh
from zscout.ports import free_port


class StuckSession:
    """A Zenoh session that never closes."""

    def __init__(self) -> None:
        self.info = SimpleNamespace(links=list)
        self.closing = threading.Event()
        self.released = threading.Event()

    def close(self) -> None:
        self.closing.set()
        self.released.wait(HANG)


def test_a_session_that_does_not_close_holds_up_neither_the_caller_nor_the_end_of_its_loop(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(zenoh_mesh, "CLOSE_TIMEOUT", 0.05)
    session: Any = StuckSession()
    before = time.monotonic()
    asyncio.run(zenoh_mesh.ZenohTransport(session).close())
    assert time.monotonic() - before < HANG / 2
    assert session.closing.is_set()
    assert "did not close" in caplog.text
    session.released.set()


def assert_the_end_waits_for(event: threading.Event, sessions: links.Sessions) -> None:
    ends = threading.Thread(target=sessions._wait, daemon=True)
    ends.start()
    ends.join(0.1)
    assert ends.is_alive()
    event.set()
    ends.join(HANG)
    assert not ends.is_alive()


def test_the_end_of_a_process_waits_for_who_closes_a_session(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, go_on = threading.Event(), threading.Event()

    def own_links(_: object) -> set[links.Ends]:
        looks.set()
        go_on.wait(HANG)
        return set()

    monkeypatch.setattr(links, "_links", own_links)
    monkeypatch.setattr(links, "CLOSE_SOON_S", 0.01)
    monkeypatch.setattr(links, "LINKS_END_S", 0.0)
    session: Any = StuckSession()
    sessions = links.Sessions()
    threading.Thread(target=sessions.close, args=[session], daemon=True).start()
    assert looks.wait(HANG)
    session.released.set()
    assert_the_end_waits_for(go_on, sessions)


def test_the_end_of_a_process_waits_for_who_frees_a_session() -> None:
    freed = threading.Event()
    closer = threading.Thread(target=freed.wait, args=[HANG], name=links.CLOSER, daemon=True)
    closer.start()
    assert_the_end_waits_for(freed, links.Sessions())


def test_a_caller_that_is_cancelled_while_it_leaves_has_the_session_closed() -> None:
    session: Any = StuckSession()

    async def main() -> None:
        leaving = asyncio.create_task(zenoh_mesh.ZenohTransport(session).close())
        await asyncio.sleep(0)
        leaving.cancel()
        await asyncio.wait([leaving])
        assert leaving.cancelled()

    asyncio.run(main())
    assert session.closing.wait(HANG)
    session.released.set()


@pytest.mark.parametrize("opened_first", [True, False])
def test_a_caller_that_is_cancelled_while_it_joins_has_the_session_closed(
    monkeypatch: pytest.MonkeyPatch, opened_first: bool
) -> None:
    session, may_open, opened = StuckSession(), threading.Event(), threading.Event()

    def slow(_settings: object) -> StuckSession:
        may_open.wait(HANG)
        opened.set()
        return session

    monkeypatch.setattr(zenoh, "open", slow)

    async def main() -> None:
        joining = asyncio.create_task(ZenohMesh.open(default_fleet(), Sender("a", "b")))
        await asyncio.sleep(0)
        if opened_first:
            may_open.set()
            opened.wait(HANG)
        joining.cancel()
        await asyncio.wait([joining])
        assert joining.cancelled()

    asyncio.run(main())
    may_open.set()
    assert session.closing.wait(HANG)
    session.released.set()


async def test_what_waits_for_a_mesh_that_is_closed_is_not_handled(world: World) -> None:
    a, b = await world.open("a", "b")
    handled: list[object] = []
    a.watch(a.keys.alive_any(Role.CLIENT), lambda *args: handled.append(args))
    await world.declared()
    declared = b.alive(token("b"))
    await world.occupied(lambda: a._inbox.items)
    await a.close()
    await asyncio.sleep(0.01)
    assert handled == []
    declared.close()


async def test_nothing_is_handled_after_the_mesh_is_closed(world: World) -> None:
    a, b = await world.open("a", "b")
    handled: list[object] = []
    a.subscribe(NEWS, Ping, lambda *args: handled.append(args))
    a.serve(ASK, Ping, handled.append)
    a.watch(a.keys.alive_any(Role.CLIENT), lambda *args: handled.append(args))
    await world.declared()
    await a.close()
    await a.close()
    b.put(NEWS, Ping())
    late = b.alive(token("b"))
    assert (await b.ask(ASK, Ping(), Pong, timeout=LONG), handled) == ([], [])
    a.put(NEWS, Ping())
    late.close()


def test_a_port_in_use_is_named_without_the_places_in_zenohs_source() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        mesh = MeshConfig(listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
        opening = ZenohMesh.open(replace(default_fleet(), mesh=mesh), Sender("anvil", "script"))
        with pytest.raises(MeshError) as refused:
            asyncio.run(opening)
    words = str(refused.value)
    assert f"127.0.0.1:{port}: Address already in use" in words
    assert ".rs" not in words
    assert words.endswith("]; check listen and connect under [mesh]")


@pytest.fixture(params=["accepts", "drops"])
def silent(request: pytest.FixtureRequest) -> Iterator[int]:
    """The port of a process that is frozen: the kernel accepts connections for it, and nobody answers; or it has no
    room for more, and drops them, as those to a host that is off."""
    with ExitStack() as stack:
        frozen = stack.enter_context(socket.socket())
        frozen.bind(("127.0.0.1", 0))
        frozen.listen(64 if request.param == "accepts" else 0)
        if request.param == "drops":
            for _ in range(4):
                waiting = stack.enter_context(socket.socket())
                waiting.setblocking(False)
                waiting.connect_ex(frozen.getsockname())
        yield frozen.getsockname()[1]


def connecting(fleet: Fleet, host: str, port: int) -> Fleet:
    return replace(fleet, mesh=MeshConfig(multicast=False, lease=5, connect=(f"tcp/{host}:{port}",)))


@pytest.mark.real_time
async def test_a_frozen_process_that_is_sought_holds_up_nobody_who_leaves(
    silent: int, caplog: pytest.LogCaptureFixture
) -> None:
    fleet = connecting(default_fleet(), "127.0.0.1", silent)
    async with await ZenohMesh.open(fleet, Sender("a", "stays")) as stays:
        async with await ZenohMesh.open(fleet, Sender("a", "leaves")) as leaves:
            await until(lambda: stays.links() == leaves.links() == 1)
        assert "did not close" not in caplog.text


@pytest.mark.real_time
async def test_a_session_that_closes_slowly_is_left_at_once_by_its_peers(
    silent: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_mesh, "CLOSE_TIMEOUT", 2.0)
    monkeypatch.setattr(links, "LINKS_END_S", 0.1)
    fleet = connecting(default_fleet(), "localhost", silent)  # a name, so its connections are unknown
    async with await ZenohMesh.open(fleet, Sender("a", "stays")) as stays:
        leaves = await ZenohMesh.open(fleet, Sender("a", "leaves"))
        await until(lambda: stays.links() == leaves.links() == 1)
        session = leaves._transport.current
        leaving = asyncio.create_task(leaves.close())
        await until(lambda: stays.links() == session.links() == 0)
        assert not leaving.done()
        await leaving


@pytest.mark.real_time
@pytest.mark.slow
async def test_a_session_that_closes_slowly_frees_its_port_for_the_next(
    silent: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_mesh, "CLOSE_TIMEOUT", 0.6)
    fleet = connecting(default_fleet(), "localhost", silent)  # a name, so its connections are unknown
    port = free_port("127.0.0.1", 0)
    fleet = replace(fleet, mesh=replace(fleet.mesh, listen=(f"tcp/127.0.0.1:{port}",)))
    async with await ZenohMesh.open(fleet, Sender("a", "node")) as mesh:
        before = mesh._transport.id()
        mesh._transport.renew()
        await until(lambda: mesh._transport._renewing is None)
        assert mesh._transport.id() != before
        assert not mesh._transport.behind
        # The close that still goes on ends no listener but its own.
        await until(lambda: links.CLOSING not in (thread.name for thread in threading.enumerate()))
        socket.create_connection(("127.0.0.1", port), HANG).close()
