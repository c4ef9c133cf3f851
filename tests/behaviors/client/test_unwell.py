"""A device that does not work for a while, on a mesh in memory: its hold goes on, and nobody else gets it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from tests.behaviors.client.small_fleet import OTHER, RC, SmallFleet, begin_move, held, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import Held
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.drivers.tolerance import Tolerance
from zscout.messages import Problem
from zscout.types import SECOND

WHY = "it reboots"
OPERATOR = 10


@asynccontextmanager
async def rig(*clients: str) -> AsyncIterator[tuple[SmallFleet, list[Client]]]:
    """RC tolerates 30 s, at most 100 s; OTHER nothing."""
    async with small_fleet(*clients) as (fleet, made):
        fleet.rcs[0]._tolerance = Tolerance(30 * SECOND, 0, 100 * SECOND)
        await until(lambda: all(rc.informed.is_set() for rc in fleet.rcs))
        yield fleet, made


async def gang(client: Client) -> Held:
    arc = await client.request("test", {RC: {}, OTHER: {}}, min_runtime=600)
    grant = await client.granted(arc, confirmed=True)
    assert grant is not None
    return Held(client, arc, grant)


async def test_a_gang_goes_on_and_a_higher_priority_waits_until_its_device_is_well() -> None:
    async with rig("one", "two") as (fleet, (one, two)):
        test = await gang(one)
        fleet.rcs[0].unwell(WHY)
        higher = await two.request("higher", {RC: {}}, priority=5, min_runtime=60)
        await until(lambda: higher.reason == f"{RC} is unwell: {WHY}")
        await asyncio.sleep(20)
        assert test.active
        fleet.rcs[0].recover()
        await until(lambda: higher.grant is not None)
        assert not test.active


async def test_a_gang_is_lost_with_its_device_after_what_that_tolerates() -> None:
    async with rig("one") as (fleet, (one,)):
        test = await gang(one)
        assert await test.expect_outage(20) == {RC: 20.0, OTHER: 0.0}
        fleet.rcs[0].unwell(WHY)
        await asyncio.sleep(29)
        assert test.active
        await until(lambda: not test.active)
        assert test.arc.reason == f"{RC} was lost: {WHY}"
        fleet.rcs[0].recover()
        await until(lambda: test.arc.grant is not None)


async def test_over_a_change_of_leader_and_a_hand_over_it_goes_on() -> None:
    async with rig("one", "two", "three") as (fleet, (one, two, three)):
        arc, _ = await held(one, "test")
        fleet.rcs[0].unwell(WHY)
        await fleet.standby()
        await fleet.lose_leader()
        await until(lambda: one.leader == "h1")
        waits = await three.request("next", {RC: {}}, min_runtime=60)
        await until(lambda: waits.reason == f"{RC} is unwell: {WHY}")
        begin_move(one, two)
        await one.internals.hand_over_all(two.mesh.me)
        await until(lambda: "h/two" in [holder.client for holder in fleet.rcs[0].holders()])
        assert fleet.rcs[0].health == "ok"
        assert (arc.state, waits.grant) == ("moved", None)


async def test_an_operator_gets_it_as_it_is() -> None:
    async with rig("one", "two") as (fleet, (one, two)):
        fleet.rcs[0]._tolerance = Tolerance(30 * SECOND, 60 * SECOND, 0)
        fleet.rcs[0].unwell(WHY)
        waits = await one.request("next", {RC: {}}, min_runtime=60)
        await until(lambda: "is unwell" in waits.reason)
        _, _ = await held(two, "repair", priority=OPERATOR)
        assert waits.grant is None


async def test_an_older_device_announces_nothing_and_is_lost_at_once() -> None:
    async with rig("one") as (fleet, (one,)):
        test, rc = await gang(one), fleet.rcs[0]
        answers = {"unknown_command": 0.0, "ended": None}
        own = one.command
        for code, seconds in answers.items():

            async def refuse(name: str, *args: object, code: str = code, **how: object) -> object:
                if name == RC:
                    raise CommandRefused(name, Problem(code, "so"))
                return await own(name, *args, **how)  # type: ignore[arg-type]

            one.command = refuse  # type: ignore[method-assign, assignment]
            if seconds is None:
                with pytest.raises(CommandRefused):
                    await test.expect_outage(20)
            else:
                assert (await test.expect_outage(20))[RC] == seconds
        rc.fail(WHY)
        await until(lambda: not test.active)
