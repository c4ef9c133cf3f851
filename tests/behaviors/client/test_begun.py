"""Holds of devices that need time to start, with an RCM, RCs and clients in virtual time: their time begins when all of
their devices have begun."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tests.behaviors.client.small_fleet import ECHO, FLEET, OTHER, RC, SmallFleet, begin_move, make_older, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.config.fleet import Fleet
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.resource_controller import SETTLE, ResourceController
from zscout.messages import Holder, RcState
from zscout.types import SECOND

STARTS = 65.0
RUNS = 60.0
"""Seconds: what a request protects by default."""
LEASE = FLEET.timing.hold_lease / SECOND
BOTH: dict[str, dict[str, Any]] = {RC: {}, OTHER: {}}


class Oven(ExclusiveDriver):
    """Needs `starts` seconds to start."""

    def __init__(self, starts: float = STARTS, begin_within: float = 90.0) -> None:
        super().__init__()
        self.starts, self.begin_within, self.begun, self._ready = starts, begin_within, 0, 0.0

    async def begin(self, holder: Holder) -> None:
        self.begun += 1
        self._ready = asyncio.get_running_loop().time() + self.starts

    def begins_for(self) -> float:
        return max(0.0, self._ready - asyncio.get_running_loop().time())

    async def carry_on(self, before: Holder, after: Holder) -> None:
        pass

    async def safe(self) -> None:
        self._ready = 0.0


class SlowFleet(SmallFleet):
    """RC starts slowly."""

    def __init__(self, fleet: Fleet = FLEET) -> None:
        super().__init__(fleet)
        self.oven = Oven()
        self.rcs[0] = ResourceController(self.devices, RC, self.oven, hold_lease=LEASE, stall=self.stall)


def seconds(client: Client) -> float:
    return client.mesh.now() / SECOND


async def asked(client: Client, name: str, needs: dict[str, dict[str, Any]], **how: Any) -> OpenArc:
    return await client.request(name, needs, **{"min_runtime": RUNS, "keep": False} | how)


@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("needs", [{RC: {}}, BOTH])
async def test_a_program_has_its_time_after_the_start_of_its_devices(
    direct: bool, needs: dict[str, dict[str, Any]]
) -> None:
    async with small_fleet("one", kind=SlowFleet) as (fleet, (one,)):
        began = seconds(one)
        how = {"min_runtime": RUNS, "keep": False, "confirmed": True, "direct": direct, "timeout": 2 * STARTS}
        async with hold(one, "job", needs, **how) as held:  # type: ignore[arg-type]
            entered = seconds(one)
            assert entered - began == pytest.approx(STARTS, abs=0.3)
            assert held.remaining == pytest.approx(RUNS, abs=0.2)
            assert not held.settling
            await asyncio.sleep(2 * RUNS)
        assert held.completed
        assert seconds(one) - entered == pytest.approx(RUNS, abs=0.3)
        assert isinstance(fleet, SlowFleet)
        assert fleet.oven.begun == 1


async def test_two_plain_requests_take_turns() -> None:
    async with small_fleet("one", "two", kind=SlowFleet) as (fleet, (one, two)):
        began, entered = seconds(one), []

        async def work(client: Client) -> None:
            async with hold(client, "job", {RC: {}}, min_runtime=RUNS, keep=False, confirmed=True, timeout=4 * STARTS):
                entered.append(seconds(client) - began)
                await asyncio.sleep(2 * RUNS)

        await asyncio.gather(work(one), work(two))
        assert entered == [pytest.approx(STARTS, abs=0.5), pytest.approx(2 * STARTS + RUNS, abs=1.0)]
        assert isinstance(fleet, SlowFleet)
        assert fleet.oven.begun == 2


async def test_it_is_shown_that_a_hold_waits_for_its_devices() -> None:
    async with small_fleet("one", kind=SlowFleet) as (fleet, (one,)):
        arc = await asked(one, "job", BOTH)
        await asyncio.sleep(5)
        (view,) = (await fleet.state()).holds
        assert view.waits == pytest.approx(STARTS - 5, abs=0.2)
        assert view.remaining == pytest.approx(RUNS)
        assert arc.ready is not None
        assert (arc.ready - one.mesh.now()) / SECOND == pytest.approx(STARTS - 5, abs=0.2)
        foretold = await one.foresee("next", {RC: {}}, min_runtime=RUNS)
        assert foretold is not None
        assert foretold.starts_in == pytest.approx(STARTS - 5 + RUNS, abs=0.2)
        assert foretold.begin_within == 90.0
        await until(lambda: arc.ready is None, within=2 * STARTS)
        (view,) = (await fleet.state()).holds
        assert view.waits is None
        assert view.remaining == pytest.approx(RUNS, abs=0.3)


async def test_a_change_of_leader_while_devices_start_costs_nothing() -> None:
    async with small_fleet("one", kind=SlowFleet) as (fleet, (one,)):
        assert isinstance(fleet, SlowFleet)
        fleet.oven.starts = 40.0
        began, arc = seconds(one), await asked(one, "job", BOTH, min_runtime=30)
        await fleet.standby()
        await asyncio.sleep(20)
        grant = arc.grant
        await fleet.lose_leader()
        await until(lambda: one.leader == "h1")
        await asyncio.sleep(5)
        (view,) = (await fleet.state()).holds
        assert view.waits == pytest.approx(40 - (seconds(one) - began), abs=0.2)
        await until(lambda: arc.ready is None, within=2 * STARTS)
        assert seconds(one) - began == pytest.approx(40, abs=0.3)
        # Neither does one once they have begun.
        fleet.candidate("h2")
        await asyncio.sleep(5)
        fleet.network.kill(fleet.leader())
        await fleet.candidates.pop("h1").stop()
        await until(lambda: not arc.open, within=2 * RUNS)
        assert (arc.outcome, arc._last[0].counter) == ("completed", one.internals.term.counter)
        assert seconds(one) - began == pytest.approx(40 + 30, abs=1.0)
        assert grant is not None


async def test_what_is_handed_over_goes_on_starting() -> None:
    async with small_fleet("old", "new", kind=SlowFleet) as (fleet, (old, new)):
        assert isinstance(fleet, SlowFleet)
        fleet.oven.starts = 20.0
        began = seconds(old)
        await asked(old, "job", BOTH, min_runtime=10)
        await asyncio.sleep(5)
        begin_move(old, new)
        await old.internals.hand_over_all(new.mesh.me)
        arc = await asked(new, "job", BOTH, min_runtime=10)
        await until(lambda: arc.ready is not None)
        await until(lambda: arc.ready is None, within=2 * STARTS)
        assert seconds(new) - began == pytest.approx(20, abs=0.3)
        assert arc.grant is not None
        assert (await new.command(RC, arc.grant, ECHO)).result == 7
        await until(lambda: not arc.open, within=2 * RUNS)
        assert seconds(new) - began == pytest.approx(20 + 10, abs=0.5)


async def test_with_a_device_that_knows_none_of_this_the_whole_hold_runs_from_its_grant() -> None:
    async with small_fleet("one", kind=SlowFleet) as (fleet, (one,)):
        make_older(fleet.rcs[1])
        await asyncio.sleep(1)
        arc = await asked(one, "job", BOTH)
        await until(lambda: arc.grant is not None)
        grant, began = arc.grant, seconds(one)
        await until(lambda: arc.grant != grant, within=2 * RUNS)
        assert seconds(one) - began == pytest.approx(RUNS, abs=0.5)
        assert arc.ready is None


async def test_a_device_that_never_begins_is_lost_and_granted_ever_later() -> None:
    async with small_fleet("one", kind=SlowFleet) as (fleet, (one,)):
        assert isinstance(fleet, SlowFleet)
        fleet.oven.starts, fleet.oven.begin_within = 1_000.0, 5.0
        fleet.rcs[0]._begin_within = 5.0
        fleet.rcs[0].publish()
        arc = await asked(one, "job", {RC: {}})
        for pause in (1, 2, 4):
            await until(lambda: arc.grant is not None)
            granted = seconds(one)
            await until(lambda: arc.grant is None, within=60)
            lost = seconds(one)
            assert lost - granted == pytest.approx(5 + LEASE + SETTLE, abs=0.3)
            assert arc.reason == f"{RC} was lost: it did not begin within 5 s"
            (rc,) = [view for view in (await fleet.state()).rcs if view.rc == RC]
            assert (rc.present, rc.reason) == (False, "it did not begin within 5 s")
            await until(lambda: arc.grant is not None, within=60)
            assert seconds(one) - lost == pytest.approx(pause, abs=0.3)


async def test_a_device_that_begins_at_once_costs_no_message() -> None:
    async with small_fleet("one") as (fleet, (one,)):
        await asyncio.sleep(2)
        states: list[RcState] = []
        one.mesh.subscribe(one.mesh.keys.rc_state_any, RcState, lambda _key, state: states.append(state))
        notices: list[int] = []
        one.internals.watch(lambda arc: notices.append(arc._last[1]))
        arc = await asked(one, "job", BOTH)
        await asyncio.sleep(2)
        assert states == []
        assert len(notices) == 1
        assert arc.grant is not None
        assert fleet.rcs[0].begin_within == 0
