"""A link that is lost between two processes that live is made again, also where Zenoh itself would not."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh
from msgspec.structs import replace

from tests.mesh.kit import WITHIN, until
from zscout.config.fleet import MeshConfig
from zscout.mesh import relinking
from zscout.mesh.relinking import Relinking
from zscout.mesh.zenoh_mesh import ZenohTransport, _relinking, increasing_id, zenoh_config

_PORT = re.compile(r":(\d+)(?:[?#].*)?$")

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(
        len(socket.if_nameindex()) < 2, reason="there is no network but loopback, and peers tell of no address there"
    ),
]


def _ends(here: ZenohTransport, there: str) -> set[tuple[int, int]]:
    """The ports of its links with one of them."""
    links = (link for link in here._session.info.links() if str(link.zid) == there)
    return {tuple(int(_PORT.search(end)[1]) for end in (link.src, link.dst)) for link in links}  # type: ignore[index, misc]


def _cut(ends: set[tuple[int, int]]) -> None:
    """Ends these links below Zenoh: nobody says goodbye."""
    assert ends
    for file in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if not str(file.readlink()).startswith("socket:"):
                continue
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
        self._config = MeshConfig(multicast_address=address, interface="lo", lease=10.0, site="a")
        self._peers: list[ZenohTransport] = []
        self._connect: list[str] = []

    def relay(self) -> tuple[ZenohTransport, str]:
        """One, and where it listens."""
        settings = zenoh_config(replace(self._config, site=None, relay=("a", "b"), listen=("tcp/127.0.0.1:0",)))
        relay = ZenohTransport(zenoh.open(settings))
        self._stack.push_async_callback(relay.close)
        with zenoh.scout(what="router", config=settings) as scout:
            return relay, next(hello.locators[0] for hello in scout if str(hello.zid) == relay.id())

    def meeting(self) -> zenoh.Config:
        """For a session by which the first peer is introduced to others."""
        settings = zenoh_config(replace(self._config, multicast=False, connect=tuple(self._connect)))
        settings.insert_json5("id", f'"{relinking.TEMPORARY_ID}01"')
        return settings

    async def peer(
        self, *, relinks: bool = False, makes_links: bool = False, known: bool = True, connect: Sequence[str] = ()
    ) -> ZenohTransport:
        settings = zenoh_config(self._config)
        # Of two that are told of one another the one with the greater id makes the link.
        settings.insert_json5("id", f'"{"f" if makes_links else "1"}{len(self._peers)}"')
        settings.insert_json5("scouting/multicast/autoconnect", '{"peer": []}')
        if self._connect and known:
            settings.insert_json5("connect/endpoints", str([*self._connect, *connect]))
        session = zenoh.open(settings)
        if not self._connect:
            with zenoh.scout(what="peer", config=settings) as scout:
                self._connect = next(hello.locators for hello in scout if hello.zid == session.zid())[:1]
        peer = ZenohTransport(session, _relinking(session, self._config) if relinks else None)
        self._stack.push_async_callback(peer.close)
        self._peers.append(peer)
        ids = {one.id() for one in self._peers}
        await until(lambda: all(ids <= {one.id(), *one.peers()} for one in self._peers))
        return peer

    async def pair(self, connect: Sequence[str] = ()) -> tuple[ZenohTransport, str]:
        """Two peers among three: one that makes its links again, and the id of another."""
        await self.peer()
        here = await self.peer(relinks=True, makes_links=True, connect=connect)
        return here, (await self.peer()).id()


async def test_a_link_that_is_lost_is_made_again(stack: AsyncExitStack) -> None:
    """By who made it."""
    here, there = await _World(stack).pair()
    _cut(before := _ends(here, there))
    await until(lambda: _ends(here, there) - before)


async def test_a_link_that_came_and_went_without_a_word_is_made_again(
    stack: AsyncExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh tells of some that come that they do, and not that they are gone."""
    monkeypatch.setattr(relinking, "ATTEMPT_PAUSES", (0.5, *relinking.ATTEMPT_PAUSES))

    here, there = await _World(stack).pair()
    looking = here._relinking
    assert looking is not None
    _cut(before := _ends(here, there))
    await until(lambda: there in looking._lost)
    looking._on_link(cast("Any", SimpleNamespace(kind=zenoh.SampleKind.PUT, link=SimpleNamespace(zid=there))))
    await until(lambda: _ends(here, there) - before)


