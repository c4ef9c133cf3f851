"""A link that is lost between two processes that live is made again, also where Zenoh itself would not."""

from __future__ import annotations

import asyncio
import os
import re
import socket
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from pathlib import Path

import pytest
import zenoh

from tests.mesh.kit import until
from zscout.config.fleet import MeshConfig
from zscout.mesh import relinking
from zscout.mesh.zenoh_mesh import ZenohTransport, _relinking, increasing_id, zenoh_config

_PORT = re.compile(r":(\d+)(?:[?#].*)?$")

pytestmark = pytest.mark.skipif(
    len(socket.if_nameindex()) < 2, reason="there is no network but loopback, and peers tell of no address there"
)


def _cut(here: ZenohTransport, gone: Sequence[str]) -> None:
    """Ends its links with those below Zenoh: nobody says goodbye."""
    ends = {
        tuple(int(_PORT.search(end)[1]) for end in (link.src, link.dst))  # type: ignore[index]
        for link in here._session.info.links()
        if str(link.zid) in gone
    }
    assert ends
    for file in Path("/proc/self/fd").iterdir():
        with suppress(OSError), socket.socket(fileno=os.dup(int(file.name))) as one:
            if one.family != socket.AF_UNIX and (one.getsockname()[1], one.getpeername()[1]) in ends:
                one.shutdown(socket.SHUT_RDWR)


class _World:
    """Peers that answer who asks for them by multicast and ask for nobody; they find each other by one that all are
    connected to."""

    def __init__(self, stack: AsyncExitStack) -> None:
        self._stack = stack
        port = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        port.bind(("127.0.0.1", 0))  # held, so that no other test on this machine is given its number
        address = f"224.0.0.224:{port.getsockname()[1]}"
        self._config = MeshConfig(multicast_address=address, interface="lo", lease=0.5)
        self._peers: list[ZenohTransport] = []
        self._connect: list[str] = []

    async def peer(self, *, relinks: bool = False, makes_links: bool = False, known: bool = True) -> ZenohTransport:
        settings = zenoh_config(self._config)
        # Of two that are told of one another the one with the greater id makes the link.
        settings.insert_json5("id", f'"{"f" if makes_links else "1"}{len(self._peers)}"')
        settings.insert_json5("scouting/multicast/autoconnect", '{"peer": []}')
        if self._connect and known:
            settings.insert_json5("connect/endpoints", str(self._connect))
        session = zenoh.open(settings)
        if not self._connect:
            with zenoh.scout(what="peer", config=settings) as scout:
                self._connect = next(hello.locators for hello in scout if hello.zid == session.zid())[:1]
        peer = ZenohTransport(session, _relinking(session, self._config) if relinks else None)
        self._stack.push_async_callback(peer.close)
        self._peers.append(peer)
        await until(lambda: all(len(one.peers()) == len(self._peers) - 1 for one in self._peers))
        return peer


@pytest.mark.parametrize("others", [1, 2], ids=["made from here", "two of others"])
def test_a_link_that_is_lost_is_made_again(others: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who made a single link makes it again; who lost two at a time was away itself, and sees to both, whoever made
    them."""
    if others == 2:
        monkeypatch.setattr(relinking, "_listens", lambda _: False)

    async def story() -> None:
        async with AsyncExitStack() as stack:
            world = _World(stack)
            await world.peer()
            here = await world.peer(relinks=True, makes_links=True)
            there = [await world.peer() for _ in range(others)]
            _cut(here, [one.id() for one in there])
            await until(lambda: not {one.id() for one in there} <= set(here.peers()))
            await until(lambda: {one.id() for one in there} <= set(here.peers()))

    asyncio.run(story())


def test_who_joins_with_a_lesser_id_is_linked_as_well() -> None:
    """Its clock is behind: the others make the links, and have to be told of it."""

    async def story() -> None:
        async with AsyncExitStack() as stack:
            world = _World(stack)
            for _ in range(2):
                await world.peer(makes_links=True)
            late = await world.peer(relinks=True, known=False)
            assert len(late.peers()) == 2

    asyncio.run(story())


def test_ids_increase_as_zenoh_compares_them() -> None:
    ids = [increasing_id() for _ in range(20)]
    assert [len(one) for one in ids] == [32] * 20
    assert (by_last := [bytes.fromhex(one)[:9:-1] for one in ids]) == sorted(by_last)


def test_whoever_ends_is_not_looked_for() -> None:
    async def story() -> None:
        async with AsyncExitStack() as stack:
            world = _World(stack)
            (first, here, there) = [await world.peer(relinks=True) for _ in range(3)]
            await there.close()
            await until(lambda: len(here.peers()) == len(first.peers()) == 1)
            for one in (first, here):
                assert one._relinking is not None
                await until(lambda relinking=one._relinking: relinking._thread is None)  # type: ignore[misc]

    asyncio.run(story())
