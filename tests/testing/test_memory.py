"""The network in memory fails to order: what is delayed, lost, cut off or frozen, and what returns. And virtual time
jumps when nothing is left to do, and never past what is under way."""

from __future__ import annotations

import asyncio
import time

import pytest

from tests.mesh.kit import run, until
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import IncomingQuery
from zscout.messages import Message
from zscout.testing.memory import MemoryMesh, MemoryNetwork
from zscout.testing.virtual_time import START, Deadlock
from zscout.types import SECOND

ASK, NEWS = "test/ask", "test/news"
LONG = 100.0
"""Seconds: a timeout that nothing should reach."""


class Ping(Message, frozen=True):
    number: int = 0


class Pair:
    """Two processes: `a` subscribes, watches and asks; `b` publishes, lives and serves."""

    def __init__(self, network: MemoryNetwork) -> None:
        self.network = network
        self.a, self.b = (network.open("test", Sender(name, "test")) for name in "ab")
        self.heard: list[int] = []
        self.lives: list[bool] = []
        self.served: list[int] = []
        self.a.subscribe(NEWS, Ping, lambda _, ping: self.heard.append(ping.number))
        self.a.watch(self.a.keys.alive_any(), lambda _, alive: self.lives.append(alive))
        self.b.serve(ASK, Ping, self.serve)
        self.token = self.b.alive(Token("b", Role.NODE, "b", "i"))

    def serve(self, query: IncomingQuery[Ping]) -> None:
        self.served.append(query.message.number)
        query.answer(query.message)

    async def ask(self, number: int = 0, timeout: float = LONG) -> tuple[list[int], float]:
        """What was replied, and after how many seconds."""
        before = self.a.now()
        replies = await self.a.ask(ASK, Ping(number), Ping, timeout=timeout)
        took = round((self.a.now() - before) / SECOND, 2)
        return [reply.message.number for reply in replies if reply.message], took


async def linked(seed: int = 0) -> Pair:
    pair = Pair(MemoryNetwork(seed=seed))
    await until(lambda: pair.lives == [True])
    return pair


async def test_each_direction_has_its_delay() -> None:
    pair = await linked()
    pair.network.link(pair.a, pair.b).delay = 2.0
    pair.network.link(pair.b, pair.a).delay = 3.0
    assert await pair.ask(7) == ([7], 5.0)


async def test_jitter_keeps_the_order() -> None:
    pair = await linked()
    pair.network.link(pair.b, pair.a).jitter = 1.0
    for number in range(50):
        pair.b.put(NEWS, Ping(number))
        await asyncio.sleep(0.01)
    await until(lambda: len(pair.heard) == 50)
    assert pair.heard == list(range(50))


def test_losses_are_those_of_the_seed() -> None:
    async def heard(seed: int) -> list[int]:
        pair = await linked(seed)
        pair.network.link(pair.b, pair.a).loss = 0.5
        for number in range(40):
            pair.b.put(NEWS, Ping(number))
        await asyncio.sleep(1)
        return pair.heard

    first, again, other = (run(heard(seed)) for seed in (1, 1, 2))
    assert 5 < len(first) < 35
    assert first == again != other


async def test_a_query_that_is_lost_is_over_at_its_timeout() -> None:
    pair = await linked()
    pair.network.link(pair.a, pair.b).loss = 1.0
    assert (await pair.ask(timeout=2), pair.served) == (([], 2.0), [])


async def test_what_is_cut_for_less_than_the_lease_arrives_late() -> None:
    pair = await linked()
    pair.network.cut(pair.b, pair.a)
    pair.b.put(NEWS, Ping(1))
    asking = asyncio.create_task(pair.ask(2))
    await asyncio.sleep(0.9)
    assert pair.heard == []
    assert pair.served == [2]  # the other direction works
    pair.network.heal()
    assert (await asking, pair.heard, pair.lives) == (([2], 0.9), [1], [True])


async def test_a_link_that_is_cut_for_a_lease_is_given_up_until_it_is_healed() -> None:
    pair = await linked()
    pair.network.cut(pair.b, pair.a)
    pair.b.put(NEWS, Ping(1))
    assert (await pair.ask(2), pair.lives, pair.a.links()) == (([], 1.0), [True, False], 0)
    assert await pair.ask(3) == ([], 0)
    pair.network.heal()
    await until(lambda: pair.lives == [True, False, True])
    assert (await pair.ask(4), pair.served, pair.heard) == (([4], 0.0), [2, 4], [])
    pair.b.put(NEWS, Ping(5))
    await until(lambda: pair.heard == [5])


async def test_isolated_is_cut_from_all() -> None:
    pair = await linked()
    c = pair.network.open("test", Sender("c", "test"))
    pair.network.isolate(pair.b)
    await asyncio.sleep(1.1)
    assert (pair.a.links(), pair.b.links(), c.links()) == (1, 0, 1)
    pair.network.heal()
    assert (pair.a.links(), pair.b.links(), c.links()) == (2, 2, 2)


async def test_a_server_frozen_for_less_than_its_lease_carries_out_what_waited() -> None:
    pair = await linked()
    pair.network.freeze(pair.b)
    assert (await pair.ask(1, timeout=0.5), pair.served) == (([], 0.5), [])
    pair.network.thaw(pair.b)
    await until(lambda: pair.served == [1])
    assert pair.lives == [True]


