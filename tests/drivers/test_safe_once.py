"""How often a device is made safe for the end of one hold, though that takes most of the time that it has."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest

from zscout.behaviors.client.arc import Revoked
from zscout.drivers.generic import ExclusiveDriver
from zscout.messages import Holder
from zscout.testing import MemoryFleet, in_virtual_time


class Slow(ExclusiveDriver):
    """An arm that parks for 4.4 s of the 5 s that its RC gives it."""

    def __init__(self) -> None:
        super().__init__()
        self.log: list[str] = []

    async def begin(self, holder: Holder) -> None:
        self.log.append(f"begin {holder.arc}")

    async def safe(self) -> None:
        self.log.append("safe")
        await asyncio.sleep(4.4)


@pytest.mark.parametrize("end", ["release", "preemption", "time"])
@pytest.mark.parametrize("direct", [False, True])
@in_virtual_time
async def test_a_device_is_made_safe_once_for_an_end_and_once_more_after_it_has_settled(direct: bool, end: str) -> None:
    device = Slow()
    async with MemoryFleet({"arm/a": device}) as fleet:

        async def first() -> None:
            with suppress(Revoked):
                keep = end != "time"
                async with fleet.hold("first", {"arm/a": {}}, min_runtime=3, keep=keep, direct=direct, confirmed=True):
                    await asyncio.sleep(1 if end == "release" else 60)

        task = asyncio.create_task(first())
        await asyncio.sleep(0.5)
        async with fleet.hold(
            "next", {"arm/a": {}}, client="next", priority=100 if end == "preemption" else 0, confirmed=True
        ):
            safes = device.log[1:-1]
            assert fleet.rcs["arm/a"].health == "ok"
        await task
    settles = direct and end != "release"
    assert device.log[0] == "begin first"
    assert device.log[len(safes) + 1] == "begin next"
    assert safes == ["safe"] * (2 if settles else 1)
