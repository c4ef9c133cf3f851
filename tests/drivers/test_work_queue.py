"""The order of a resource controller's work: changes of holders, then commands; early ones set aside."""

from __future__ import annotations

import asyncio
from typing import Any, cast

from tests.hang import HANG
from zscout.drivers.holds import HoldChange
from zscout.drivers.work_queue import EARLY_PER_HOST, CommandQuery, WorkQueue


def query(name: str) -> CommandQuery:
    return cast("CommandQuery", name)


def drained(queue: WorkQueue, count: int) -> list[Any]:
    async def take() -> list[Any]:
        return [await asyncio.wait_for(queue.get(), HANG) for _ in range(count)]

    return asyncio.run(take())


def test_changes_go_before_all_commands_and_keep_their_order() -> None:
    queue, first, second = WorkQueue(), HoldChange(stayed=True), HoldChange(reread=True)
    for name in ("a", "b"):
        queue.put_command(query(name))
    queue.put_change(first)
    queue.put_change(second)
    assert drained(queue, 4) == [first, second, "a", "b"]


def test_what_was_set_aside_comes_back_before_other_commands_in_its_order() -> None:
    queue = WorkQueue()
    for name in ("one", "two", "three"):
        assert queue.set_aside(query(name), "host")
    queue.put_command(query("late"))
    assert queue.commands == 4
    queue.resume(lambda command: cast("str", command) != "two")
    assert queue.drop_early() == [query("two")]
    assert queue.commands == 3
    assert drained(queue, 3) == ["one", "three", "late"]


def test_one_host_can_not_fill_what_is_set_aside() -> None:
    queue = WorkQueue()
    assert all(queue.set_aside(query(str(number)), "stranger") for number in range(EARLY_PER_HOST))
    assert not queue.set_aside(query("more"), "stranger")
    assert queue.set_aside(query("mine"), "host")


def test_who_waits_is_woken() -> None:
    async def story() -> None:
        queue = WorkQueue()
        queue.set_aside(query("early"), "host")
        waiting = asyncio.create_task(queue.get())
        await asyncio.sleep(0)
        assert not waiting.done()
        queue.resume(lambda _command: True)
        assert await asyncio.wait_for(waiting, HANG) == query("early")

    asyncio.run(story())
