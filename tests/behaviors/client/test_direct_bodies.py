"""Bodies that touch devices past their RCs, in virtual time: what they clear up with, and for how long, when their hold
is taken away, and that the next holder waits for it."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tests.behaviors.client.small_fleet import FLEET, RC, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import Revoked, hold, holds
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.direct import DEFAULT_SETTLE, DirectHold
from zscout.types import SECOND

PARKS = 3.0
"""Seconds that a body clears up."""


def direct_of(client: Client) -> list[DirectHold]:
    return list(client._confirmations._direct.values())


async def park(client: Client, said: list[str], **how: Any) -> None:
    """A direct body that parks its device when its hold is over."""
    async with hold(client, "low", {RC: {}}, **({"min_runtime": 60, "direct": True} | how)):
        said.append("low in")
        try:
            await asyncio.sleep(3600)
        except asyncio.CancelledError:
            await asyncio.sleep(PARKS / 2)
            raise
        finally:
            await asyncio.sleep(PARKS / 2)
            said.append("low parked")


async def parking(client: Client, **how: Any) -> tuple[asyncio.Task[None], list[str]]:
    """Such a body at work, and what it says."""
    said: list[str] = []
    body = asyncio.create_task(park(client, said, **how))
    await until(lambda: said)
    return body, said


async def test_the_next_holder_waits_until_a_preempted_body_has_cleared_up() -> None:
    async with small_fleet("low", "high") as (_, (low, high)):
        body, said = await parking(low)
        asked = high.mesh.now()
        async with hold(high, "high", {RC: {}}, priority=5, min_runtime=60, confirmed=True):
            said.append("high in")
        with pytest.raises(Revoked):
            await body
        assert said == ["low in", "low parked", "high in"]
        assert PARKS <= (high.mesh.now() - asked) / SECOND < PARKS + 0.5


async def test_a_body_that_clears_up_for_too_long_is_interrupted_before_the_next_holder_begins() -> None:
    async with small_fleet("low", "high") as (_, (low, high)):
        said: list[str] = []

        async def never_parks() -> None:
            async with hold(low, "low", {RC: {}}, min_runtime=60, direct=True):
                said.append("low in")
                try:
                    await asyncio.sleep(3600)
                finally:
                    try:
                        await asyncio.sleep(3600)
                    finally:
                        said.append("low out")

        body = asyncio.create_task(never_parks())
        await until(lambda: said)
        asked = low.mesh.now()
        taker = await high.request("high", {RC: {}}, priority=5, min_runtime=60)
        await until(lambda: body.done())
        assert 0.8 * DEFAULT_SETTLE < low.mesh.now() - asked < DEFAULT_SETTLE
        assert isinstance(body.exception(), Revoked)
        assert await high.granted(taker, confirmed=True) is not None
        assert said == ["low in", "low out"]


async def test_a_body_that_has_had_its_time_clears_up_before_the_next_one_begins() -> None:
    async with small_fleet("low", "high") as (_, (low, high)):
        body, said = await parking(low, min_runtime=2)
        async with hold(high, "high", {RC: {}}, min_runtime=60, confirmed=True):
            said.append("high in")
        await body
        assert said == ["low in", "low parked", "high in"]


async def test_a_body_that_is_entered_again_has_left_before() -> None:
    async with small_fleet("low", "high") as (_, (low, high)):
        said: list[str] = []

        async def work() -> None:
            async for attempt in holds(low, "low", {RC: {}}, min_runtime=60, direct=True):
                async with attempt as held:
                    said.append("in")
                    try:
                        await asyncio.sleep(1 if len(said) > 1 else 3600)
                    finally:
                        said.append("out")
                        assert held.arc.direct

        body = asyncio.create_task(work())
        await until(lambda: said)
        async with hold(high, "high", {RC: {}}, priority=5, min_runtime=60, confirmed=True):
            assert said == ["in", "out"]
        await body
        assert said == ["in", "out", "in", "out"]


async def test_a_body_that_is_cancelled_from_outside_while_it_clears_up_ends_so() -> None:
    async with small_fleet("low", "high") as (_, (low, high)):
        body, _said = await parking(low)
        taker = await high.request("high", {RC: {}}, priority=5, min_runtime=60)
        await until(lambda: direct_of(low) and all(one.over for one in direct_of(low)))
        await asyncio.sleep(PARKS / 4)
        body.cancel()
        with pytest.raises(asyncio.CancelledError):
            await body
        assert await high.granted(taker, confirmed=True) is not None


async def test_a_client_that_hears_nothing_ends_its_body_after_the_hold_lease() -> None:
    async with small_fleet("low") as (fleet, (low,)):
        body, said = await parking(low)
        fleet.network.link(fleet.devices, low.mesh).loss = 1.0  # the RC's alone: the RCM goes on
        cut = low.mesh.now()
        await until(lambda: "low parked" in said)
        assert (low.mesh.now() - cut) / SECOND - PARKS <= FLEET.timing.hold_lease / SECOND
        body.cancel()


async def test_a_leader_that_begins_as_a_body_clears_up_after_its_time_does_not_queue_it_again() -> None:
    async with small_fleet("one") as (fleet, (one,)):
        told: list[str] = []
        one.watch(lambda arc: told.append(arc.state))
        body, _ = await parking(one, min_runtime=3, keep=False)
        await asyncio.sleep(2.5)
        await fleet.candidates.pop("h0").stop()
        await asyncio.sleep(1)
        fleet.candidate("h1")
        await until(lambda: one.leader == "h1")
        assert not body.done()
        await body
        state = await fleet.state()
        assert (state.queue, state.holds, "queued" in told) == ([], [], False)