async def test_one_frozen_for_longer_is_given_up_and_returns() -> None:
    pair = await linked()
    seen: list[tuple[str, bool]] = []
    token = pair.a.alive(Token("a", Role.NODE, "a", "i"))
    pair.b.watch(pair.b.keys.alive_any(), lambda token, alive: seen.append((token.host, alive)))
    await until(lambda: len(seen) == 2)
    pair.network.freeze(pair.b)
    assert await pair.ask(1) == ([], 1.0)
    await until(lambda: pair.lives == [True, True, False])  # its own, too
    assert len(seen) == 2  # who is frozen sees nothing
    pair.network.thaw(pair.b)
    await until(lambda: pair.lives == [True, True, False, True])
    await until(lambda: len(seen) == 4)
    assert (seen[2:], (await pair.ask(2))[0]) == ([("a", False), ("a", True)], [2])
    token.close()


async def test_one_that_stood_still_as_another_left_sees_that() -> None:
    pair = await linked()
    pair.network.freeze(pair.a)
    await asyncio.sleep(1.1)
    await pair.b.close()
    pair.network.thaw(pair.a)
    await until(lambda: pair.lives == [True, False])


async def test_of_what_one_that_is_killed_sent_last_a_beginning_arrives() -> None:
    arrived: set[int] = set()
    for seed in range(20):
        pair = await linked(seed)
        pair.b.put(NEWS, Ping(0))
        await asyncio.sleep(1)
        for number in (1, 2):
            pair.b.put(NEWS, Ping(number))
        asking = asyncio.create_task(pair.ask(3))
        await asyncio.sleep(0)
        pair.network.kill(pair.b)
        assert (await asking, pair.lives) == (([], 0.0), [True, False])
        assert (pair.heard, pair.served) == ([0, 1, 2][: len(pair.heard)], [])
        arrived.add(len(pair.heard))
        pair.b.put(NEWS, Ping(4))
        await asyncio.sleep(1)
        assert 4 not in pair.heard
    assert arrived == {1, 2, 3}


async def test_one_may_be_killed_as_it_sends() -> None:
    pair = await linked()
    pair.network.after_sending(pair.b, ASK, lambda _: pair.network.kill(pair.b))
    pair.b.put(NEWS, Ping(1))
    await asyncio.sleep(1)
    assert (pair.heard, pair.lives) == ([1], [True])
    assert (await pair.ask(2))[1] == 0.0
    assert (pair.served, pair.lives) == ([2], [True, False])


async def test_what_arrives_of_one_that_has_gone_leaves_no_link_with_it() -> None:
    pair = await linked()
    pair.network.link(pair.b, pair.a).delay = 0.5
    other = pair.network.open("test", Sender("c", "test"))
    before = len(pair.network.links)
    pair.b.put(NEWS, Ping(1))
    await pair.b.close()
    await other.close()
    await until(lambda: pair.heard == [1])
    assert (before, len(pair.network.links)) == (9, 1)


def test_the_same_seed_makes_the_same_run() -> None:
    async def trace() -> list[tuple[int, str, int]]:
        events: list[tuple[int, str, int]] = []
        network = MemoryNetwork(seed=5)
        meshes = [network.open("test", Sender(f"h{number}", "test")) for number in range(6)]

        def listen(mesh: MemoryMesh) -> None:
            mesh.subscribe(NEWS, Ping, lambda _, ping: events.append((mesh.now(), mesh.me.host, ping.number)))

        for mesh in meshes:
            listen(mesh)
            for other in meshes:
                network.link(mesh, other).jitter = 0.5
        for number, mesh in enumerate(meshes):
            mesh.put(NEWS, Ping(number))
        await asyncio.sleep(2)
        return events

    first, again = run(trace()), run(trace())
    assert (len(first), first) == (36, again)


# Virtual time


def test_hours_pass_at_once_and_in_order() -> None:
    async def story() -> list[tuple[str, float]]:
        loop = asyncio.get_running_loop()
        seen: list[tuple[str, float]] = []

        async def sleeper(name: str, delay: float) -> None:
            await asyncio.sleep(delay)
            seen.append((name, loop.time() - START))

        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(sleeper("late", 7_200))
            tasks.create_task(sleeper("early", 3_600.5))
            tasks.create_task(sleeper("day", 100_000))
        return seen

    before, seen = time.monotonic(), run(story())
    assert time.monotonic() - before < 60
    assert seen == [("early", 3_600.5), ("late", 7_200), ("day", 100_000)]


def test_a_timeout_comes_at_its_time() -> None:
    async def story() -> float:
        loop = asyncio.get_running_loop()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.25):
                await asyncio.Event().wait()
        return loop.time()

    assert run(story()) == START + 0.25


def test_time_stands_still_while_a_thread_works() -> None:
    async def story() -> float:
        loop = asyncio.get_running_loop()
        timer = loop.call_later(1, lambda: None)
        await asyncio.to_thread(time.sleep, 0.02)
        timer.cancel()
        return loop.time()

    assert run(story()) == START


def test_waiting_for_nothing_is_an_error_rather_than_a_hang() -> None:
    with pytest.raises(Deadlock):
        run(asyncio.Event().wait())
