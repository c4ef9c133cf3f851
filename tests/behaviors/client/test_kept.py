"""How long a hold lasts that a program asked for without a word about it, in virtual time."""

from __future__ import annotations

import asyncio
from dataclasses import replace as with_policy

import pytest
from msgspec.structs import replace

from tests.behaviors.client.small_fleet import FLEET, RC, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import Revoked, hold, holds
from zscout.messages import Release
from zscout.types import SECOND

LONG = 150.0
"""Seconds: much longer than any minimum runtime here."""


async def test_it_is_protected_for_the_fleet_s_time_and_goes_on_until_an_equal_waits() -> None:
    async with small_fleet("one", "two", config=replace(FLEET, min_runtime=90 * SECOND)) as (fleet, (one, two)):
        began = one.mesh.now()
        async with hold(one, "first", {RC: {}}) as held:
            assert 89 < held.remaining <= 90
            waits = await two.request("second", {RC: {}})
            await asyncio.sleep(LONG)
        assert held.completed
        assert (held.arc.outcome, (one.mesh.now() - began) // SECOND) == ("completed", 90)
        assert held.arc.ending is not None
        assert held.arc.ending.by == f"h/two/{waits.id}"
        assert await two.granted(waits) is not None
        # Nobody waits: it goes on.
        await asyncio.sleep(LONG)
        assert await fleet.holders() == ["second"]
        third = await one.request("third", {RC: {}})
        assert third.state == "running"


async def test_who_goes_on_asks_anew_behind_those_who_wait() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        entered: list[int] = []

        async def work() -> None:
            async for attempt in holds(one, "work", {RC: {}}):
                async with attempt as held:
                    entered.append((one.mesh.now() - began) // SECOND)
                    if len(entered) < 3:
                        await asyncio.sleep(LONG)
                    assert held.active

        began = one.mesh.now()
        working = asyncio.create_task(work())
        await until(lambda: entered)
        for turn in (1, 2):
            async with hold(two, "other", {RC: {}}):
                assert [*entered, "out"] == [*entered[:turn], "out"]
                await asyncio.sleep(LONG)
            await until(lambda: len(entered) == turn + 1)  # noqa: B023 - awaited here
        await working
        # Turns of a minute each.
        assert (entered, await fleet.holders()) == ([0, 120, 240], [])


async def test_what_others_released_is_not_asked_for_again() -> None:
    async with small_fleet("one", "operator") as (fleet, (one, operator)):
        entered: list[str] = []

        async def work() -> None:
            async for attempt in holds(one, "work", {RC: {}}, min_runtime=1):
                async with attempt as held:
                    entered.append(held.arc.id)
                    await asyncio.sleep(LONG)

        working = asyncio.create_task(work())
        await until(lambda: entered)
        await asyncio.sleep(5)
        await operator._rcm.query(Release(id=entered[0], client=str(one.mesh.me)))
        await working
        assert (len(entered), await fleet.holders()) == (1, [])


@pytest.mark.parametrize("keep", [True, False])
async def test_the_fleet_s_longest_time_ends_it(*, keep: bool) -> None:
    policy = with_policy(FLEET.scheduling, max_runtime=100 * SECOND)
    async with small_fleet("one", config=replace(FLEET, scheduling=policy)) as (fleet, (one,)):
        began = one.mesh.now()
        async with hold(one, "first", {RC: {}}, keep=keep, min_runtime=None if keep else LONG) as held:
            assert held.remaining < 101
            await asyncio.sleep(LONG)
        assert (held.completed, (one.mesh.now() - began) // SECOND) == (True, 100)
        assert await fleet.holders() == []


async def test_a_grant_is_waited_for_at_most_so_long() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        async with hold(one, "first", {RC: {}}):
            with pytest.raises(TimeoutError, match=r"second was not granted within 30 s: waits for h/one"):
                await hold(two, "second", {RC: {}}, timeout=30).granted()
            state = await fleet.state()
            assert not state.queue
        # The time is for the wait alone.
        async with hold(two, "second", {RC: {}}, timeout=30) as held:
            await asyncio.sleep(LONG)
            assert held.active


async def test_within_its_time_a_higher_priority_takes_it_and_says_so() -> None:
    async with small_fleet("low", "high") as (_, (low, high)):

        async def work() -> None:
            async with hold(low, "low", {RC: {}}):
                await high.request("high", {RC: {}}, priority=1)
                await asyncio.sleep(LONG)

        with pytest.raises(Revoked) as revoked:
            await work()
        assert revoked.value.outcome == "preempted"
