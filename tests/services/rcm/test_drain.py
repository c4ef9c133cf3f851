"""Maintenance of hosts and patterns on a mesh in memory: what is granted meanwhile, over changes of leader."""

from __future__ import annotations

import asyncio
from decimal import Decimal
from typing import Any

import pytest

from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import NOON, BookedFleet, book, booked, do, states
from tests.services.rcm.kit import FakeClient, Refusal, request
from zscout.messages import WINDOW, Book, BookingView, Unbook
from zscout.services.bookings.dates import last_end

SPAN = Decimal(WINDOW)


def drained(fleet: BookedFleet, name: str = "d", need: str = "@devices", **more: Any) -> Book:
    """From now on, until it is given up."""
    terms = {
        "priority": 1_000_000,
        "start": round(fleet.time()),
        "runtime": SPAN,
        "patience": SPAN,
        "lasting": True,
        **more,
    }
    return Book(id=name, name=name, needs={need: {}}, maintenance=True, **terms)


async def held(fleet: BookedFleet, *, keep: bool = True) -> FakeClient:
    """A client that holds robot/a for 60 s at least."""
    client = fleet.client("one")
    holder = await client.do(request("mine", "robot/a", seconds=60, keep=keep))
    assert holder.state == "running"
    return client


async def test_a_drained_host_grants_nothing_and_its_holder_has_its_minimum_runtime() -> None:
    fleet, _ = await booked("x")
    client, other = await held(fleet), fleet.client("two")
    made = await do(other, drained(fleet), BookingView)
    assert made.maintained == ["robot/a", "robot/b"]
    for priority in (0, 999_999):
        told = await other.ask(f"p{priority}", "robot/b", priority=priority)
        assert (told.state, told.reason) == ("queued", "maintenance of robot/b by d")
    late = fleet.rc("robot/c")
    await fleet.joined(late)
    assert (await other.ask("late", "robot/c")).state == "queued"
    assert (await fleet.bookings(rc="robot/c"))["d"].maintained == ["robot/a", "robot/b", "robot/c"]
    assert not client.notices
    await asyncio.sleep(60)
    await until(lambda: client.notices[-1].state == "ended")
    assert (client.notices[-1].outcome, client.notices[-1].reason[:22]) == ("completed", "maintenance of robot/a")
    await do(other, Unbook("d"), BookingView)
    await until(lambda: other.notices[-1].state == "running")


async def test_an_urgent_drain_ends_holds_at_once_and_their_requests_wait() -> None:
    fleet, _ = await booked("x")
    client, other = await held(fleet, keep=False), fleet.client("two")
    await do(other, drained(fleet), BookingView)
    assert not client.notices
    await do(other, drained(fleet, "now", urgent=True), BookingView)
    await until(lambda: client.notices[-1].state == "queued")
    assert client.notices[-1].outcome == "preempted"
    for name in ("d", "now"):
        await do(other, Unbook(name), BookingView)
    await until(lambda: client.notices[-1].state == "running")


async def test_a_drain_outlives_its_leader_and_the_next_places_nothing_there() -> None:
    fleet, (leader, heir) = await booked("x", "y")
    client = fleet.client("one")
    await do(client, drained(fleet), BookingView)
    assert leader.placer is not None
    assert leader.placer._core.maintained == ["devices"]
    fleet.network.kill(leader.mesh)
    await until(lambda: heir.rcm)
    assert (await client.ask("late", "robot/a")).reason[:22] == "maintenance of robot/a"
    await until(lambda: heir.placer)
    assert heir.placer is not None
    assert heir.placer._core.cordoned == {"devices"}
    assert heir.ledger.inherited().cordoned == set()
    await do(client, Unbook("d"), BookingView)
    assert heir.placer._core.cordoned == set()
    await until(lambda: client.notices[-1].state == "running")


async def test_a_host_in_maintenance_at_a_date_is_cordoned_for_that_time() -> None:
    fleet, (leader,) = await booked("x")
    client = fleet.client("one")
    terms: dict[str, Any] = {
        "start": round(NOON + 50),
        "runtime": Decimal(20),
        "patience": Decimal(20),
        "lasting": False,
        "priority": 10,
    }
    await do(client, drained(fleet, **terms), BookingView)
    placer = leader.placer
    assert placer is not None
    assert placer._core.cordoned == set()
    await asyncio.sleep(NOON + 50 - fleet.time() + 0.01)
    assert placer._core.cordoned == {"devices"}
    await asyncio.sleep(20)
    assert placer._core.cordoned == set()


async def test_bookings_on_a_drained_host_are_in_conflict_until_it_is_used_again() -> None:
    fleet, _ = await booked("x")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=500), BookingView)
    await do(client, drained(fleet), BookingView)
    told = (await fleet.bookings())["b"]
    assert (states(told), told.dates[0].danger) == (["conflict"], "d of desk takes precedence")
    with pytest.raises(Refusal, match=r"not_free.*booked then: d of desk \(@devices\)"):
        await do(client, book("c", "robot/b", at=500), BookingView)
    await do(client, Unbook("d"), BookingView)
    assert states((await fleet.bookings())["b"]) == ["open"]


async def test_a_drain_lasts_and_what_is_left_of_it_is_forgotten_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("booked_dates", "booking_handler"):
        monkeypatch.setattr(f"zscout.services.rcm.{module}.WINDOW", 60)
    fleet, (leader, _) = await booked("x", "y")
    client = fleet.client("one")
    await do(client, drained(fleet, runtime=Decimal(60), patience=Decimal(60)), BookingView)
    assert leader.placer is not None
    for number in range(9):
        await asyncio.sleep(20)
        [date] = (await fleet.bookings())["d"].dates
        assert date.start <= fleet.time() < date.end - 29
        assert (await client.ask(f"late{number}", "robot/a")).state == "queued"
        assert leader.placer._core.cordoned == {"devices"}
    await do(client, Unbook("d"), BookingView)
    [record] = fleet.disks["y"].records
    assert record.unbooked
    assert last_end(record) <= fleet.time() + 60


@pytest.mark.parametrize(
    ("need", "more", "why"),
    [
        ("robot/x", {}, "unknown_device"),
        ("camera/*", {}, "unknown_device.*no device matches camera/*"),
        ("@a b", {}, "bad_request.*host"),
        ("@devices", {"maintenance": False, "lasting": False}, "bad_request.*device"),
        ("robot/a", {"maintenance": False}, "bad_request.*only maintenance can be urgent or lasting"),
    ],
)
async def test_maintenance_of_what_is_unknown_or_malformed_is_refused(
    need: str, more: dict[str, Any], why: str
) -> None:
    fleet, _ = await booked("x")
    made = drained(fleet, need=need)
    made = Book(**{name: getattr(made, name) for name in Book.__struct_fields__} | {"priority": 0} | more)
    await asyncio.sleep(5)
    with pytest.raises(Refusal, match=why):
        await do(fleet.client("one"), made, BookingView)
