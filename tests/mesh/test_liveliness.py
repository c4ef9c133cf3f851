"""Liveliness: what services may rely on, held against both meshes."""

from __future__ import annotations

import pytest

from tests.mesh.both_meshes import ASK, LONG, NEWS, Ping, Pong, World, token
from tests.mesh.kit import until
from zscout.keyexpr import Role, Token
from zscout.mesh import session


async def test_tokens_live_from_before_and_die_with_their_declaration_or_process(world: World) -> None:
    a, b, c = await world.open("a", "b", "c")
    kept, declared = [b.alive(token("b"))], c.alive(token("c", "early"))
    await world.declared()
    seen: list[tuple[str, bool]] = []
    key = a.keys.alive_any(Role.CLIENT)
    a.watch(key, lambda token, alive: seen.append((token.name, alive)))
    kept.append(a.alive(token("a", "own")))
    await until(lambda: len(seen) == 3)
    assert sorted(seen) == [("early", True), ("one", True), ("own", True)]
    kept.append(c.alive(token("c", "late")))
    await until(lambda: seen[3:] == [("late", True)])
    assert await a.living(key, timeout=LONG) == [token("a", "own"), token("b"), token("c", "early"), token("c", "late")]
    declared.close()
    await until(lambda: seen[4:] == [("early", False)])
    await b.close()
    await until(lambda: seen[5:] == [("one", False)])
    assert await a.living(key, timeout=LONG) == [token("a", "own"), token("c", "late")]


async def test_two_holders_of_one_token_hide_each_others_death(world: World) -> None:
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
    await until(lambda: seen[2:] == [("x", False)])
    del another  # a token that nobody keeps dies at once
    await until(lambda: seen[3:] == [("b", False)])


async def test_a_token_with_a_bad_name_is_ignored(world: World) -> None:
    a, b = await world.open("a", "b")
    kept = b._transport.token(f"{b.keys.base}/alive/b/client/short")
    seen: list[str] = []
    a.watch(f"{a.keys.base}/alive/**", lambda token, _: seen.append(token.name))
    good = b.alive(token("b"))
    await until(lambda: seen)
    assert seen == ["one"]
    kept()
    good.close()


async def test_neither_a_death_nor_the_end_of_a_query_is_lost_where_the_inbox_is_full(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "INBOX_DEPTH", 3)

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


async def test_what_waits_for_a_watch_that_is_closed_is_not_handled(world: World) -> None:
    a, b = await world.open("a", "b")
    closed, open_ = list[Token](), list[Token]()
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
