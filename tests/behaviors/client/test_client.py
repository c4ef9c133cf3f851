"""A client with an RCM and RCs on a mesh in memory, in virtual time: from a request to its end."""

from __future__ import annotations

import asyncio

import pytest
from msgspec.structs import replace

from tests.behaviors.client.small_fleet import ECHO, FLEET, RC, SmallFleet, held, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import Revoked, hold, holds
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.client.request import OpenArc
from zscout.behaviors.components.component import ComponentContext, SafePointGate
from zscout.behaviors.components.shipped import Counter
from zscout.config.fleet import Fleet
from zscout.keyexpr import Sender
from zscout.mesh import ZenohMesh
from zscout.messages import Release
from zscout.testing.link import Disturbance
from zscout.testing.memory import MemoryMesh
from zscout.testing.virtual_time import START
from zscout.types import SECOND


async def test_a_request_is_granted_obeyed_and_given_back() -> None:
    async with small_fleet("one", "two") as (_, (one, two)):
        async with hold(one, "first", {RC: {}}, min_runtime=60) as held:
            assert (await held.command(RC, ECHO)).result == 7
            waits = await two.request("second", {RC: {}}, min_runtime=60)
            assert (waits.state, waits.ahead) == ("queued", 0)
        grant = await two.granted(waits)
        assert grant is not None
        with pytest.raises(CommandRefused) as refused:
            await held.command(RC, ECHO)
        assert refused.value.code == "ended"


async def test_a_hold_ends_after_its_minimum_runtime_without_an_error() -> None:
    async with small_fleet("one") as (fleet, (one,)):
        began = one.mesh.now()
        async with hold(one, "first", {RC: {}}, min_runtime=5, keep=False):
            await asyncio.sleep(3600)
        assert 5 <= (one.mesh.now() - began) / SECOND < 5.1
        assert await fleet.holders() == []


async def test_a_timer_that_goes_off_early_ends_a_hold_without_an_error() -> None:
    # A loop's timers may be counted in ms, and on another clock than the host's.
    async with small_fleet("one") as (fleet, _):
        mesh, loop = fleet.mesh("h", "slow"), asyncio.get_running_loop()
        mesh.now = lambda: round((START + (loop.time() - START) * 0.999) * SECOND)
        slow = Client.on(mesh, FLEET)
        fleet.clients.append(slow)
        async with hold(slow, "first", {RC: {}}, min_runtime=2, keep=False) as held:
            fleet.network.link(fleet.leader(), mesh).loss = 1.0  # it does not hear that its hold is over
            await asyncio.sleep(3600)
        assert held.completed


async def test_who_is_preempted_goes_on_when_it_is_granted_again() -> None:
    async with small_fleet("low", "high") as (_, (low, high)):
        entered: list[str] = []

        async def work() -> None:
            async for attempt in holds(low, "low", {RC: {}}, min_runtime=60):
                async with attempt:
                    entered.append("in")
                    await asyncio.sleep(90)

        working = asyncio.create_task(work())
        await until(lambda: entered)
        async with hold(high, "high", {RC: {}}, priority=5, min_runtime=1):
            await asyncio.sleep(0.5)
            assert entered == ["in"]
        await working
        assert entered == ["in", "in"]


async def test_one_entry_that_is_preempted_raises() -> None:
    async with small_fleet("low", "high") as (_, (low, high)):
        entered = asyncio.Event()

        async def work() -> None:
            async with hold(low, "low", {RC: {}}, min_runtime=60):
                entered.set()
                await asyncio.sleep(3600)

        working = asyncio.ensure_future(work())
        await entered.wait()
        taker = await high.request("high", {RC: {}}, priority=5, min_runtime=60)
        with pytest.raises(Revoked) as revoked:
            await working
        assert (revoked.value.outcome, revoked.value.by) == ("preempted", f"h/high/{taker.id}")


async def test_a_bad_request_is_refused_and_forgotten() -> None:
    async with small_fleet("one") as (_, (one,)):
        with pytest.raises(RequestRefused) as refused:
            await one.request("bad", {RC: {}}, priority=10**9)
        assert (refused.value.code, one.internals.open_requests()) == ("bad_request", [])


async def test_a_request_that_is_cancelled_before_its_answer_is_withdrawn() -> None:
    def granted(fleet: SmallFleet) -> list[str]:
        (candidate,) = fleet.candidates.values()
        assert candidate.rcm is not None
        return [arc.name for arc in candidate.rcm.core.holders(RC)]

    async with small_fleet("one") as (fleet, (one,)):
        fleet.network.link(fleet.leader(), one.mesh).delay = 0.2
        asking = asyncio.create_task(one.request("first", {RC: {}}, min_runtime=600, keep=True))
        await asyncio.sleep(0.1)
        assert granted(fleet) == ["first"]
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        await asyncio.sleep(1)
        assert granted(fleet) == []


