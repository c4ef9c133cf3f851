"""Virtual time jumps when nothing is left to do, and never past what is under way."""

from __future__ import annotations

import asyncio
import time

import pytest

from tests.mesh.kit import run
from zscout.testing.virtual_time import START, Deadlock


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
