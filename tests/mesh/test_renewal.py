"""A session that is opened anew, which nobody else notices; and what tells that it has to be."""

from __future__ import annotations

import asyncio
import itertools
import logging

import pytest

from tests.mesh.both_meshes import ASK, LONG, NEWS, Ping, Pong, World, token
from tests.mesh.kit import until
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import MeshError
from zscout.mesh.renewal import FORGET_AFTER, MAX_PAUSE, MIN_PAUSE, OVERLAP, PATIENCE, RenewableTransport, Suspicions
from zscout.mesh.transport import Transport
from zscout.testing.memory import MemoryNetwork
from zscout.types import SECOND


async def test_what_is_declared_goes_on_and_nobody_notices(world: World) -> None:
    a, b = await world.open("a", "b")
    seen: dict[str, list[tuple[str, bool]]] = {"a": [], "b": []}
    heard: dict[str, set[int]] = {"a": set(), "b": set()}
    handled: list[int] = []
    for mesh, name in ((a, "a"), (b, "b")):
        told, news = seen[name].append, heard[name].add
        mesh.watch(mesh.keys.alive_any(Role.CLIENT), lambda one, alive, told=told: told((one.host, alive)))  # type: ignore[misc]
        mesh.subscribe(f"{NEWS}/*", Ping, lambda _, ping, news=news: news(ping.number))  # type: ignore[misc]
    tokens = [a.alive(token("a")), b.alive(token("b"))]

    def serve(query: object) -> None:
        handled.append(query.message.number)  # type: ignore[attr-defined]
        query.answer(Pong(query.message.number))  # type: ignore[attr-defined]

    a.serve(ASK, Ping, serve)
    publishers = a.publisher(f"{NEWS}/a", Ping), b.publisher(f"{NEWS}/b", Ping)
    await world.declared()
    before = a._transport.id()
    a._transport.renew()
    asked = answered = 0
    while a._transport._renewing is not None:
        asked += 1
        reply = await b.ask_one(ASK, Ping(asked), Pong, timeout=LONG)
        answered += reply is not None
        await asyncio.sleep(0.01)
    assert a._transport.id() != before
    # Each at most once. What was sent to the old session alone, as it was left, has no answer: it is asked again.
    assert len(handled) == len(set(handled)) == answered > 0
    await until(lambda: b._transport.peers() == [a._transport.id()])
    await world.declared()
    for publisher in publishers:
        publisher.put(Ping(1_000))
    await until(lambda: all(1_000 in news for news in heard.values()))
    assert (await b.ask_one(ASK, Ping(0), Pong, timeout=LONG)) is not None
    assert {name: sorted(told) for name, told in seen.items()} == {key: [("a", True), ("b", True)] for key in "ab"}
    for one in tokens:
        one.close()
    await until(lambda: all(len(told) == 4 for told in seen.values()))


async def test_settings_that_change_during_a_renewal_are_taken_after_it() -> None:
    """A name that is removed while a session is being reopened does not keep its rights on the new one."""
    network, settings, opened = MemoryNetwork(), ["old"], list[str]()
    gate = asyncio.Event()

    async def opening() -> Transport:
        opened.append(settings[0])
        await gate.wait()
        if opened[-1] == "bad":
            raise MeshError("no port is free")
        return network._session()

    transport = RenewableTransport(network._session(), [opening])
    transport.renew()
    await asyncio.sleep(0)
    settings[0] = "bad"
    transport.take_settings()
    gate.set()
    await until(lambda: opened == ["old", "bad"] and transport._renewing is None)
    assert (opened, transport.behind) == (["old", "bad"], True)
    settings[0] = "new"
    transport.renew()
    await until(lambda: opened[-1] == "new" and transport._renewing is None)
    assert (opened, transport.behind) == (["old", "bad", "new"], False)
    await transport.close()


async def test_a_peer_that_links_to_the_old_session_meanwhile_is_waited_for() -> None:
    """A network that has just come may be found by the old session first: its peers would see this process leave."""
    network = MemoryNetwork()
    old, fresh = network._session(), network._session()
    peers: dict[Transport, list[str]] = {old: [], fresh: []}
    for session in (old, fresh):
        session.peers = lambda session=session: peers[session]  # type: ignore[method-assign, misc]

    async def opening() -> Transport:
        return fresh

    transport = RenewableTransport(old, [opening])
    transport.renew()
    await until(lambda: transport.current is fresh)
    peers[old].append("late")
    await asyncio.sleep(2 * OVERLAP)
    assert transport._renewing is not None
    peers[fresh].append("late")
    await asyncio.sleep(OVERLAP / 2)
    assert transport._renewing is not None  # for it to learn what is declared
    await until(lambda: transport._renewing is None)
    await transport.close()