async def test_a_client_that_is_cancelled_while_it_leaves_leaves_all_the_same() -> None:
    async with small_fleet("watch", "one") as (fleet, (_, one)):
        await held(one, "first", keep=True)
        closed: list[bool] = []
        close = one.mesh.close

        async def closing() -> None:
            await close()
            closed.append(True)

        one.mesh.close = closing  # type: ignore[method-assign]
        fleet.network.link(one.mesh, fleet.leader()).loss = 1.0
        leaving = asyncio.create_task(one.close())
        await asyncio.sleep(0.1)
        leaving.cancel()
        await asyncio.gather(leaving, return_exceptions=True)
        await until(lambda: closed, within=1)
        await asyncio.sleep(FLEET.mesh.lease)
        assert await fleet.holders() == []


async def test_a_client_whose_own_work_fails_ends_its_holds_and_leaves() -> None:
    async with small_fleet("watch", "one") as (fleet, (_, one)):

        async def broken(_arc: OpenArc) -> None:
            raise RuntimeError("broken")

        async def work() -> None:
            async with hold(one, "first", {RC: {}}, min_runtime=600):
                one._rcm.ask = broken  # type: ignore[method-assign, assignment]
                await asyncio.sleep(3600)

        with pytest.raises(Revoked, match="this client failed: RuntimeError"):
            await work()
        await asyncio.sleep(FLEET.mesh.lease)
        assert await fleet.holders() == []


async def test_connecting_can_be_awaited_entered_and_run_as_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    async with small_fleet("watch") as (fleet, _):

        async def opened(_: Fleet, me: Sender) -> MemoryMesh:
            return fleet.network.open(FLEET.name, me)

        monkeypatch.setattr(ZenohMesh, "open", opened)
        async with Client.connect("entered", fleet=FLEET, host="h") as entered:
            await until(lambda: entered.leader == "h0")
        awaited = await Client.connect("awaited", fleet=FLEET, host="h")
        task = await asyncio.create_task(Client.connect("task", fleet=FLEET, host="h"))
        async with awaited, task:
            assert [client.mesh.me.client for client in (awaited, task)] == ["awaited", "task"]


@pytest.mark.parametrize("at_once", [False, True])
async def test_a_counter_keeps_its_hold_where_a_command_is_not_answered(
    monkeypatch: pytest.MonkeyPatch, at_once: bool
) -> None:
    """Be it that no answer comes for two seconds, or none at once, as where there is no link."""

    async def nobody(*_: object, **__: object) -> None: ...

    async with small_fleet("one") as (fleet, (one,)):
        counter = Counter({"rc": RC})
        counting = asyncio.create_task(counter.run(ComponentContext(one, "count", 1, SafePointGate())))
        await until(lambda: counter.count == 3)
        before = [arc.grant for arc in one._store.open]
        with monkeypatch.context() as patch:
            if at_once:
                patch.setattr(one.mesh, "ask_one", nobody)
            else:
                fleet.network.disturb({"command": Disturbance(lost=1.0)})
            await asyncio.sleep(5)
        fleet.network.disturb({})
        assert counter.count == 3
        await until(lambda: counter.count == 6)
        assert [arc.grant for arc in one._store.open] == before
        counting.cancel()


# How long a hold lasts that a program asked for without a word about it


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
        assert held.arc._ending is not None
        assert held.arc._ending.by == f"h/two/{waits.id}"
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

        began, working = one.mesh.now(), asyncio.create_task(work())
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
    limits = replace(FLEET.limits, max_runtime=100 * SECOND)
    async with small_fleet("one", config=replace(FLEET, limits=limits)) as (fleet, (one,)):
        began = one.mesh.now()
        async with hold(one, "first", {RC: {}}, keep=keep, min_runtime=None if keep else LONG) as held:
            assert held.remaining < 101
            await asyncio.sleep(LONG)
        assert (held.completed, (one.mesh.now() - began) // SECOND) == (True, 100)
        assert await fleet.holders() == []


async def test_a_grant_is_waited_for_at_most_so_long() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        async with hold(one, "first", {RC: {}}):
            with pytest.raises(TimeoutError, match=r"second was not granted within 30 s: waits for first \(h/one\)"):
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
