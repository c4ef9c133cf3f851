"""A process that stood still knows it, and for how long."""

from __future__ import annotations

import asyncio

import pytest

from zscout.mesh.supervision import AFTERMATH, StallWatch
from zscout.testing.virtual_time import VirtualTimeLoop
from zscout.types import SECOND, Ns


def _loop() -> VirtualTimeLoop:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualTimeLoop)
    return loop


def _now() -> Ns:
    return round(_loop().time() * SECOND)


async def test_a_stall_is_measured_and_soon_over() -> None:
    watch = StallWatch(_now).start()
    await asyncio.sleep(10.05)
    assert not watch.fresh()
    assert watch.waited_through(_now()) == 0
    _loop().jump(3.0)  # nothing runs meanwhile
    assert watch.fresh()
    arrived = _now()
    assert watch.waited_through(arrived) == pytest.approx(2.8 * SECOND, rel=0.001)
    await asyncio.sleep(AFTERMATH / SECOND + 0.01)
    assert not watch.fresh()
    assert watch.waited_through(_now()) == 0
    assert watch.waited_through(arrived) > 0
    watch.stop()


async def test_a_short_delay_is_no_stall() -> None:
    watch = StallWatch(_now).start()
    await asyncio.sleep(1)
    _loop().jump(0.35)
    assert not watch.fresh()
    watch.stop()
