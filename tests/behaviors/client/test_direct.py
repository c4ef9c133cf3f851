"""Direct requests, with an RCM and RCs on a mesh in memory: how long a hold may be relied on, and who waits for it."""

from __future__ import annotations

import asyncio
from decimal import Decimal
from typing import Any

import pytest

from tests.behaviors.client.small_fleet import FLEET, OTHER, RC, held, make_older, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.direct import DirectHold
from zscout.behaviors.client.request import CommandRefused, OpenArc, amounts
from zscout.drivers.resource_controller import SETTLE
from zscout.messages import Done, Problem, Release
from zscout.testing.link import Disturbance
from zscout.types import NO_TERM, SECOND, Grant, Ns

LEASE = FLEET.timing.hold_lease / SECOND


async def enter(client: Client, name: str, *rcs: str, **how: Any) -> tuple[OpenArc, DirectHold]:
    """A direct hold, entered."""
    how = {"min_runtime": 600, "direct": True, **how}
    arc = await client.request(name, {rc: {} for rc in rcs or (RC,)}, **how)
    grant = await client.granted(arc)
    assert grant is not None
    hold = client.internals.direct_hold(grant)
    assert hold is not None
    return arc, hold


async def entered_after(client: Client, name: str, **how: Any) -> float:
    """Seconds from asking for RC to entering."""
    asked = client.mesh.now()
    arc = await client.request(name, {RC: {}}, **{"min_runtime": 600, **how})
    assert await client.granted(arc, confirmed=True) is not None
    return (client.mesh.now() - asked) / SECOND


def seconds(time: Ns, client: Client) -> float:
    return (time - client.mesh.now()) / SECOND


async def test_a_direct_hold_is_confirmed_again_and_may_be_relied_on_for_a_hold_lease_more() -> None:
    async with small_fleet("one") as (_, (one,)):
        _, held = await enter(one, "first", RC, OTHER)
        assert seconds(held.sure_until, one) == pytest.approx(LEASE, abs=0.1)
        told = list[Ns]()
        held.watch(lambda hold: told.append(hold.gone_by))
        for _ in range(5):
            await asyncio.sleep(10)
            assert LEASE / 2 < seconds(held.sure_until, one) <= LEASE
            assert held.gone_by == held.sure_until + held.settle * 9 // 10
        assert (held.settle, told) == (SETTLE * SECOND, sorted(told))
        assert len(set(told)) > 30


async def test_a_hold_that_is_not_direct_has_nothing_of_this() -> None:
    async with small_fleet("one") as (fleet, (one,)):
        _, grant = await held(one, "first")
        assert one.internals.direct_hold(grant) is None
        await asyncio.sleep(5)
        assert not fleet.rcs[0].holds.may_be_direct(one.mesh.now())


async def test_the_next_holder_enters_when_the_program_has_left() -> None:
    async with small_fleet("one", "two") as (_, (one, two)):
        arc, held = await enter(one, "first")
        entering = asyncio.create_task(entered_after(two, "second", priority=1))
        await until(lambda: held.over)
        assert arc.state == "queued"
        assert seconds(held.gone_by, one) == pytest.approx(0.9 * SETTLE, abs=0.1)
        await asyncio.sleep(2)
        assert not entering.done()
        held.returned()
        assert await entering == pytest.approx(2, abs=0.3)


async def test_a_program_that_never_leaves_has_settle_from_when_its_client_heard_of_the_end() -> None:
    async with small_fleet("one", "two") as (_, (one, two)):
        await enter(one, "first")
        assert await entered_after(two, "second", priority=1) == pytest.approx(SETTLE, abs=0.3)


async def test_a_killed_client_has_a_hold_lease_and_settle() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        await enter(one, "first")
        fleet.clients.remove(one)
        fleet.network.kill(one.mesh)
        assert SETTLE < await entered_after(two, "second") <= LEASE + SETTLE + 0.3


async def test_what_is_given_back_is_free_at_once() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        arc, held = await enter(one, "first")
        await one.end(arc)
        assert held.over
        assert await entered_after(two, "second") < 0.1
        assert fleet.rcs[0].holds.settling == {}


async def test_what_another_ends_settles() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        arc, held = await enter(one, "first")
        operator = fleet.client("operator")
        await operator._rcm.query(Release(id=arc.id, client=str(one.mesh.me)))
        await until(lambda: held.over)
        assert not held.gone
        assert await entered_after(two, "second") == pytest.approx(SETTLE, abs=0.3)


async def test_a_hold_that_an_rc_has_not_confirmed_for_a_hold_lease_is_over_whatever_rcms_say() -> None:
    async with small_fleet("one") as (fleet, (one,)):
        arc, held = await enter(one, "first", RC, OTHER)
        fleet.network.disturb({"command": Disturbance(lost=1.0)})
        until_then = held.sure_until
        await until(lambda: held.over)
        assert held.ended_at is not None
        assert 0 <= held.ended_at - until_then < 0.05 * SECOND
        assert arc.grant is None
        assert arc._ending is not None
        assert "did not confirm it for the hold lease" in arc._ending.reason
        fleet.network.disturb({})
        held.returned()
        # It has its place still.
        assert await one.granted(arc) not in (None, held.grant)


