"""Two hosts offer one RC: one of them serves, the other stands by."""

from __future__ import annotations

import asyncio
from decimal import Decimal
from itertools import product
from typing import Any

import pytest

from tests.mesh.kit import until
from tests.services.rcm.kit import FakeClient, FakeFleet, grant_of
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.instances import InstanceState
from zscout.drivers.resource_controller import INFORMED_WITHIN, ResourceController
from zscout.mesh.supervision import StallWatch
from zscout.messages import Command, Done, Grants, Holder, OpenRequest
from zscout.testing.memory import MemoryMesh
from zscout.types import SECOND, Grant, Place, Term

RC = "robot/a"


class Recorded(ExclusiveDriver):
    """What its device was told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []

    async def begin(self, holder: Holder) -> None:
        self.told.append(f"begin {holder.arc}")

    async def safe(self) -> None:
        self.told.append("safe")


async def offer(fleet: FakeFleet, host: str, mesh: MemoryMesh | None = None) -> ResourceController:
    mesh, lease = mesh or fleet.mesh(host), fleet.fleet.timing.hold_lease / SECOND
    rc = ResourceController(mesh, RC, Recorded(), hold_lease=lease, stall=StallWatch(mesh.now).start())
    await rc.start()
    return rc


async def offered() -> tuple[FakeFleet, ResourceController, FakeClient]:
    """The RC at h2, which the RCM knows."""
    fleet = FakeFleet()
    rcm, first, client = fleet.rcm(), await offer(fleet, "h2"), fleet.client("one")
    await until(lambda: rcm.core.status().rcs)
    return fleet, first, client


def told(rc: ResourceController) -> list[str]:
    assert isinstance(rc.driver, Recorded)
    return rc.driver.told


async def confirms(client: FakeClient, grant: Grant) -> list[Any]:
    """All that answer a confirmation, as a code, or as nothing."""
    mesh, command = client.mesh, Command(grant=grant, do={"name": "confirm"})
    replies = await mesh.ask(mesh.keys.command(RC, mesh.me), command, Done, timeout=1)
    return [reply.problem and reply.problem.code for reply in replies]


def kill(fleet: FakeFleet, rc: ResourceController) -> None:
    """It and its mesh end without a word."""
    assert isinstance(rc.mesh, MemoryMesh)
    rc.supervisor.cancel()
    fleet.network.kill(rc.mesh)


async def test_who_finds_another_instance_stands_by_and_serves_when_its_holds_are_surely_over() -> None:
    fleet, first, client = await offered()
    second = await offer(fleet, "h1")
    assert [one.instances.state for one in (first, second)] == [InstanceState.SERVES, InstanceState.STANDS_BY]
    assert second._rc_state([]).duplicate_of == "robot/a at h2"
    answer = await client.ask("tally", RC)
    assert await confirms(client, grant_of(answer)) == [None]
    assert (told(first), told(second)) == (["begin tally"], [])
    # The first may let its holder command for as long as the hold lease.
    kill(fleet, first)
    killed = fleet.watcher.now()
    await until(lambda: told(second))
    assert fleet.watcher.now() - killed >= fleet.fleet.timing.hold_lease
    assert (told(second), second.instances.state) == (["begin tally"], InstanceState.SERVES)
    again = grant_of(client.notices[-1])
    assert again > grant_of(answer)
    assert await confirms(client, again) == [None]


async def test_a_device_is_first_touched_when_it_is_known_who_serves() -> None:
    """A node that starts may see its device's radio before it sees the host whose holder has the device."""
    fleet, first, client = await offered()
    await client.ask("tally", RC)
    late = fleet.mesh("h1")
    fleet.network.isolate(late)
    second = await offer(fleet, "h1", late)
    assert not second.informed.is_set()
    fleet.network.heal()
    await second.informed.wait()
    assert [one.instances.state for one in (first, second)] == [InstanceState.SERVES, InstanceState.STANDS_BY]


async def test_without_a_leader_a_device_is_touched_after_a_while() -> None:
    fleet = FakeFleet()
    began, alone = fleet.watcher.now(), await offer(fleet, "h1")
    await alone.informed.wait()
    assert (fleet.watcher.now() - began) / SECOND == pytest.approx(INFORMED_WITHIN, abs=0.5)


