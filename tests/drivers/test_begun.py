"""When a hold's time begins at its RC: once the device has begun for it, and all others of its gang have."""

from __future__ import annotations

import asyncio

import pytest
from msgspec.structs import replace

from tests.drivers.rcs import Device, grant, holder, rc_state, states_published
from tests.drivers.test_settling import NEXT, Oven, play
from tests.mesh.kit import until
from zscout.drivers.resource_controller import SETTLE
from zscout.messages import Holder

STARTS = 4.0
"""Seconds that an `Oven` needs."""


def short(number: int, arc: str = "one", **how: object) -> Holder:
    """A hold of 2 s, of which the last 1.5 s are protected."""
    return replace(holder(number, arc), **{"remaining": 2.0, "protected_from": 1.5} | how)


async def test_a_holder_does_not_lose_its_time_to_the_start_of_its_device() -> None:
    async with play(short(1), device=Oven(), confirmed=False) as at:
        said = states_published(at.client)
        state = await rc_state(at.client)
        assert state.begin_within == pytest.approx(STARTS)
        assert state.holders[0].remaining == 2.0
        assert state.holders[0].waits == pytest.approx(STARTS, abs=0.1)
        await asyncio.sleep(STARTS - 0.2)
        state = await rc_state(at.client)
        assert state.holders[0].remaining == 2.0
        # What protects it does not wait: at first that was so in half a second.
        assert state.holders[0].protected_from == pytest.approx(1.5 + STARTS - 0.2, abs=0.1)
        await until(lambda: bool(said))
        assert said[0].holders[0].waits is None
        assert said[0].holders[0].remaining == pytest.approx(2.0, abs=0.01)
        await asyncio.sleep(1.9)
        assert at.rc.holds.held
        await until(lambda: not at.rc.holds.held)
        assert [one.why for one in said[1].ended] == ["time"]


async def test_it_waits_for_the_other_devices_of_its_gang_as_the_leader_publishes() -> None:
    async with play(short(1), device=Device(), confirmed=False) as at:
        at.rcm.publish(short(1, waits=10.0))
        await asyncio.sleep(3)
        state = await rc_state(at.client)
        assert (state.holders[0].waits, state.holders[0].remaining) == (None, 2.0)
        at.rcm.publish(short(1, remaining=1.0))
        await asyncio.sleep(0.9)
        assert at.rc.holds.held
        await until(lambda: not at.rc.holds.held)


async def test_its_own_device_may_be_the_last_one() -> None:
    async with play(short(1), device=Oven(), confirmed=False) as at:
        at.rcm.publish(short(1, waits=4.0))
        await until(lambda: at.rc.holds.held[grant(1)].begun)
        await asyncio.sleep(3)
        assert at.rc.holds.held
        at.rcm.publish(short(1))
        await asyncio.sleep(1.9)
        assert at.rc.holds.held
        await until(lambda: not at.rc.holds.held)


async def test_what_settles_is_waited_for_as_well() -> None:
    async with play() as at:
        said = states_published(at.client)
        at.next_holder(remaining=2.0)
        await until(lambda: bool(said))
        assert said[0].holders[0].waits == pytest.approx(3.0 + SETTLE, abs=0.2)
        assert await at.settled_after() > 2
        assert at.device.calls[-1] == "begin next"
        await until(lambda: len(said) == 2)
        assert said[1].holders[0].waits is None


async def test_a_device_that_begins_at_once_publishes_nothing() -> None:
    async with play(confirmed=False) as at:
        said = states_published(at.client)
        await asyncio.sleep(1)
        assert said == []


class Brief(Device):
    """Begins within 20 ms."""

    async def begin(self, holder: Holder) -> None:
        await asyncio.sleep(0.02)
        await super().begin(holder)


async def test_so_does_one_whose_holders_follow_each_other_quickly() -> None:
    async with play(device=Brief(), confirmed=False) as at:
        said = states_published(at.client)
        for number in range(2, 12):
            # A look that was due for one came while the next began.
            await asyncio.sleep(0.04)
            at.rcm.publish(short(number))
        await asyncio.sleep(1)
        assert not [one for state in said for one in state.holders if one.waits is not None]


async def test_a_device_that_has_begun_goes_on_in_another_client() -> None:
    async with play(short(1), device=Oven(), confirmed=False) as at:
        await until(lambda: at.rc.holds.held[grant(1)].begun)
        at.rcm.publish(replace(short(2, client="h/other"), place=short(1).place))
        await until(lambda: grant(2) in at.rc.holds.held)
        assert at.rc.holds.held[grant(2)].begun


async def test_who_ends_while_its_device_starts_is_not_waited_for() -> None:
    async with play(short(1), device=Oven(), confirmed=False) as at:
        at.next_holder(remaining=2.0)
        await until(lambda: "begin next" in at.device.calls)
        said = states_published(at.client)
        await asyncio.sleep(STARTS + 0.5)
        assert [[one.arc for one in state.holders] for state in said] == [[NEXT]]
        assert said[0].holders[0].waits is None
