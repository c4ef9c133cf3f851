"""What services may rely on, held against both meshes: Zenoh's on loopback, and the one in memory."""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from typing import Any, TypeAlias

import pytest

from tests.mesh import kit
from tests.mesh.kit import until
from zscout import messages
from zscout.config.fleet import MeshConfig
from zscout.keyexpr import BadName, Role, Sender, Token, new_instance
from zscout.lab.faults.memory import MemoryNetwork
from zscout.lab.faults.virtual_time import VirtualTimeLoop
from zscout.mesh import IncomingQuery, Mesh, MeshError, Refused, ZenohMesh, session
from zscout.mesh.transport import Collector, Quality
from zscout.messages import MAX_FRAME, FrameHead, Message
from zscout.types import SECOND

LONG = 10.0
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


messages.NAMES_ONCE.add(Strict)


class World:
    """Processes of one fleet, all linked to each other."""

    def __init__(self, stack: AsyncExitStack) -> None:
        self._stack = stack
        self.meshes: list[Mesh] = []

    async def open(self, *names: str) -> list[Mesh]:
        for name in names:
            self.meshes.append(await self._stack.enter_async_context(await self._open(Sender(name, "test"))))
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
    _ports: list[int]

    async def _open(self, me: Sender) -> Mesh:
        self._ports = getattr(self, "_ports", [])
        endpoints = tuple(f"tcp/127.0.0.1:{port}" for port in self._ports)
        while True:
            port = random.randint(20_000, 60_000)  # noqa: S311
            config = MeshConfig(listen=(f"tcp/127.0.0.1:{port}",), connect=endpoints, multicast=False)
            try:
                mesh = await ZenohMesh.open("test", me, config)
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
            for link in self.network._links.values():
                link.pump()


Story: TypeAlias = Callable[[World], Awaitable[None]]


@pytest.fixture(params=[Memory, Zenoh])
def play(request: pytest.FixtureRequest) -> Callable[[Story], None]:
    def play(story: Story) -> None:
        async def main() -> None:
            async with AsyncExitStack() as stack, asyncio.timeout(60):
                await story(request.param(stack))

        (kit.run if request.param is Memory else asyncio.run)(main())

    return play


Play: TypeAlias = Callable[[Story], None]


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


# Queries


def test_all_who_serve_a_key_reply(play: Play) -> None:
    async def story(world: World) -> None:
        a, b, c = await world.open("a", "b", "c")
        for mesh in (a, b, c):
            mesh.serve(ASK, Ping, pong(mesh))
        await world.declared()
        replies = await a.ask(ASK, Ping(7), Pong, timeout=LONG)
        assert {(reply.key, reply.message) for reply in replies} == {(ASK, Pong(7, host)) for host in ("a", "b", "c")}
        assert all(reply.problem is None for reply in replies)

    play(story)