async def test_who_leaves_in_order_is_followed_at_once() -> None:
    fleet, first, client = await offered()
    second = await offer(fleet, "h1")
    await client.ask("tally", RC)
    await until(lambda: told(first))
    stopped = fleet.watcher.now()
    await first.stop()
    await until(lambda: told(second))
    assert fleet.watcher.now() - stopped < SECOND // 2
    assert told(first) == ["begin tally", "safe"]


async def test_of_two_that_did_not_see_each_other_the_one_that_was_taken_in_first_goes_on() -> None:
    fleet, first, client = await offered()
    answer = await client.ask("tally", RC)
    apart = fleet.mesh("h1")
    fleet.network.isolate(apart)
    second = await offer(fleet, "h1", apart)
    assert second.instances.state is InstanceState.SERVES
    fleet.network.heal()
    await until(lambda: second.instances.state is InstanceState.STANDS_BY)
    assert await confirms(client, grant_of(answer)) == [None]
    assert (told(first), told(second)) == (["begin tally"], [])
    # As it leaves, the device is the other one's holder's.
    await second.stop()
    assert told(second) == []


async def test_what_another_half_was_granted_ends_though_the_instance_that_is_meant_has_just_gone() -> None:
    """The one of the other half is taken in when that one's holder can't command any more: until then the leader knows
    of no hold of it, and tells its client so (seed 413304)."""
    fleet, term = FakeFleet(), Term(1, "other")
    rcm, first = fleet.rcm(2), await offer(fleet, "h2")
    await until(lambda: rcm.core.status().rcs)
    apart, other = fleet.mesh("h1"), fleet.mesh("other")
    for one, two in product((apart, other), (first.mesh, rcm.mesh)):
        fleet.network.cut(one, two)
        fleet.network.cut(two, one)
    second = await offer(fleet, "h1", apart)
    held = Holder("tally", "tally", "other/one", Grant(term, 1), Place(term, 1), [RC], Decimal(60), 50.0)
    other.put(other.keys.grants, Grants(term, 1, 1, 0.5, {RC: [held]}, []))
    await until(lambda: told(second))
    kill(fleet, first)
    killed = fleet.watcher.now()
    await until(lambda: rcm.roster.reported(RC) is None)
    fleet.network.heal()
    healed = fleet.watcher.now()
    await until(lambda: "safe" in told(second))
    assert fleet.watcher.now() - healed < SECOND
    assert (second.holds.held, second.instances.state) == ({}, InstanceState.STANDS_BY)
    await until(lambda: second.instances.state is InstanceState.SERVES)
    assert fleet.watcher.now() - killed >= fleet.fleet.timing.hold_lease
    assert told(second) == ["begin tally", "safe"]


async def test_after_a_change_of_rcm_the_one_with_the_hold_is_meant() -> None:
    fleet = FakeFleet("h2", "h1")
    candidates = [fleet.candidate(host) for host in ("h1", "h2")]
    await until(lambda: candidates[1].rcm)
    first = await offer(fleet, "h9")
    client = fleet.client("one")
    await until(lambda: candidates[1].rcm and candidates[1].rcm.core.status().rcs)
    answer = await client.ask("tally", RC, seconds=600)
    client.open = [OpenRequest("tally", "tally", {RC: {}}, 0, Decimal(600), place=answer.place)]
    second = await offer(fleet, "h0")
    await asyncio.sleep(0.1)
    second.instances.take(second.instance)  # as though it had not heard
    await candidates[1].stop()
    await until(lambda: second.instances.state is InstanceState.STANDS_BY)
    assert (await confirms(client, grant_of(answer)), told(second)) == ([None], [])
    assert told(first) == ["begin tally"]
    await candidates[0].stop()


async def test_a_new_instance_on_the_same_host_follows_at_once_and_the_hold_ends() -> None:
    fleet, first, client = await offered()
    before = grant_of(await client.ask("tally", RC))
    fleet.network.freeze(first.mesh)
    first.supervisor.cancel()
    began = fleet.watcher.now()
    second = await offer(fleet, "h2")
    assert second.instances.state is InstanceState.SERVES
    await until(lambda: [one for one in client.notices if one.grant is not None and one.grant > before])
    assert fleet.watcher.now() - began < SECOND // 2
    assert told(second) == ["begin tally"]
    await asyncio.sleep(2)
    assert client.notices[-1].state == "running"
