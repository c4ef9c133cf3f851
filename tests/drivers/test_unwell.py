"""A device that is not well at present: for how long its holder keeps it, and what its RC publishes meanwhile."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any

import pytest
from msgspec.structs import replace

from tests.drivers.rcs import grant, holder, rc_state, states_published
from tests.drivers.test_settling import NEXT, Place, play
from tests.mesh.kit import until
from zscout.drivers.tolerance import MAX_OUTAGE, Tolerance
from zscout.messages import Command, Done, Holder
from zscout.types import SECOND

WHY = "health ended with exit code 1"


def tolerance(held: float = 10, free: float = 0, most: float = 100) -> Tolerance:
    return Tolerance(round(held * SECOND), round(free * SECOND), round(most * SECOND))


def rig(kept: Tolerance | None) -> AbstractAsyncContextManager[Place]:
    """An RC that a client holds for a while."""
    return play(replace(holder(1), remaining=600.0), confirmed=False, tolerance=kept)


async def announce(at: Place, seconds: object, number: int = 1, **how: object) -> Done | str:
    do: Mapping[str, Any] = {"name": "expect_outage", "seconds": seconds} | how
    command = Command(do=dict(do), grant=grant(number), ttl=5)
    reply = await at.client.ask_one(at.client.keys.command("robot/x", at.client.me), command, Done, timeout=5)
    assert reply is not None
    return reply.message or f"{reply.problem and reply.problem.code}"


async def lost_after(at: Place) -> float:
    """Seconds from now until the RC is lost."""
    began = at.client.now()
    await until(lambda: at.rc.health != "ok")
    return (at.client.now() - began) / SECOND


async def test_a_holder_keeps_a_device_that_is_unwell_and_it_is_lost_only_after_that() -> None:
    async with rig(tolerance()) as at:
        at.rc.unwell(WHY)
        await asyncio.sleep(4)
        state = await rc_state(at.client)
        assert state.health == "ok"
        assert state.unwell is not None
        assert (state.unwell.why, round(state.unwell.since), round(state.unwell.left)) == (WHY, 4, 6)
        assert [one.arc for one in state.holders] == ["one"]
        assert await at.word(at.client, 1) == "done"
        assert await lost_after(at) == pytest.approx(6, abs=0.1)
        state = await rc_state(at.client)
        assert (state.health, state.unwell, state.holders) == (WHY, None, [])


async def test_one_that_is_well_again_begins_anew_with_the_next_outage() -> None:
    async with rig(tolerance()) as at:
        for _ in range(3):
            at.rc.unwell(WHY)
            at.rc.unwell("another reason")
            await asyncio.sleep(8)
            at.rc.recover()
            assert (await rc_state(at.client)).unwell is None
            await asyncio.sleep(4)
        assert at.rc.holds.held


async def test_without_tolerance_it_is_lost_at_once() -> None:
    async with rig(None) as at:
        said = states_published(at.client)
        at.rc.unwell(WHY)
        assert at.rc.health == WHY
        await until(lambda: bool(said))
        assert all(state.unwell is None for state in said)
        assert [one.why for state in said for one in state.ended] == ["failed"]
        # A new reason of one that is lost.
        at.rc.unwell("another reason")
        assert at.rc.health == "another reason"


async def test_what_fails_is_lost_whatever_is_tolerated() -> None:
    async with rig(tolerance()) as at:
        at.rc.unwell(WHY)
        at.rc.fail("start failed")
        state = await rc_state(at.client)
        assert (state.health, state.unwell, state.holders) == ("start failed", None, [])


@pytest.mark.parametrize(("free", "after"), [(0.0, 0.0), (5.0, 5.0)])
async def test_at_the_end_of_its_hold_what_is_tolerated_while_it_is_free_counts(free: float, after: float) -> None:
    async with rig(tolerance(free=free)) as at:
        at.rc.unwell(WHY)
        await asyncio.sleep(3)
        at.rcm.publish()
        await until(lambda: not at.rc.holds.held)
        assert await lost_after(at) == pytest.approx(after, abs=0.1)


async def test_an_operator_who_takes_it_has_the_whole_tolerance() -> None:
    async with rig(tolerance()) as at:
        at.rc.unwell(WHY)
        await asyncio.sleep(9)
        at.next_holder()
        await until(lambda: grant(2) in at.rc.holds.held)
        assert await lost_after(at) == pytest.approx(10, abs=0.1)


@pytest.mark.parametrize(
    "next_hold",
    [replace(holder(2, client="h/other"), place=holder(1).place), replace(holder(2, NEXT), continues="one")],
    ids=["handed over", "continues"],
)
async def test_a_hold_that_goes_on_in_another_gains_nothing_and_keeps_what_it_announced(next_hold: Holder) -> None:
    async with rig(tolerance()) as at:
        assert await announce(at, 30) == Done(result={"seconds": 30.0})
        at.rc.unwell(WHY)
        await asyncio.sleep(9)
        at.rcm.publish(next_hold)
        await until(lambda: grant(2) in at.rc.holds.held)
        assert await lost_after(at) == pytest.approx(21, abs=0.1)


async def test_an_announced_outage_is_bounded_by_what_its_table_says_and_by_its_hold() -> None:
    async with rig(tolerance(most=40)) as at:
        assert await announce(at, 1_000) == Done(result={"seconds": 40.0})
        await asyncio.sleep(20)
        at.rc.unwell(WHY)
        assert await lost_after(at) == pytest.approx(20, abs=0.1)
    async with rig(tolerance()) as at:
        assert await announce(at, 90) == Done(result={"seconds": 90.0})
        at.next_holder()
        await until(lambda: grant(2) in at.rc.holds.held)
        at.rc.unwell(WHY)
        assert await lost_after(at) == pytest.approx(10, abs=0.1)


async def test_outages_may_be_announced_for_the_whole_hold_and_once_it_is_unwell() -> None:
    async with rig(tolerance()) as at:
        assert await announce(at, 20, each=True) == Done(result={"seconds": 20.0})
        await asyncio.sleep(60)
        at.rc.unwell(WHY)
        await asyncio.sleep(19)
        assert await announce(at, 50) == Done(result={"seconds": 50.0})
        assert await lost_after(at) == pytest.approx(50, abs=0.1)


@pytest.mark.parametrize("seconds", [0, -1, MAX_OUTAGE + 1, True, "60", None])
async def test_what_is_no_span_is_refused(seconds: object) -> None:
    async with rig(tolerance()) as at:
        assert await announce(at, seconds) == "bad_command"
        assert await announce(at, 10, each="yes") == "bad_command"


async def test_only_its_holder_announces() -> None:
    async with rig(tolerance()) as at:
        assert await announce(at, 10, number=7) != Done(result={"seconds": 10.0})
        assert await at.word(at.other, 1) == "wrong_client"