async def test_who_waits_for_a_program_to_leave_has_its_full_time_after_that() -> None:
    async with small_fleet("one", "two") as (_, (one, two)):
        await enter(one, "first", keep=True)
        arc = await two.request("second", {RC: {}}, priority=1, min_runtime=2, keep=False)
        grant, asked = arc.grant, two.mesh.now()
        assert await two.granted(arc, confirmed=True) == grant
        assert (two.mesh.now() - asked) / SECOND >= SETTLE - 0.1
        assert seconds(arc.end, two) == pytest.approx(2, abs=0.2)


@pytest.mark.parametrize("keep", [False, True])
async def test_who_could_not_enter_in_its_time_is_queued_with_its_full_minimum_runtime(keep: bool) -> None:
    """Where an RC knows nothing of when a hold's time begins."""
    async with small_fleet("one", "two", "three") as (fleet, (one, two, three)):
        make_older(fleet.rcs[0])
        await asyncio.sleep(1)
        await enter(one, "first", keep=True)
        arc = await two.request("second", {RC: {}}, priority=1, min_runtime=2, keep=keep)
        first_grant, place = arc.grant, arc._place
        asked = two.mesh.now()
        entering = asyncio.create_task(two.granted(arc, confirmed=True))
        if keep:
            # Past its minimum runtime another of its priority takes it, which could not enter either.
            await asyncio.sleep(2.5)
            await three.request("third", {RC: {}}, priority=1, min_runtime=0.5)
        grant = await entering
        assert grant not in (None, first_grant)
        assert arc._place == place
        assert (two.mesh.now() - asked) / SECOND >= SETTLE - 0.1
        # What is kept goes on after its minimum runtime, which passed meanwhile.
        assert keep or (arc.end - two.mesh.now()) / SECOND > 0
        state = await fleet.state()
        (hold,) = state.holds
        assert (hold.arc, hold.min_runtime) == ("second", Decimal(2))


async def test_a_grant_whose_program_was_told_to_leave_is_not_entered_again() -> None:
    async with small_fleet("one") as (_, (one,)):
        arc, held = await enter(one, "first")
        arc._lose("one RCM says so", one.mesh.now())
        one._store.notify(arc)
        assert held.over
        held.returned()
        # The next one has found that all of its RCs hold it.
        arc.state, arc.grant = "running", held.grant
        assert await one.granted(arc) not in (None, held.grant)


async def test_the_time_of_a_direct_hold_is_over_at_its_client_too() -> None:
    async with small_fleet("one", "two") as (_, (one, two)):
        arc, held = await enter(one, "first", min_runtime=3)
        entering = asyncio.create_task(entered_after(two, "second"))
        await until(lambda: held.over)
        assert seconds(arc.end, one) == pytest.approx(0, abs=0.05)
        await asyncio.sleep(1)
        held.returned()
        assert await entering == pytest.approx(4, abs=0.3)


async def test_a_client_that_closes_tells_that_its_programs_are_gone() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        await enter(one, "first")
        fleet.clients.remove(one)
        await one.close()
        assert await entered_after(two, "second") < 0.2


async def test_a_foreign_rc_is_confirmed_and_told_nothing_else() -> None:
    said = list[tuple[str, str]]()

    async def command(rc: str, grant: Grant, do: dict[str, Any], *, timeout: float) -> Done:
        assert grant == Grant(NO_TERM, 1)
        said.append((rc, do["name"]))
        if do["name"] != "confirm" and rc == OTHER:
            raise CommandRefused(rc, Problem("unknown_command", "no such thing"))
        return Done(settle=None if rc == OTHER else 2.0)

    loop = asyncio.get_running_loop()

    def now() -> Ns:
        return round(loop.time() * SECOND)

    arc = OpenArc("id", "first", amounts({RC: {}, OTHER: {}}), 0, Decimal(600), keep=True, direct=True)
    arc.rcs = [RC, OTHER]
    held = DirectHold(
        arc, Grant(NO_TERM, 1), command, now, lambda coro: asyncio.create_task(coro), hold_lease=3 * SECOND
    )
    for rc in arc.rcs:
        held.confirmed(rc, now(), await command(rc, held.grant, {"name": "confirm"}, timeout=1))
    held.keep_confirming(lambda _: pytest.fail("both have answered"))
    await asyncio.sleep(10)
    assert held.settle == 2 * SECOND
    held.end()
    await asyncio.sleep(0.1)
    held.returned()
    await asyncio.sleep(0.1)
    assert tuple(what for rc, what in said if rc == RC and what != "confirm") == ("leaving", "left")
    assert {what for rc, what in said if rc == OTHER} == {"confirm"}