def test_two_that_serve_a_key_in_one_process_both_reply(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        b.serve(ASK, Ping, lambda query: query.answer(Pong(1)))
        b.serve("test/*", Ping, lambda query: query.answer(Pong(2)))
        await world.declared()
        replies = await a.ask(ASK, Ping(), Pong, timeout=LONG)
        assert {reply.message.number for reply in replies if reply.message} == {1, 2}

    play(story)


def test_a_query_that_nobody_serves_is_over_at_once(play: Play) -> None:
    async def story(world: World) -> None:
        a, _ = await world.open("a", "b")
        replies, took = await timed(a, a.ask(ASK, Ping(), Pong, timeout=LONG))
        assert replies == []
        assert took < LONG / 2

    play(story)


def test_a_query_that_its_handler_forgets_is_over_at_once(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        b.serve(ASK, Ping, lambda _: None)
        await world.declared()
        replies, took = await timed(a, a.ask(ASK, Ping(), Pong, timeout=LONG))
        assert replies == []
        assert took < LONG / 2

    play(story)


def test_a_query_that_is_kept_is_over_at_its_timeout(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        kept: list[IncomingQuery[Ping]] = []
        b.serve(ASK, Ping, kept.append)
        await world.declared()
        replies, took = await timed(a, a.ask(ASK, Ping(), Pong, timeout=SHORT))
        assert replies == []
        assert took >= SHORT * 0.99
        assert len(kept) == 1
        kept[0].answer(Pong(1))  # too late, and no harm

    play(story)


def test_a_query_may_be_answered_later_and_once(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        kept: list[IncomingQuery[Ping]] = []
        b.serve(ASK, Ping, kept.append)
        await world.declared()
        asking = asyncio.create_task(a.ask(ASK, Ping(3), Pong, timeout=LONG))
        await until(lambda: kept)
        kept[0].answer(Pong(kept[0].message.number))
        kept[0].answer(Pong(99))
        kept[0].refuse(messages.Problem("late", "late"))
        assert [reply.message for reply in await asking] == [Pong(3)]
        assert kept[0].key == ASK

    play(story)


def test_a_query_is_over_when_the_process_that_keeps_it_leaves(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        kept: list[IncomingQuery[Ping]] = []
        b.serve(ASK, Ping, kept.append)
        await world.declared()
        asking = asyncio.create_task(timed(a, a.ask(ASK, Ping(), Pong, timeout=LONG)))
        await until(lambda: kept)
        await b.close()
        replies, took = await asking
        assert replies == []
        assert took < LONG / 2

    play(story)


@pytest.mark.parametrize(
    ("error", "code"),
    [(Refused("not_yet", "wait"), "not_yet"), (BadName("no name"), "bad_name"), (ValueError("broken"), "internal")],
)
def test_what_a_handler_raises_is_replied_as_a_problem(play: Play, error: Exception, code: str) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")

        def handle(_: IncomingQuery[Ping]) -> None:
            raise error

        b.serve(ASK, Ping, handle)
        await world.declared()
        reply = await a.ask_one(ASK, Ping(), Pong, timeout=LONG)
        assert reply is not None
        assert reply.message is None
        assert reply.problem is not None
        assert reply.problem.code == code

    play(story)


@pytest.mark.parametrize(
    ("kind", "payload"),
    [
        (Ping, b"no JSON"),
        (Ping, b'{"number": "1"}'),
        (Ping, b'{"number": 1, "text": "' + b"x" * 200 + b'"}'),
        (Strict, b'{"number": 1, "number": 2}'),
    ],
)
def test_a_malformed_query_never_reaches_its_handler(play: Play, kind: type, payload: bytes) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        handled: list[object] = []
        b.serve(ASK, kind, handled.append, limit=100)
        await world.declared()
        collector = Replies()
        a._transport.get(ASK, payload, kind, LONG, collector)
        await until(lambda: collector.over)
        ((reply, ok),) = collector.replies
        problem: messages.Problem = messages.decode(reply, messages.Problem)
        assert not ok
        assert problem.code == "malformed"
        assert handled == []

    play(story)


def test_a_query_without_a_message_is_an_empty_one(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        b.serve(ASK, Ping, pong(b))
        await world.declared()
        reply = await a.ask_one(ASK, None, Pong, timeout=LONG)
        assert reply is not None
        assert reply.message == Pong(0, "b")

    play(story)


def test_a_reply_that_is_malformed_or_too_long_is_dropped(play: Play, caplog: pytest.LogCaptureFixture) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        b.serve(ASK, Ping, lambda query: query.answer(Pong(1, "x" * 200)))
        await world.declared()
        assert await a.ask(ASK, Ping(), Pong, timeout=LONG, limit=100) == []

    play(story)
    assert "malformed" in caplog.text


def test_a_wildcard_is_answered_where_the_served_key_has_none_and_refused_elsewhere(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        b.serve("test/one", Ping, pong(b))
        b.serve("test/many/*", Ping, pong(b))
        await world.declared()
        reply = await a.ask_one("test/*", Ping(), Pong, timeout=LONG)
        assert reply is not None
        assert (reply.key, reply.message) == ("test/one", Pong(0, "b"))
        reply = await a.ask_one("test/many/*", Ping(), Pong, timeout=LONG)
        assert reply is not None
        assert reply.problem is not None
        assert reply.problem.code == "bad_key"
        reply = await a.ask_one("test/many/x", Ping(), Pong, timeout=LONG)
        assert reply is not None
        assert (reply.key, reply.message) == ("test/many/x", Pong(0, "b"))

    play(story)


def test_queries_beyond_a_full_queue_are_refused_as_busy(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        b.serve(ASK, Ping, pong(b), depth=2)
        await world.declared()
        outcomes: list[object] = []
        for number in range(10):
            a.ask_then(ASK, Ping(number), Pong, outcomes.append, timeout=LONG)
        await world.occupied(lambda: len(a._inbox.items) == 16)  # a problem and an end each
        await until(lambda: len(outcomes) == 10)
        codes = [reply.problem.code for reply in outcomes if reply.problem]  # type: ignore[attr-defined]
        assert codes == ["busy"] * 8
        reply = await a.ask_one(ASK, Ping(), Pong, timeout=LONG)
        assert reply is not None
        assert reply.message is not None

    play(story)


def test_ask_ends_with_the_reply_that_is_enough(play: Play) -> None:
    async def story(world: World) -> None:
        a, b, c = await world.open("a", "b", "c")
        kept: list[IncomingQuery[Ping]] = []
        b.serve(ASK, Ping, pong(b))
        c.serve(ASK, Ping, kept.append)
        await world.declared()
        asked = a.ask(ASK, Ping(), Pong, timeout=LONG, enough=lambda reply: reply.message == Pong(0, "b"))
        replies, took = await timed(a, asked)
        assert [reply.message for reply in replies] == [Pong(0, "b")]
        assert took < LONG / 2

    play(story)


def test_ask_then_calls_back_once(play: Play) -> None:
    async def story(world: World) -> None:
        a, b, c = await world.open("a", "b", "c")
        outcomes: list[object] = []
        a.ask_then(ASK, Ping(), Pong, outcomes.append, timeout=LONG)
        await until(lambda: outcomes)
        assert outcomes == [None]
        for mesh in (b, c):
            mesh.serve(ASK, Ping, pong(mesh))
        await world.declared()
        a.ask_then(ASK, Ping(), Pong, outcomes.append, timeout=LONG)
        assert len(await a.ask(ASK, Ping(), Pong, timeout=LONG)) == 2
        await until(lambda: len(outcomes) > 1)
        assert len(outcomes) == 2

    play(story)


def test_what_cannot_be_asked_raises(play: Play) -> None:
    async def story(world: World) -> None:
        a, _ = await world.open("a", "b")
        with pytest.raises(MeshError, match="no//key"):
            await a.ask("no//key", Ping(), Pong, timeout=LONG)
        await a.close()
        with pytest.raises(MeshError):
            await a.ask(ASK, Ping(), Pong, timeout=LONG)

    play(story)


def test_what_is_undeclared_is_not_asked(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        served = b.serve(ASK, Ping, pong(b))
        await world.declared()
        assert len(await a.ask(ASK, Ping(), Pong, timeout=LONG)) == 1
        served.close()
        served.close()
        assert await a.ask(ASK, Ping(), Pong, timeout=LONG) == []

    play(story)


# Publications


def test_publications_arrive_in_order(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        heard: list[tuple[str, int]] = []
        own: list[int] = []
        a.subscribe("test/*", Ping, lambda key, ping: heard.append((key, ping.number)))
        b.subscribe(NEWS, Ping, lambda _, ping: own.append(ping.number))
        await world.declared()
        publisher = b.publisher(NEWS, Ping)
        for number in range(0, 100, 2):
            publisher.put(Ping(number))
            b.put(NEWS, Ping(number + 1))
        await until(lambda: len(heard) == 100 and len(own) == 100)
        assert heard == [(NEWS, number) for number in range(100)]
        assert own == list(range(100))
        publisher.close()

    play(story)


def test_what_is_published_before_a_subscription_is_not_kept(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        b.put(NEWS, Ping(1))
        heard: list[int] = []
        a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number))
        await world.declared()
        b.put(NEWS, Ping(2))
        await until(lambda: heard)
        assert heard == [2]

    play(story)


def test_alike_subscriptions_are_closed_one_by_one(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        one: list[int] = []
        other: list[int] = []
        first = a.subscribe(NEWS, Ping, lambda _, ping: one.append(ping.number))
        second = a.subscribe(NEWS, Ping, lambda _, ping: other.append(ping.number))
        assert len(a._shared) == 1
        await world.declared()
        b.put(NEWS, Ping(1))
        await until(lambda: other)
        first.close()
        b.put(NEWS, Ping(2))
        await until(lambda: len(other) == 2)
        assert one == [1]
        second.close()
        assert not a._shared

    play(story)


def test_a_malformed_publication_and_a_handler_that_fails_stop_nobody(
    play: Play, caplog: pytest.LogCaptureFixture
) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        heard: list[int] = []

        def fail(_: str, ping: Ping) -> None:
            if ping.number == 1:
                raise BadName("no name")
            raise ValueError("broken")

        a.subscribe(NEWS, Ping, fail)
        a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number))
        await world.declared()
        b.put(NEWS, Pong(1, "x"))  # unknown fields are ignored
        b._transport.put(NEWS, b"no JSON", Ping)
        b.put(NEWS, Ping(2))
        await until(lambda: len(heard) == 2)
        assert heard == [1, 2]

    with caplog.at_level(logging.WARNING):
        play(story)
    texts = [record.getMessage() for record in caplog.records if record.name.startswith("zscout")]
    assert len(texts) == 3
    assert "no name" in texts[0]
    assert "not a valid Ping" in texts[1]
    assert texts[2] == "a handler failed"


def test_publications_beyond_a_full_queue_are_counted_as_missed(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        heard: list[int] = []
        subscription = a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number), depth=3)
        await world.declared()
        for number in range(10):
            b.put(NEWS, Ping(number))
        await world.occupied(lambda: subscription.missed == 7)
        await until(lambda: heard)
        assert heard == [0, 1, 2]
        assert subscription.missed == 7

    play(story)


def test_poll_latest_keeps_the_latest(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        polled = a.poll_latest(NEWS, Ping, depth=3)
        heard: list[int] = []
        a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number))
        await world.declared()
        for number in range(5):
            b.put(NEWS, Ping(number))
        b._transport.put(NEWS, b"no JSON", Ping)
        b.put(NEWS, Ping(6))
        await until(lambda: 6 in heard)
        await until(lambda: list(polled.each()) == [(NEWS, Ping(4)), (NEWS, Ping(6))])
        assert polled.take() == []
        polled.close()

    play(story)


def test_after_burst_waits_for_all_that_arrived_together(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        events: list[str] = []

        def handle(_: str, ping: Ping) -> None:
            events.append(f"handled {ping.number}")
            if ping.number == 0:
                a.after_burst(lambda: events.append("burst over"))

        a.subscribe(NEWS, Ping, handle)
        await world.declared()
        a.after_burst(lambda: events.append("at once"))
        assert events == ["at once"]
        for number in range(3):
            b.put(NEWS, Ping(number))
        await world.occupied(lambda: len(a._inbox.items) == 3)
        await until(lambda: len(events) == 5)
        assert events == ["at once", "handled 0", "handled 1", "handled 2", "burst over"]

    play(story)


# Frames


def test_the_newest_frame_is_taken_and_its_publisher_knows_of_subscribers(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        publisher = b.frame_publisher(FRAMES)
        changes: list[bool] = []
        publisher.follow(changes.append)
        assert changes == []
        assert not publisher.watched
        with a.frames("test/*") as watch:
            await until(lambda: publisher.watched)
            sent = itertools.count()

            def publish(until: Callable[[], object]) -> bool:  # again: a frame that would have to wait is dropped
                number = next(sent)
                publisher.put(FrameHead(number=number, time=0, width=1, height=1), b"jpeg %d" % number)
                return bool(until())

            await until(lambda: publish(lambda: watch.missed >= 2))
            frame = watch.take()
            assert frame is not None
            assert frame.head.number >= 2
            assert (frame.key, frame.jpeg) == (FRAMES, b"jpeg %d" % frame.head.number)
            assert frame.arrived <= a.now()
            waiting = asyncio.create_task(watch.next(LONG))
            await until(lambda: publish(waiting.done))
            assert waiting.result() is not None
            raw = b._transport.publisher(FRAMES, None, Quality.FRAME)

            def publish_malformed() -> bool:
                raw.put(b"no head")
                watch.take()
                return watch.malformed > 0

            await until(publish_malformed)
        with a.frames("test/idle") as idle:
            assert await idle.next(0.01) is None
        await until(lambda: not publisher.watched)
        assert changes == [True, False]
        with pytest.raises(ValueError, match="too large"):
            publisher.put(FrameHead(number=1, time=0, width=1, height=1), b"x" * (MAX_FRAME + 1))
        publisher.close()

    play(story)


# Liveliness


def token(host: str, name: str = "one", instance: str = "i") -> Token:
    return Token(host, Role.CLIENT, name, instance)


def test_tokens_live_from_before_and_die_with_their_declaration_or_process(play: Play) -> None:
    async def story(world: World) -> None:
        a, b, c = await world.open("a", "b", "c")
        kept = [b.alive(token("b"))]
        declared = c.alive(token("c", "early"))
        await world.declared()
        seen: list[tuple[str, bool]] = []
        key = a.keys.alive_any(Role.CLIENT)
        a.watch(key, lambda token, alive: seen.append((token.name, alive)))
        kept.append(a.alive(token("a", "own")))
        await until(lambda: len(seen) == 3)
        assert sorted(seen) == [("early", True), ("one", True), ("own", True)]
        kept.append(c.alive(token("c", "late")))
        await until(lambda: len(seen) == 4)
        assert seen[3:] == [("late", True)]
        assert await a.living(key, timeout=LONG) == [
            token("a", "own"),
            token("b"),
            token("c", "early"),
            token("c", "late"),
        ]
        declared.close()
        await until(lambda: len(seen) == 5)
        assert seen[4:] == [("early", False)]
        await b.close()
        await until(lambda: len(seen) == 6)
        assert seen[5:] == [("one", False)]
        assert await a.living(key, timeout=LONG) == [token("a", "own"), token("c", "late")]

    play(story)


def test_two_holders_of_one_token_hide_each_others_death(play: Play) -> None:
    async def story(world: World) -> None:
        a, b, c = await world.open("a", "b", "c")
        one, other = b.alive(token("x")), c.alive(token("x"))
        await world.declared()
        seen: list[tuple[str, bool]] = []
        a.watch(a.keys.alive_any(Role.CLIENT), lambda token, alive: seen.append((token.host, alive)))
        await until(lambda: seen)
        one.close()
        another = b.alive(token("b"))
        await until(lambda: ("b", True) in seen)
        assert seen == [("x", True), ("b", True)]
        other.close()
        await until(lambda: len(seen) == 3)
        assert seen[2] == ("x", False)
        del another  # a token that nobody keeps dies at once
        await until(lambda: len(seen) == 4)
        assert seen[3] == ("b", False)

    play(story)


def test_a_token_with_a_bad_name_is_ignored(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        kept = b._transport.token(f"{b.keys.base}/alive/b/client/short")
        seen: list[str] = []
        a.watch(f"{a.keys.base}/alive/**", lambda token, _: seen.append(token.name))
        good = b.alive(token("b"))
        await until(lambda: seen)
        assert seen == ["one"]
        kept()
        good.close()

    play(story)


def test_neither_a_death_nor_the_end_of_a_query_is_lost_where_the_inbox_is_full(
    play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "INBOX_DEPTH", 3)

    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        news = a.subscribe(NEWS, Ping, lambda *_: None)
        seen: list[bool] = []
        held = b.alive(token("b"))
        a.watch(a.keys.alive_any(Role.CLIENT), lambda _, alive: seen.append(alive))
        b.serve(ASK, Ping, lambda _: None)
        await world.declared()
        await until(lambda: seen == [True])
        outcomes: list[object] = []
        for number in range(10):
            b.put(NEWS, Ping(number))
        a.ask_then(ASK, Ping(), Pong, outcomes.append, timeout=LONG)
        a.ask_then("test/nobody", Ping(), Pong, outcomes.append, timeout=LONG)
        held.close()
        await world.occupied(lambda: news.missed >= 7)
        await until(lambda: seen == [True, False])
        await until(lambda: len(outcomes) == 2)

    play(story)


def test_what_waits_for_a_watch_that_is_closed_is_not_handled(play: Play) -> None:
    async def story(world: World) -> None:
        a, b = await world.open("a", "b")
        closed: list[Token] = []
        open_: list[Token] = []
        key = a.keys.alive_any(Role.CLIENT)
        watch = a.watch(key, lambda token, _: closed.append(token))
        a.watch(key, lambda token, _: open_.append(token))
        await world.declared()
        declared = b.alive(token("b")), b.alive(token("b", "two"))
        await world.occupied(lambda: len(a._inbox.items) == 4)
        watch.close()
        await until(lambda: len(open_) == 2)
        assert closed == []
        del declared

    play(story)


def test_what_waits_for_a_mesh_that_is_closed_is_not_handled(play: Play) -> None:
    async def story(world: World) -> None:
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

    play(story)


def test_nothing_is_handled_after_the_mesh_is_closed(play: Play) -> None:
    async def story(world: World) -> None:
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
        assert await b.ask(ASK, Ping(), Pong, timeout=LONG) == []
        assert handled == []
        a.put(NEWS, Ping())
        late.close()

    play(story)
