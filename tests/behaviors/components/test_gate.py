"""Safe points: where a component is held, and for how long."""

from __future__ import annotations

import asyncio

from tests.hang import HANG
from zscout.behaviors.components.component import SafePointGate


async def test_who_is_not_wanted_goes_on_and_gives_the_loop_a_turn() -> None:
    gate = SafePointGate()
    turns: list[int] = []
    asyncio.get_running_loop().call_soon(turns.append, 1)
    await gate.come()
    assert turns == [1]
    assert not gate.holds


async def test_who_comes_is_held_until_released() -> None:
    gate, steps = SafePointGate(), 0

    async def run() -> None:
        nonlocal steps
        while True:
            steps += 1
            await gate.come()

    running = asyncio.create_task(run())
    for _ in range(3):
        assert await gate.hold(HANG)
        held = steps
        for _ in range(10):
            await asyncio.sleep(0)
        assert steps == held
        gate.release()
        async with asyncio.timeout(HANG):
            while steps == held:  # noqa: ASYNC110 - the loop has its turns, nothing else
                await asyncio.sleep(0)
    running.cancel()


async def test_who_does_not_come_is_not_held_later() -> None:
    gate = SafePointGate()
    assert not await gate.hold(0.01)
    async with asyncio.timeout(HANG):
        await gate.come()


async def test_who_is_cancelled_at_the_gate_is_not_held_any_more() -> None:
    gate = SafePointGate()
    comes = asyncio.create_task(gate.come())
    held = [await gate.hold(HANG), gate.holds]
    comes.cancel()
    await asyncio.gather(comes, return_exceptions=True)
    held += [gate.holds, await gate.hold(0.01)]
    assert held == [True, True, False, False]
