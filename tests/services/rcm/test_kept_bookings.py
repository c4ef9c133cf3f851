"""Which hosts keep bookings, and what they forget."""

from __future__ import annotations

import asyncio

import pytest
from msgspec.structs import replace

from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import NOON, BookedFleet, Disk, book, booked, do, led, record, states
from tests.services.rcm.kit import Refusal
from zscout.keyexpr import Role, Token
from zscout.mesh.supervision import Supervisor
from zscout.messages import BookingView, Unbook
from zscout.services.bookings.keeper import MAX_SAVING, BookingKeeper
from zscout.services.bookings.records import MAX_BYTES
from zscout.testing.memory import MemoryTransport
from zscout.types import Place, Term


async def test_a_fleet_restarted_whole_reads_its_bookings() -> None:
    fleet, both = await booked("x", "y")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=500), BookingView)
    await do(client, book("gone", "robot/b", at=500), BookingView)
    fleet.network.kill(both[1].mesh)
    await asyncio.sleep(3)
    await do(client, Unbook("gone"), BookingView)
    fleet.network.kill(both[0].mesh)
    await asyncio.sleep(60)
    # The one that had not heard of it leads at first.
    second = fleet.candidate("y")
    await until(lambda: second.rcm)
    fleet.candidate("x")
    await asyncio.sleep(5)
    views = await fleet.bookings()
    assert set(views) == {"b"}
    assert views["b"].dates[0].start == NOON + 500


async def test_what_is_long_over_is_forgotten_by_all_who_keep_bookings() -> None:
    fleet = BookedFleet("x", "y")
    await led(fleet, "x", "y")
    await do(fleet.client("one"), book("b", "robot/a", at=5_000), BookingView)
    await asyncio.sleep(600)  # a fleet time that was just found out may be days ahead
    # A host with RCs, which can't lead, comes back after a month.
    old = record(book("old", "robot/a", at=-86_400 * 30))
    fleet.disks["far"] = Disk()
    fleet.disks["far"].records = [old]
    far = BookingKeeper(fleet.mesh("far"), fleet.disks["far"], candidate=False, wall=fleet.time)
    far.start(Supervisor("far", lambda error: pytest.fail(str(error))))
    far.mesh.alive(Token("far", Role.NODE, "node", "1"))
    await asyncio.sleep(40)
    assert {disk: [one.id for one in fleet.disks[disk].records] for disk in ("x", "y", "far")} == {
        "x": ["b"],
        "y": ["b"],
        "far": ["b"],
    }
    assert far.shared.is_set()


async def test_a_keeper_that_was_busy_is_told_before_long() -> None:
    fleet, (*_, last) = await booked("x", "y", "z")
    client = fleet.client("one")
    last.learned.keeper._waiting = MAX_SAVING
    await do(client, book("b", "robot/a", at=500), BookingView)
    await asyncio.sleep(1)
    assert not fleet.disks["z"].records
    last.learned.keeper._waiting = 0
    await asyncio.sleep(6)
    assert [one.id for one in fleet.disks["z"].records] == ["b"]


async def test_a_host_that_has_no_room_for_a_booking_does_not_keep_it() -> None:
    fleet, (_, other) = await booked("x", "y")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=500), BookingView)
    other.learned.keeper.records.size = MAX_BYTES
    with pytest.raises(Refusal, match="not_kept"):
        await do(client, book("c", "robot/b", at=500), BookingView)
    with pytest.raises(Refusal, match="not_kept"):
        await do(client, Unbook("b"), BookingView)
    other.learned.keeper.records.size = 1_000
    assert (await do(client, Unbook("b"), BookingView)).unbooked


async def test_what_becomes_of_one_booking_is_not_told_of_another() -> None:
    fleet, (leader, other) = await booked("x", "y")
    await do(fleet.client("one"), book("b", "robot/a", at=500), BookingView)
    (known,) = other.learned.keeper.records
    other.learned.keeper.records.size = MAX_BYTES
    assert leader.rcm is not None
    sharing = leader.rcm.sharing

    async def catch_up() -> str:
        async with sharing._sharing:
            await sharing._share()
        return ""

    # The second tells of the fourth as well, and the third of nothing.
    new = leader.learned.keeper.records.take(replace(known, id=name) for name in "cde")
    keeping = [sharing.keep(record) for record in new]
    kept = await asyncio.gather(*keeping[:2], catch_up(), keeping[2])
    assert [*map(bool, kept)] == [True, True, False, True]