async def test_who_lost_two_links_made_by_others_sees_to_both(
    stack: AsyncExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was away itself. The second may be lost when it has looked for the first in vain."""
    looked: list[object] = []

    def listens(addresses: Sequence[str]) -> bool:
        looked.append(addresses)
        return False

    monkeypatch.setattr(relinking, "_listens", listens)
    # However late this process comes to cut the second.
    monkeypatch.setattr(relinking, "SIMULTANEOUS", WITHIN)

    world = _World(stack)
    await world.peer()
    here = await world.peer(relinks=True, makes_links=True)
    there = [(await world.peer()).id() for _ in range(2)]
    before = [_ends(here, one) for one in there]
    for number, (one, ends) in enumerate(zip(there, before, strict=True), 1):
        _cut(ends)
        # Or Zenoh was about to try another of its addresses.
        await until(lambda: len(looked) >= number or _ends(here, one) - ends)  # noqa: B023 - awaited here
    for one, ends in zip(there, before, strict=True):
        await until(lambda: _ends(here, one) - ends)  # noqa: B023 - awaited here


async def test_the_session_that_introduces_it_is_no_link_to_anybody(stack: AsyncExitStack) -> None:
    world = _World(stack)
    here = await world.peer()
    settings = world.meeting()
    with zenoh.open(settings):
        await until(lambda: here._session.info.links())
        assert (here.links(), here.peers()) == (0, [])


async def test_who_joins_with_a_lesser_id_is_linked_as_well(stack: AsyncExitStack) -> None:
    """Its clock is behind: the others make the links, and have to be told of it."""
    world = _World(stack)
    for _ in range(2):
        await world.peer(makes_links=True)
    late = await world.peer(relinks=True, known=False)
    assert len(late.peers()) == 2


def test_ids_increase_as_zenoh_compares_them() -> None:
    ids = [increasing_id() for _ in range(20)]
    assert [len(one) for one in ids] == [32] * 20
    assert (by_last := [bytes.fromhex(one)[:9:-1] for one in ids]) == sorted(by_last)


async def test_whoever_ends_is_not_looked_for(stack: AsyncExitStack) -> None:
    world = _World(stack)
    (first, here, there) = [await world.peer(relinks=True) for _ in range(3)]
    gone = there.id()
    await there.close()

    def is_gone() -> bool:
        # Once in fifty a Zenoh session that is closed makes its own links again, and they last as long as its
        # process, which would end now.
        for one in (first, here):
            if ends := _ends(one, gone):
                _cut(ends)
        return len(here.peers()) == len(first.peers()) == 1

    await until(is_gone)
    for one in (first, here):
        assert one._relinking is not None
        await until(lambda relinking=one._relinking: relinking._thread is None)  # type: ignore[misc]


async def test_who_listens_and_is_not_found_is_asked_once_whether_it_does(
    stack: AsyncExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each connection that is closed unused keeps others from a TLS listener for a while."""
    monkeypatch.setattr(relinking, "ATTEMPT_PAUSES", (0.01,) * 5)
    monkeypatch.setattr(relinking, "SCOUT_TIMEOUT", 0.05)

    here = (await _World(stack).peer(relinks=True))._relinking
    assert here is not None
    await until(lambda: here._thread is None)
    frozen = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
    with here._lock:
        here._lost["f"] = relinking._Lost(0.0, [f"tls/127.0.0.1:{frozen.getsockname()[1]}"])
        here._begin(greet=False)
    await until(lambda: here._thread is None)
    frozen.setblocking(False)
    frozen.accept()[0].close()
    with pytest.raises(BlockingIOError):
        frozen.accept()


async def test_a_relay_is_not_looked_for(stack: AsyncExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    """It answers nobody who looks for peers."""
    looked: list[str] = []

    def listens(addresses: Sequence[str]) -> bool:
        looked.extend(addresses)
        return True

    monkeypatch.setattr(relinking, "_listens", listens)

    world = _World(stack)
    relay, address = world.relay()
    here, there = await world.pair([address])
    before = _ends(here, there)
    await until(lambda: _ends(here, relay.id()))
    await relay.close()
    await until(lambda: not _ends(here, relay.id()))
    _cut(before)
    await until(lambda: _ends(here, there) - before)
    assert looked
    assert address not in looked


async def test_a_neighbour_s_link_is_left_to_zenoh(stack: AsyncExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is introduced to a neighbour is linked to it by a network address."""
    here = await _World(stack).peer()
    config = zenoh_config(MeshConfig(multicast=False))
    relinks = Relinking(here._session, config, lambda _: config, lambda peer: peer != "c3")
    stack.callback(relinks.close)
    await until(lambda: relinks._thread is None)
    wanted: list[str] = []
    monkeypatch.setattr(relinking, "_listens", lambda _: True)
    monkeypatch.setattr(relinks, "_begin", lambda **_: None)

    def scout(_seconds: float, peers: set[str]) -> dict[str, list[str]]:
        wanted.extend(peers)
        return {}

    monkeypatch.setattr(relinks, "_scout", scout)
    for peer, ip in (("a1", "[fd00::2]"), ("b2", "127.0.0.1"), ("c3", "127.0.0.1")):
        link = SimpleNamespace(zid=peer, src=f"tcp/{ip}:1", dst=f"tcp/{ip}:2")
        relinks._on_link(cast("zenoh.LinkEvent", SimpleNamespace(kind=zenoh.SampleKind.DELETE, link=link)))
    assert [peer for peer, lost in relinks._lost.items() if lost.together] == ["b2", "c3"]
    relinks._try_all()
    assert wanted == ["c3"]
