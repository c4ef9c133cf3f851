"""A body begins at the grant: what its RCs say of it comes beside."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tests.behaviors.client.small_fleet import ECHO, OTHER, RC, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import Revoked, hold, holds
from zscout.behaviors.client.client import CommandRefused
from zscout.testing.link import kind_of
from zscout.types import SECOND


async def test_a_body_is_entered_at_the_grant_and_asks_each_host_once() -> None:
    async with small_fleet("one") as (_, (one,)):
        asked: list[str] = []
        get = one.mesh._transport.get

        def listed(key: str, *rest: Any) -> None:
            asked.append(kind_of(key))
            get(key, *rest)

        one.mesh._transport.get = listed  # type: ignore[assignment,method-assign]
        async with hold(one, "first", {RC: {}, OTHER: {}}) as held:
            assert ({*asked}, held.arc.hosts) == ({"schedule"}, {RC: "devices", OTHER: "devices"})
            assert await held.confirmed()
            assert [one for one in asked if one != "schedule"] == ["confirm"]
            assert (await held.command(RC, ECHO)).result == 7


async def test_what_is_commanded_before_the_publication_waits_for_it_at_the_rc() -> None:
    async with small_fleet("one") as (fleet, (one,)):
        fleet.network.link(fleet.leader(), fleet.devices).delay = 0.2
        async with hold(one, "first", {RC: {}}) as held:
            began = one.mesh.now()
            assert (await held.command(RC, ECHO)).result == 7
            assert 0.1 * SECOND < one.mesh.now() - began < 0.25 * SECOND


@pytest.mark.parametrize("again", [False, True])
async def test_a_body_whose_grant_is_not_confirmed_within_a_second_is_interrupted(again: bool) -> None:
    async with small_fleet("one") as (fleet, (one,)):
        for source, target in ((one.mesh, fleet.devices), (fleet.devices, one.mesh)):
            fleet.network.cut(source, target)
        entered: list[float] = []

        async def work() -> None:
            if not again:
                async with hold(one, "first", {RC: {}}) as held:
                    entered.append(held.now())
                    await asyncio.sleep(3600)
            async for attempt in holds(one, "first", {RC: {}}):
                async with attempt as held:
                    entered.append(held.now())
                    if len(entered) == 1:
                        with pytest.raises(CommandRefused, match="no answer"):
                            await held.command(RC, ECHO, ttl=0.2)
                        await asyncio.sleep(3600)

        body = asyncio.create_task(work())
        await until(lambda: entered)
        began = one.mesh.now()
        if again:
            await asyncio.sleep(1.5)
            fleet.network.heal()
            await body
            assert len(entered) == 2
        else:
            with pytest.raises(Revoked, match="no answer"):
                await body
            assert 0.9 * SECOND < one.mesh.now() - began < 1.2 * SECOND