async def test_a_booking_that_one_leader_could_not_keep_stands_where_another_one_has_it() -> None:
    fleet, (_, y) = await booked("x", "y")
    here, there = fleet.client("here", "x"), fleet.client("there", "y")
    fleet.part("y")
    await until(lambda: y.rcm)
    fleet.disks["x"].broken = True
    with pytest.raises(Refusal, match="not_kept"):
        await do(here, book("b", "robot/a", at=500), BookingView)
    assert await fleet.bookings() == {}
    fleet.disks["x"].broken = False
    # Whoever asked asks again, and finds the leader of the other half.
    await do(there, book("b", "robot/a", at=500), BookingView)
    fleet.network.heal()
    await asyncio.sleep(10)
    assert states((await fleet.bookings())["b"]) == ["open"]


async def test_who_took_up_a_booking_that_this_leader_can_not_keep_waits_for_its_date() -> None:
    fleet, _ = await booked("x")
    fleet.disks["x"].broken = True
    client = fleet.client("one")
    # Another leader has made it, and is gone; what its program had asked that one arrives here late.
    place = Place(Term(0, "elsewhere"), 1)
    await client.ask("mine", "robot/a", seconds=100, place=place, booking="b@1800000500")
    with pytest.raises(Refusal, match="not_kept"):
        await do(client, book("b", "robot/a", at=500), BookingView)
    await asyncio.sleep(5)
    assert client.notices[-1].reason == "the time of its booking is still to come"
    assert {notice.state for notice in client.notices} == {"queued"}
    await asyncio.sleep(NOON + 501 - fleet.time())
    assert client.notices[-1].state == "running"


def forget_how_to_ask(fleet: BookedFleet, host: str) -> None:
    """The links to a host have come back without what it had declared to be asked by about bookings."""
    (mesh,) = (mesh for mesh in fleet.meshes if mesh.me.host == host)
    session = mesh._transport.current
    assert isinstance(session, MemoryTransport)
    forgotten = {one for one in session.queryables.all if "/bookings" in str(one)}
    assert forgotten
    for other in fleet.network.nodes:
        fleet.network.between(session, other).hidden |= forgotten


async def test_a_keeper_that_nobody_asks_joins_the_mesh_anew() -> None:
    fleet, _ = await booked("x", "y")
    client = fleet.client("one", "x")
    await asyncio.sleep(1)
    forget_how_to_ask(fleet, "y")
    with pytest.raises(Refusal, match="not_kept"):
        await do(client, book("b", "robot/a", at=500), BookingView)
    await asyncio.sleep(60)
    await do(client, book("c", "robot/a", at=700), BookingView)
    await asyncio.sleep(1)
    assert [record.id for record in fleet.disks["y"].records][-1] == "c"


async def test_a_keeper_that_can_not_lead_and_that_nobody_asks_joins_the_mesh_anew() -> None:
    fleet, _ = await booked("x", "y")
    mesh, disk = fleet.mesh("far"), fleet.disks.setdefault("far", Disk())
    far = BookingKeeper(mesh, disk, candidate=False, wall=fleet.time)
    far.start(Supervisor("far", lambda error: pytest.fail(str(error))))
    token = mesh.alive(Token("far", Role.NODE, "node", "1"))
    session, client = mesh._transport.current, fleet.client("one", "x")
    await asyncio.sleep(100)
    await do(client, book("a", "robot/a", at=500), BookingView)
    await asyncio.sleep(1)
    assert mesh._transport.current is session, "it joined anew though it was asked"
    forget_how_to_ask(fleet, "far")
    await do(client, book("b", "robot/a", at=700), BookingView)
    await asyncio.sleep(20)
    assert [record.id for record in disk.records] == ["a"]
    assert mesh._transport.current is session, "it joined anew though it had been asked lately"
    await asyncio.sleep(60)
    assert [record.id for record in disk.records] == ["a", "b"]
    # Fleet time is for those that may lead.
    assert far.time is None
    far.stop()
    token.close()
