"""Trees of behaviors under a supervisor: what fails beside a body fails it; clocks go along with a move."""

from __future__ import annotations

import asyncio

import pytest

from zscout.behaviors.tree import CarriedClock
from zscout.mesh.supervision import supervised
from zscout.types import SECOND


async def test_what_fails_beside_a_body_fails_the_body() -> None:
    async def broken() -> None:
        await asyncio.sleep(1)
        raise RuntimeError("broken")

    async def body() -> None:
        async with supervised("tree") as supervisor:
            supervisor.spawn(broken())
            await asyncio.sleep(3600)

    with pytest.raises(RuntimeError, match="broken"):
        await body()


async def test_a_body_that_is_cancelled_from_outside_stays_so() -> None:
    async def body(ended: list[str]) -> None:
        async def work() -> None:
            try:
                await asyncio.sleep(3600)
            finally:
                ended.append("work")

        async with supervised("tree") as supervisor:
            supervisor.spawn(work())
            await asyncio.sleep(3600)

    ended: list[str] = []
    task = asyncio.create_task(body(ended))
    await asyncio.sleep(1)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert ended == ["work"]


def test_a_clock_goes_on_at_another_host_where_it_was() -> None:
    here, there = CarriedClock(), CarriedClock()
    readings = [here.read(at * SECOND, 2.0) for at in (1000, 1003)]
    there.seconds = here.seconds
    readings += [there.read(at * SECOND, 2.0) for at in (5, 6)]
    assert readings == [0.0, 6.0, 6.0, 8.0]