async def test_what_is_polled_seldom_goes_on_as_well(world: World) -> None:
    """The session that was polled last may be closed by then."""
    a, b = await world.open("a", "b")
    polled, publisher = a.poll_latest(f"{NEWS}/*", Ping), b.publisher(f"{NEWS}/b", Ping)
    await world.declared()
    a._transport.renew()
    await until(lambda: a._transport._renewing is None)
    assert list(polled.each()) == []
    publisher.put(Ping(7))
    taken: list[tuple[str, Ping]] = []

    def take() -> bool:
        taken.extend(polled.each())
        return bool(taken)

    await until(take)
    assert [ping.number for _, ping in taken] == [7]


async def test_a_link_that_comes_back_without_its_token_is_noticed_and_left(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        network = MemoryNetwork()
        a, b = (network.open("test", Sender(name, "test")) for name in "ab")
        for mesh in (a, b):
            mesh.watch_links()
        held = b.alive(token("b"))
        seen: list[bool] = []
        a.watch(a.keys.alive_any(Role.CLIENT), lambda _, alive: seen.append(alive))
        await until(lambda: seen == [True])
        network.isolate(a)
        await until(lambda: seen == [True, False])
        network.forgetful = 1.0
        network.heal()
        network.forgetful = 0.0
        await until(lambda: seen == [True, False, True])
        await until(lambda: a.links() == b.links() == 1)
        held.close()
        await until(lambda: len(seen) == 4)
        for mesh in (a, b):
            await mesh.close()
    assert [record.message.partition(":")[2] for record in caplog.records] == [" reopening the mesh session"] * 2


@pytest.mark.parametrize("shows_another", [True, False])
async def test_a_session_that_its_program_has_left_is_not_missed(shows_another: bool) -> None:
    """Zenoh may not close it: then it stays linked, without a token."""
    network = MemoryNetwork()
    watcher, left = (network.open("test", Sender(name, "test")) for name in ("w", "a"))
    for mesh in (watcher, left):
        mesh.watch_links()
    if shows_another:
        network.open("test", Sender("a", "test")).watch_links()
    before = watcher._transport.id()
    await asyncio.sleep(1)
    withdraw = left._kept[0]
    assert callable(withdraw)
    withdraw()
    await asyncio.sleep(2 * PATIENCE)
    assert (watcher._transport.id() == before) == shows_another


async def test_nobody_withdraws_anothers_session() -> None:
    """Who shows another's session and stops to do so, as any role may, has nobody join anew."""
    network = MemoryNetwork()
    watcher, other, liar = (network.open("test", Sender(name, "test")) for name in ("w", "a", "liar"))
    for mesh in (watcher, other):
        mesh.watch_links()
    before = watcher._transport.id(), other._transport.id()
    shown = [liar.alive(Token("liar", Role.SESSION, f"s{number}", id_)) for number, id_ in enumerate(before)]
    await asyncio.sleep(1)
    for token_ in shown:
        token_.close()
    await asyncio.sleep(2 * PATIENCE)
    assert (watcher._transport.id(), other._transport.id()) == before


def test_a_contradiction_must_last_and_one_that_stays_is_acted_on_ever_more_seldom() -> None:
    renewed: list[float] = []
    seconds = 0.0
    suspicions = Suspicions(lambda: round(seconds * SECOND), lambda: renewed.append(seconds))
    suspicions.suspect("x")
    seconds += PATIENCE / 2
    suspicions.suspect("x", so=False)
    seconds += PATIENCE
    suspicions.suspect("x")
    seconds += FORGET_AFTER
    suspicions.suspect("x")
    assert renewed == []
    while seconds < 2_000:
        seconds += 0.5
        suspicions.suspect("x")
    pauses = [after - before for before, after in itertools.pairwise(renewed)]
    assert pauses[:3] == [MIN_PAUSE, 2 * MIN_PAUSE, 4 * MIN_PAUSE]
    assert max(pauses) == pauses[-1] == MAX_PAUSE


def test_what_was_set_right_and_is_wrong_again_does_not_wait_longer() -> None:
    """Links are lost again and again, and each time joining anew helps."""
    renewed: list[float] = []
    seconds = 0.0
    suspicions = Suspicions(lambda: round(seconds * SECOND), lambda: renewed.append(seconds))
    while seconds < 200:
        seconds += 0.5
        wrong = not renewed or seconds - renewed[-1] > 2
        suspicions.suspect("a", so=wrong)
        suspicions.keep(["b x"] if wrong else [], "b ")
        if wrong:
            suspicions.suspect("b x")
    assert {after - before for before, after in itertools.pairwise(renewed)} == {MIN_PAUSE}
