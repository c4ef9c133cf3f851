"""What arrives on other threads is handled in the event loop: bounded, in order, in bursts."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

from tests.mesh.kit import run, until
from zscout.mesh import session
from zscout.mesh.exchange import Backlog, Refused
from zscout.mesh.session import BURST, BURST_S, SHARE, Inbox, Lane


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


async def test_a_host_s_surplus_waits_for_the_others_and_questions_wait_for_asks() -> None:
    box, handled = Inbox(asyncio.get_running_loop()), list[str]()

    def offer(text: str, lane: Lane, host: str) -> None:
        assert box.offer(Backlog(), handled.append, text, lane=lane, host=host)

    for number in range(40):
        offer(f"q{number}", Lane.QUESTION, "viewer")
        offer(f"a{number}", Lane.ASK, "greedy")
    offer("lone", Lane.ASK, "desk")
    box.deliver(handled.append, "token")
    await until(lambda: len(handled) == 82)
    first = [text for number in range(SHARE) for text in (f"q{number}", f"a{number}")]
    rest = range(SHARE, 40)
    assert handled == [*first, "lone", "token", *(f"a{number}" for number in rest), *(f"q{number}" for number in rest)]
    assert (box.set_aside, box.surplus) == (0, {})


async def test_what_concerns_a_host_with_surplus_may_wait_behind_it() -> None:
    box, handled = Inbox(asyncio.get_running_loop()), list[str]()

    def cancel() -> None:
        assert box.behind(Lane.ASK, "greedy", handled.append, "cancel")
        assert not box.behind(Lane.ASK, "desk", handled.append, "never")

    for number in range(SHARE + 2):
        box.offer(Backlog(), handled.append, f"a{number}", lane=Lane.ASK, host="greedy")
    box.offer(Backlog(), cancel, lane=Lane.ASK, host="boss")
    await until(lambda: "cancel" in handled)
    assert handled == [*(f"a{number}" for number in range(SHARE + 2)), "cancel"]


async def test_what_waits_behind_a_host_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "QUEUE_DEPTH", 8)
    box, handled = Inbox(asyncio.get_running_loop()), list[str]()

    def dry_runs() -> None:
        for number in range(4):
            assert box.behind(Lane.QUESTION, "viewer", handled.append, f"q{number}")
        with pytest.raises(Refused, match="too many requests of viewer are waiting here"):
            box.behind(Lane.QUESTION, "viewer", handled.append, "q4")

    box.deliver(dry_runs)
    box.deliver(handled.append, "next")
    await until(lambda: len(handled) == 5)
    assert handled == ["next", "q0", "q1", "q2", "q3"]


async def test_of_questions_one_of_each_host_is_let_in_before_asks_that_have_come_meanwhile() -> None:
    box, handled = Inbox(asyncio.get_running_loop()), list[str]()

    def dry_run(text: str) -> None:
        """It comes as an ask, and turns out to be a question."""
        if not box.behind(Lane.QUESTION, "viewer", answer, text):
            answer(text)

    def answer(text: str) -> None:
        handled.append(text)
        if text == "q1":
            box.offer(Backlog(), handled.append, "ask", lane=Lane.ASK, host="desk")

    for number in range(5):
        box.offer(Backlog(), dry_run, f"q{number}", lane=Lane.ASK, host="viewer")
    await until(lambda: len(handled) == 6)
    assert handled == ["q0", "q1", "ask", "q2", "q3", "q4"]


async def test_of_questions_that_were_set_aside_each_has_a_burst() -> None:
    """What it takes comes after the burst, as a step of the leader; its heartbeats come between two."""
    box, bursts = Inbox(asyncio.get_running_loop()), list[list[str]]()

    def answer(text: str) -> None:
        assert box.after is not None
        if not box.after:
            bursts.append([])
            box.after.append(lambda: None)
        bursts[-1].append(text)

    def concern(text: str) -> None:
        if not box.behind(Lane.QUESTION, "viewer", answer, text):
            answer(text)

    for number in range(4):
        assert box.offer(Backlog(), concern, f"q{number}", host="viewer", lane=Lane.ASK)
    await until(lambda: sum(map(len, bursts)) == 4)
    assert max(map(len, bursts)) <= 2
    assert len(bursts) >= 3


@pytest.mark.real_time
async def test_a_burst_is_short_whatever_its_handlers_do() -> None:
    box, handled = Inbox(asyncio.get_running_loop()), list[int]()

    def work(number: int) -> None:
        time.sleep(BURST_S / 2)
        handled.append(number)

    for number in range(8):
        box.deliver(work, number)
    await asyncio.sleep(0)
    assert 0 < len(handled) < 4
    await until(lambda: len(handled) == 8)


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
