"""What arrives on other threads is handled in the event loop: bounded, in order, in bursts."""

from __future__ import annotations

import asyncio
import threading

import pytest

from tests.mesh.kit import run, until
from zscout.mesh import session
from zscout.mesh.exchange import Backlog, Refused
from zscout.mesh.session import BURST, Inbox


@pytest.mark.real_time
async def test_items_of_several_threads_are_handled_in_the_order_of_each() -> None:
    box = Inbox(asyncio.get_running_loop())
    handled: list[tuple[int, int]] = []
    states = [Backlog(depth=10_000) for _ in range(4)]

    def produce(thread: int) -> None:
        for number in range(1_000):
            assert box.offer(states[thread], lambda *item: handled.append(item), thread, number)

    threads = [threading.Thread(target=produce, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    await until(lambda: len(handled) == 4_000)
    for thread in threads:
        thread.join()
    for producer in range(4):
        assert [number for of, number in handled if of == producer] == list(range(1_000))
    assert [state.pending for state in states] == [0] * 4


async def test_others_have_their_turn_between_two_bursts() -> None:
    box = Inbox(asyncio.get_running_loop())
    handled: list[int] = []
    for number in range(2 * BURST):
        box.deliver(handled.append, number)
    await asyncio.sleep(0)
    assert len(handled) == BURST
    await until(lambda: len(handled) == 2 * BURST)


async def test_each_declaration_and_the_inbox_have_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "INBOX_DEPTH", 5)

    box = Inbox(asyncio.get_running_loop())
    handled: list[int] = []
    small, large = Backlog(depth=2), Backlog()
    assert [box.offer(small, handled.append, number) for number in range(3)] == [True, True, False]
    assert [box.offer(large, handled.append, number) for number in range(10, 14)] == [True] * 3 + [False]
    box.deliver(handled.append, 99)
    await until(lambda: 99 in handled)
    assert handled == [0, 1, 10, 11, 12, 99]
    assert box.offer(small, handled.append, 3)


async def test_a_handler_that_fails_stops_nothing(caplog: pytest.LogCaptureFixture) -> None:
    box = Inbox(asyncio.get_running_loop())
    handled: list[str] = []

    def fail(error: Exception) -> None:
        assert box.after is not None
        box.after.append(lambda: handled.append("after"))
        raise error

    box.deliver(fail, ValueError("broken"))
    box.deliver(fail, Refused("internal", "logged elsewhere"))
    box.deliver(handled.append, "next")
    await until(lambda: len(handled) == 3)
    assert handled == ["next", "after", "after"]
    assert [record.getMessage() for record in caplog.records] == ["a handler failed"]


def test_nothing_is_taken_once_it_is_closed_or_its_loop_has_ended() -> None:
    async def story() -> Inbox:
        box = Inbox(asyncio.get_running_loop())
        handled: list[int] = []
        box.deliver(handled.append, 1)
        box.close()
        assert not box.offer(Backlog(), handled.append, 2)
        box.deliver(handled.append, 3)
        await asyncio.sleep(0.01)
        assert handled == []
        return Inbox(asyncio.get_running_loop())

    assert not run(story()).offer(Backlog(), print)
