"""Queries and their replies: what services may rely on, held against both meshes."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable
from typing import Any

import pytest

from tests.mesh.both_meshes import ASK, LONG, SHORT, Ping, Pong, Replies, Strict, World, pong, timed
from tests.mesh.kit import until
from zscout import messages
from zscout.keyexpr import BadName
from zscout.mesh import IncomingQuery, Mesh, MeshError, Refused, Tally
from zscout.mesh.session import MAX_REPLIES_PER_KEY
from zscout.mesh.transport import Collector

PING = Ping()


async def answer(mesh: Mesh, ping: Ping | None = PING, key: str = ASK) -> object:
    """The key and message of a reply, or the code of its problem."""
    reply = await mesh.ask_one(key, ping, Pong, timeout=LONG)
    assert reply is not None
    return reply.problem.code if reply.problem else (reply.key, reply.message)


async def at_once(mesh: Mesh, asked: Awaitable[Any]) -> Any:
    result, took = await timed(mesh, asked)
    assert took < LONG / 2
    return result


async def test_all_who_serve_a_key_reply(world: World) -> None:
    a, b, c = await world.open("a", "b", "c")
    for mesh in (a, b, c):
        mesh.serve(ASK, Ping, pong(mesh))
    await world.declared()
    replies = await a.ask(ASK, Ping(7), Pong, timeout=LONG)
    assert {(reply.key, reply.message) for reply in replies} == {(ASK, Pong(7, host)) for host in ("a", "b", "c")}
    assert all(reply.problem is None for reply in replies)


async def test_two_that_serve_a_key_in_one_process_both_reply(world: World) -> None:
    a, b = await world.open("a", "b")
    b.serve(ASK, Ping, lambda query: query.answer(Pong(1)))
    b.serve("test/*", Ping, lambda query: query.answer(Pong(2)))
    await world.declared()
    replies = await a.ask(ASK, Ping(), Pong, timeout=LONG)
    assert {reply.message.number for reply in replies if reply.message} == {1, 2}


async def test_a_query_that_nobody_serves_or_its_handler_forgets_is_over_at_once(world: World) -> None:
    a, b = await world.open("a", "b")
    assert await at_once(a, a.ask(ASK, Ping(), Pong, timeout=LONG)) == []
    b.serve(ASK, Ping, lambda _: None)
    await world.declared()
    assert await at_once(a, a.ask(ASK, Ping(), Pong, timeout=LONG)) == []


async def test_a_query_that_is_kept_is_over_at_its_timeout(world: World) -> None:
    a, b = await world.open("a", "b")
    kept: list[IncomingQuery[Ping]] = []
    b.serve(ASK, Ping, kept.append)
    await world.declared()
    replies, took = await timed(a, a.ask(ASK, Ping(), Pong, timeout=SHORT))
    assert (replies, len(kept)) == ([], 1)
    assert took >= SHORT * 0.99
    kept[0].answer(Pong(1))  # too late, and no harm


async def test_a_query_may_be_answered_later_and_once(world: World) -> None:
    a, b = await world.open("a", "b")
    kept: list[IncomingQuery[Ping]] = []
    b.serve(ASK, Ping, kept.append)
    await world.declared()
    asking = asyncio.create_task(a.ask(ASK, Ping(3), Pong, timeout=LONG))
    await until(lambda: kept)
    kept[0].answer(Pong(kept[0].message.number))
    kept[0].answer(Pong(99))
    kept[0].refuse(messages.Problem("late", "late"))
    assert ([reply.message for reply in await asking], kept[0].key) == ([Pong(3)], ASK)


async def test_a_query_is_over_when_the_process_that_keeps_it_leaves(world: World) -> None:
    a, b = await world.open("a", "b")
    kept: list[IncomingQuery[Ping]] = []
    b.serve(ASK, Ping, kept.append)
    await world.declared()
    asking = asyncio.create_task(at_once(a, a.ask(ASK, Ping(), Pong, timeout=LONG)))
    await until(lambda: kept)
    await b.close()
    assert await asking == []


@pytest.mark.parametrize(
    ("error", "code"),
    [(Refused("not_yet", "wait"), "not_yet"), (BadName("no name"), "bad_name"), (ValueError("broken"), "internal")],
)
async def test_what_a_handler_raises_is_replied_as_a_problem(world: World, error: Exception, code: str) -> None:
    a, b = await world.open("a", "b")

    def handle(_: IncomingQuery[Ping]) -> None:
        raise error

    b.serve(ASK, Ping, handle)
    await world.declared()
    assert await answer(a) == code


@pytest.mark.parametrize(
    ("kind", "payload"),
    [
        (Ping, b"no JSON"),
        (Ping, b'{"number": "1"}'),
        (Ping, b'{"number": 1, "text": "' + b"x" * 200 + b'"}'),
        (Strict, b'{"number": 1, "number": 2}'),
    ],
)
async def test_a_malformed_query_never_reaches_its_handler(world: World, kind: type, payload: bytes) -> None:
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
    assert (problem.code, handled) == ("malformed", [])


async def test_a_query_without_a_message_is_an_empty_one(world: World) -> None:
    a, b = await world.open("a", "b")
    b.serve(ASK, Ping, pong(b))
    await world.declared()
    assert await answer(a, None) == (ASK, Pong(0, "b"))


async def test_a_reply_that_is_malformed_or_too_long_is_dropped(world: World, caplog: pytest.LogCaptureFixture) -> None:
    a, b = await world.open("a", "b")
    b.serve(ASK, Ping, lambda query: query.answer(Pong(1, "x" * 200)))
    await world.declared()
    assert await a.ask(ASK, Ping(), Pong, timeout=LONG, limit=100) == []
    assert "malformed" in caplog.text


async def test_a_wildcard_is_answered_where_the_served_key_has_none_and_refused_elsewhere(world: World) -> None:
    a, b = await world.open("a", "b")
    b.serve("test/one", Ping, pong(b))
    b.serve("test/many/*", Ping, pong(b))
    await world.declared()
    for asked, answers in (
        ("test/*", ("test/one", Pong(0, "b"))),
        ("test/many/*", "bad_key"),
        ("test/many/x", ("test/many/x", Pong(0, "b"))),
    ):
        assert await answer(a, key=asked) == answers


async def test_queries_beyond_a_full_queue_are_refused_as_busy(world: World) -> None:
    a, b = await world.open("a", "b")
    tally = Tally()
    b.serve(ASK, Ping, pong(b), depth=2, tally=tally)
    await world.declared()
    outcomes: list[object] = []
    for number in range(10):
        a.ask_then(ASK, Ping(number), Pong, outcomes.append, timeout=LONG)
    await world.occupied(lambda: len(a._inbox.items) == 16)  # a problem and an end each
    await until(lambda: len(outcomes) == 10)
    codes = [reply.problem.code for reply in outcomes if reply.problem]  # type: ignore[attr-defined]
    assert (codes, await answer(a, Ping(1))) == (["busy"] * 8, (ASK, Pong(1, "b")))
    assert (tally.answered, tally.refused()) == (3, {"busy": 8})


async def test_one_host_fills_half_a_queue_at_most_and_is_refused_undecoded(world: World) -> None:
    a, b = await world.open("a", "b")
    b.serve("test/ask/*/*", Ping, pong(b), depth=4)
    await world.declared()
    outcomes: list[object] = []
    for number in range(10):
        a._transport.get(f"test/ask/one/{number}", b"no JSON", Ping, LONG, Replies())
    for number in range(2):
        a.ask_then(f"test/ask/two/{number}", Ping(number), Pong, outcomes.append, timeout=LONG)
    await world.occupied(lambda: len(b._inbox.items) == 4)
    await until(lambda: len(outcomes) == 2)
    assert all(reply.message is not None for reply in outcomes)  # type: ignore[attr-defined]
    assert await answer(a, Ping(7), "test/ask/one/x") == ("test/ask/one/x", Pong(7, "b"))


async def test_one_host_has_half_of_what_may_be_unanswered(world: World) -> None:
    """Who asks much of what takes long leaves room for others."""
    a, b = await world.open("a", "b")
    kept: list[IncomingQuery[Ping]] = []
    b.serve("test/ask/*/*", Ping, kept.append, unanswered=4)
    await world.declared()
    outcomes: list[tuple[str, object]] = []

    def ask(key: str) -> None:
        a.ask_then(f"test/ask/{key}", PING, Pong, lambda reply: outcomes.append((key, reply)), timeout=LONG)

    for number in range(5):
        ask(f"one/{number}")
    await until(lambda: len(outcomes) == 3)
    assert [reply.problem.code for _, reply in outcomes if reply.problem] == ["busy"] * 3  # type: ignore[attr-defined]
    for key in ("two/1", "two/2", "three/1"):
        ask(key)
    await until(lambda: len(outcomes) == 4)
    assert outcomes[3][0] == "three/1"
    kept[0].answer(Pong(1))
    kept[1].drop()
    await until(lambda: len(outcomes) == 6)
    ask("one/again")
    await until(lambda: len(kept) == 5)


async def test_of_the_answers_of_one_key_the_first_are_read(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever is asked may answer as often as it likes, and reading takes the time of who asks."""
    (a,), keys = await world.open("a"), ("test/one", "test/two")

    def get(*args: Any) -> None:
        to: Collector = args[-1]
        for number in range(20):
            for key in keys:
                to.on_reply(key, messages.encode(Pong(number)), True)
        to.on_final()

    monkeypatch.setattr(a._transport, "get", get)
    replies = await a.ask("test/*", PING, Pong, timeout=LONG)
    assert Counter(reply.key for reply in replies) == dict.fromkeys(keys, MAX_REPLIES_PER_KEY)


async def test_ask_ends_with_the_reply_that_is_enough(world: World) -> None:
    a, b, c = await world.open("a", "b", "c")
    kept: list[IncomingQuery[Ping]] = []
    b.serve(ASK, Ping, pong(b))
    c.serve(ASK, Ping, kept.append)
    await world.declared()
    asked = a.ask(ASK, Ping(), Pong, timeout=LONG, enough=lambda reply: reply.message == Pong(0, "b"))
    assert [reply.message for reply in await at_once(a, asked)] == [Pong(0, "b")]


async def test_ask_then_calls_back_once(world: World) -> None:
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


async def test_what_cannot_be_asked_raises(world: World) -> None:
    a, _ = await world.open("a", "b")
    with pytest.raises(MeshError, match="no//key"):
        await a.ask("no//key", Ping(), Pong, timeout=LONG)
    await a.close()
    with pytest.raises(MeshError):
        await a.ask(ASK, Ping(), Pong, timeout=LONG)


async def test_what_is_undeclared_is_not_asked(world: World) -> None:
    a, b = await world.open("a", "b")
    served = b.serve(ASK, Ping, pong(b))
    await world.declared()
    assert len(await a.ask(ASK, Ping(), Pong, timeout=LONG)) == 1
    served.close()
    served.close()
    assert await a.ask(ASK, Ping(), Pong, timeout=LONG) == []
