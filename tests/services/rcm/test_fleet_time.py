"""The time by which dates of bookings go: told by leaders, and found out anew after a restart of all hosts."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from decimal import Decimal

import pytest

from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import NOON, BookedFleet, Disk, book, booked, do, led, record, states
from tests.services.rcm.kit import Refusal
from zscout.mesh import Reply
from zscout.messages import WINDOW, BookingsKept, BookingView, Cancel, OpenRequest, Release, ShareBookings, Unbook
from zscout.services.rcm.candidate import Candidate
from zscout.types import SECOND, Grant, Term


async def kill_all(fleet: BookedFleet, candidates: list[Candidate]) -> None:
    """All hosts are gone at once, and long enough for it to be known."""
    for one in candidates:
        fleet.network.kill(one.mesh)
    await asyncio.sleep(5)


async def first_back(fleet: BookedFleet, wall: float) -> Candidate:
    """The host `x` is back first, and leads before it knows the time of the fleet: its own clock shows `wall`."""
    fleet.ahead["x"] = wall - fleet.time()
    first = fleet.candidate("x")
    await until(lambda: first.rcm)
    assert first.rcm is not None
    assert not first.rcm.bookings.settled
    return first


@pytest.mark.parametrize("ahead", [3_600, -3_600])
async def test_a_leader_whose_clock_is_an_hour_off_goes_on_in_the_time_of_the_fleet(ahead: float) -> None:
    fleet = BookedFleet("x", "y", "z")
    fleet.ahead["y"] = ahead
    x, y, _ = await led(fleet, "x", "y", "z")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=200), BookingView)
    fleet.network.kill(x.mesh)
    await until(lambda: y.rcm)
    await client.ask("mine", "robot/a", seconds=100, booking="b")
    await asyncio.sleep(NOON + 199 - fleet.time())
    assert [notice.state for notice in client.notices].count("running") == 0
    await asyncio.sleep(2)
    assert client.notices[-1].state == "running"
    assert (await fleet.told()).clocks == {"y": pytest.approx(ahead, abs=2)}


async def test_fleet_time_is_corrected_once_where_most_clocks_differ_for_a_minute() -> None:
    fleet = BookedFleet("x", "y", "z")
    fleet.ahead |= {"y": 10.0, "z": 10.0}
    x = fleet.candidate("x")
    await until(lambda: x.rcm and x.rcm.bookings.settled)
    assert x.rcm is not None
    fleet.candidate("y"), fleet.candidate("z")
    began, ahead = fleet.time(), list[float]()
    for _ in range(300):
        await asyncio.sleep(1)
        ahead.append(round(x.rcm.bookings.dates.time - fleet.time(), 1))
    assert [*dict.fromkeys(ahead)] == [0.0, 10.0]
    assert 60 <= ahead.index(10.0) + began - NOON < 100
    assert (await fleet.told()).clocks == {"x": pytest.approx(-10, abs=0.1)}


@pytest.mark.parametrize("wrong", [-259_200, 259_200], ids=["behind", "ahead"])
async def test_the_clock_of_the_only_host_is_put_right(wrong: float, caplog: pytest.LogCaptureFixture) -> None:
    fleet = BookedFleet("x")
    fleet.ahead["x"] = wrong
    (x,) = await led(fleet, "x")
    client = fleet.client("one")
    await do(client, book("skipped", "robot/a", at=wrong + 500), BookingView)
    await do(client, book("now", "robot/b", at=wrong + 60, seconds=600), BookingView)
    await client.ask("mine", "robot/b", seconds=600, booking="now")
    await asyncio.sleep(100)
    assert x.rcm is not None
    (hold,) = (await fleet.state()).holds
    fleet.ahead["x"] = 0.0
    await asyncio.sleep(2)
    told = await fleet.told()
    assert told.time == pytest.approx(fleet.time(), abs=0.1)
    assert not told.clocks
    assert told.corrected is not None
    assert told.corrected.by == pytest.approx(-wrong, abs=1e-3)
    assert told.corrected.ago < 2
    assert "fleet time is put 3 d " + ("forward" if wrong < 0 else "back") in caplog.text
    # The hold keeps its length; its date never begins again.
    (same,) = (await fleet.state()).holds
    assert same.grant == hold.grant
    assert same.remaining == pytest.approx(hold.remaining - 2, abs=0.1)
    dangers = [(one.record.name, one.over) for one in fleet.dangers["x"]]
    assert dangers == ([("skipped", True)] if wrong < 0 else [])
    assert [view.name for view in told.bookings] == ([] if wrong < 0 else ["skipped"])
    await asyncio.sleep(same.remaining + 1)
    assert client.notices[-1].outcome == "completed"
    fleet.ahead["x"] = wrong - 1_000
    await asyncio.sleep(2)
    assert {name: states(view) for name, view in (await fleet.bookings()).items()} == {"skipped": ["open"]}
    with pytest.raises(Refusal, match="unknown_booking"):
        await client.ask("again", "robot/b", seconds=600, booking="now")


@pytest.mark.parametrize("first", ["x", "y"])
async def test_of_two_hosts_the_one_counts_whose_clock_is_synchronised(first: str) -> None:
    fleet = BookedFleet("x", "y")
    fleet.ahead["x"] = -259_200.0
    fleet.synchronised = {"y"}
    one = fleet.candidate(first)
    await until(lambda: one.rcm and one.rcm.bookings.settled)
    fleet.candidate("y" if first == "x" else "x")
    await asyncio.sleep(100)
    told = await fleet.told()
    assert told.time == pytest.approx(fleet.time(), abs=0.1)
    assert [*told.clocks] == ["x"]


async def test_who_waits_for_a_date_begins_as_the_clock_comes_to_it() -> None:
    fleet = BookedFleet("x")
    fleet.ahead["x"] = -259_200
    await led(fleet, "x")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=60, seconds=600), BookingView)
    await client.ask("mine", "robot/a", seconds=600, booking="b")
    fleet.ahead["x"] = 30.0
    await asyncio.sleep(2)
    assert [notice.state for notice in client.notices][-1:] == ["queued"]
    fleet.ahead["x"] = 100.0
    await asyncio.sleep(2)
    assert [notice.state for notice in client.notices][-1:] == ["running"]
    (hold,) = (await fleet.state()).holds
    assert fleet.time() + 100 + hold.remaining == pytest.approx(NOON + 660, abs=0.5)


@pytest.mark.parametrize("ahead", [100 * 86_400.0, -100 * 86_400.0], ids=["forward", "back"])
async def test_maintenance_without_an_end_lasts_though_the_clock_is_set(ahead: float) -> None:
    fleet = BookedFleet("x")
    await led(fleet, "x")
    client = fleet.client("one")
    await do(client, book("m", "robot/a", at=-1, seconds=WINDOW, maintenance=True, lasting=True), BookingView)
    await asyncio.sleep(2)
    fleet.ahead["x"] = ahead
    await asyncio.sleep(2)
    assert states((await fleet.bookings())["m"]) == ["open"]
    assert (await client.ask("mine", "robot/a")).state == "queued"
    await do(client, Unbook("m"), BookingView)
    await asyncio.sleep(1)
    assert client.notices[-1].state == "running"


async def test_a_new_leader_goes_on_in_the_corrected_time_though_one_host_missed_it() -> None:
    hosts = "x", "y", "z", "v"
    fleet = BookedFleet(*hosts)
    x, *others = await led(fleet, *hosts)
    await asyncio.sleep(5)  # their clocks are known
    fleet.part("v")
    fleet.ahead |= dict.fromkeys("xyz", -259_200.0)
    await asyncio.sleep(40)
    assert x.rcm is not None
    assert x.rcm.bookings.time == pytest.approx(fleet.time() - 259_200, abs=0.1)
    fleet.network.kill(x.mesh)
    fleet.network.heal()
    await asyncio.sleep(100)
    leaders = [one.rcm for one in others if one.rcm is not None]
    assert [one.bookings.time for one in leaders] == [pytest.approx(fleet.time() - 259_200, abs=0.1)]


async def test_after_a_restart_of_all_fleet_time_is_what_most_clocks_say() -> None:
    fleet, old = await booked("x", "y", "z")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=900), BookingView)
    await kill_all(fleet, old)
    # All begin three days behind, but for one, which is not the first; then their clocks are set one by one.
    fleet.ahead |= {"x": -259_200.0, "y": -259_201.0}
    x = fleet.candidate("x")
    await until(lambda: x.rcm)
    fleet.candidate("y"), fleet.candidate("z")
    await asyncio.sleep(40)
    assert (await fleet.told()).time == pytest.approx(fleet.time() - 259_200, abs=1.5)
    fleet.ahead["y"] = 0.0
    await asyncio.sleep(40)
    told = await fleet.told()
    assert told.time == pytest.approx(fleet.time(), abs=0.1)
    assert [*told.clocks] == ["x"]
    assert states((await fleet.bookings())["b"]) == ["open"]


async def test_what_changes_after_a_restart_of_all_counts_though_terms_begin_anew() -> None:
    fleet = BookedFleet("x", "y")
    before = Grant(Term(9, "old"), 50)
    asked = book("b", "robot/*", at=500, every=1, until=round(NOON) + 200_000)
    old = record(asked, owner="desk", made=before, changed=before)
    fleet.disks["y"] = Disk()
    fleet.disks["y"].records = [old]
    await led(fleet, "x")
    fleet.candidate("y")
    await asyncio.sleep(1)
    client = fleet.client("one", "desk")
    assert [date.bound for date in (await fleet.bookings())["b"].dates] == [{"robot/*": "robot/a"}] * 3
    for disk in fleet.disks.values():
        assert [len(one.kept) for one in disk.records] == [3]
        assert disk.records[0].changed > before
    # What is made later goes behind, in whatever half.
    await do(client, book("c", "robot/b", at=500), BookingView)
    assert {one.id: one.made > before for one in fleet.disks["y"].records} == {"b": False, "c": True}


async def test_a_booking_right_after_another_stands_though_fleet_time_is_corrected() -> None:
    fleet = BookedFleet("x", "y", "z")
    fleet.ahead |= {"y": -10.0, "z": -10.0}
    await led(fleet, "x")
    client = fleet.client("one")
    await do(client, book("first", "robot/a", at=20, seconds=100), BookingView)
    await do(client, book("next", "robot/a", at=120, seconds=100), BookingView)
    await asyncio.sleep(2)
    await client.ask("mine", "robot/a", seconds=100, booking="first")
    fleet.candidate("y"), fleet.candidate("z")
    for number in range(18):
        await asyncio.sleep(5)
        await do(client, book(f"other{number}", "robot/b", at=1_000 + 200 * number), BookingView)
        views = await fleet.bookings()
        assert states(views["next"]) == ["open"], f"at {fleet.time() - NOON:g}: {views['next'].dates}"
    assert states(views["first"]) == ["taken"]
    assert (await fleet.told()).time == pytest.approx(fleet.time() - 10, abs=0.1)


async def test_after_a_restart_of_all_hosts_nothing_is_decided_by_one_wrong_clock() -> None:
    fleet, old = await booked("x", "y", "z")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=300, patience=Decimal(30)), BookingView)
    await do(client, book("c", "robot/b", at=400), BookingView)
    await asyncio.sleep(1)
    await kill_all(fleet, old)
    # The first to be back is two days ahead, by which both would be over, and long forgotten.
    first = await first_back(fleet, fleet.time() + 2 * 86_400)
    with pytest.raises(Refusal, match="busy"):
        await do(client, book("d", "robot/a", at=900), BookingView)
    others = [fleet.candidate("y"), fleet.candidate("z")]
    await asyncio.sleep(5)
    assert len([one for one in (first, *others) if one.rcm]) == 1
    assert {name: states(view) for name, view in (await fleet.bookings()).items()} == {"b": ["open"], "c": ["open"]}
    waits = await client.ask("mine", "robot/a", seconds=100, booking="b")
    assert waits.state == "queued"
    await asyncio.sleep(NOON + 301 - fleet.time())
    assert client.notices[-1].state == "running"


async def test_what_ends_by_one_wrong_clock_after_a_restart_of_all_is_not_over() -> None:
    fleet, old = await booked("x", "y", "z")
    client = fleet.client("one")
    await do(client, book("m", "robot/a", at=300, maintenance=True), BookingView)
    await do(client, book("b", "robot/b", at=300, patience=Decimal(100)), BookingView)
    mine = await client.ask("mine", "robot/b", seconds=100, booking="b")
    client.open = [
        OpenRequest("mine", "mine", {"robot/b": {}}, 0, Decimal(100), place=mine.place, booking=mine.booking)
    ]
    await kill_all(fleet, old)
    # By the clock of the first to be back both end as it has just begun to lead.
    first = await first_back(fleet, NOON + 399.2)
    await asyncio.sleep(0.5)
    assert first.rcm is not None
    assert first.rcm.bookings.dates.time > NOON + 400
    fleet.candidate("y")
    fleet.candidate("z")
    await asyncio.sleep(5)
    views = await fleet.bookings()
    assert {name: states(view) for name, view in views.items()} == {"m": ["open"], "b": ["taken"]}


@pytest.mark.parametrize("ahead", [NOON + 310, NOON + 2 * 86_400], ids=["its date has come", "it is over"])
@pytest.mark.parametrize("known", [True, False], ids=["known", "not known"])
async def test_who_waits_for_a_date_does_not_begin_by_one_clock_after_all_restart(ahead: float, known: bool) -> None:
    fleet, old = await booked("x", "y", "z")
    client = fleet.client("one")
    await do(client, book("b", "robot/b", at=300, patience=Decimal(100)), BookingView)
    mine = await client.ask("mine", "robot/b", seconds=100, booking="b")
    await asyncio.sleep(1)
    client.open = [
        OpenRequest("mine", "mine", {"robot/b": {}}, 0, Decimal(100), place=mine.place, booking=mine.booking)
    ]
    await kill_all(fleet, old)
    fleet.disks["x"].records *= known
    first = await first_back(fleet, ahead)
    await asyncio.sleep(0.5)
    assert first.rcm is not None
    assert not first.rcm.bookings.settled
    assert first.rcm.bookings.dates.time > NOON + 300
    fleet.candidate("y")
    fleet.candidate("z")
    await asyncio.sleep(5)
    assert states((await fleet.bookings())["b"]) == ["taken"]
    assert "running" not in {notice.state for notice in client.notices}
    await asyncio.sleep(NOON + 301 - fleet.time())
    assert client.notices[-1].state == "running"


async def test_the_older_of_two_fleet_times_goes_on() -> None:
    fleet = BookedFleet("x", "y", "z")
    fleet.ahead["y"] = 7_200
    x, y, z = await led(fleet, "x", "y", "z")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=200, patience=Decimal(30)), BookingView)
    # One that starts anew while it is cut off knows nothing but its own clock, by which that is over.
    fleet.network.kill(y.mesh)
    await asyncio.sleep(2)
    again = fleet.candidate("y")
    fleet.part("y")
    await until(lambda: again.rcm and again.rcm.bookings.settled)
    assert again.rcm is not None
    assert again.rcm.bookings.dates.time == pytest.approx(fleet.time() + 7_200, abs=1)
    fleet.network.kill(x.mesh)
    # All that others answer is as old as the question to this one.
    fleet.silent()
    fleet.network.heal()
    await asyncio.sleep(70)
    leaders = [one.rcm for one in (again, z) if one.rcm is not None]
    assert [one.bookings.time for one in leaders] == [pytest.approx(fleet.time(), abs=0.1)]
    assert states((await fleet.bookings())["b"]) == ["open"]


@pytest.mark.parametrize(("took", "clocks"), [(0.9, {"y": pytest.approx(-5, abs=0.1)}), (1.1, {})])
async def test_a_clock_that_is_read_slowly_does_not_count(took: float, clocks: dict[str, float]) -> None:
    """Its answer may have waited while the leader stood still."""
    fleet, (x, *_) = await booked("x")
    assert x.rcm is not None
    sharing, now = x.rcm.sharing, x.mesh.now()
    kept = BookingsKept("y", True, fleet.time() - 5, "digest")
    reply = Reply(x.mesh.keys.bookings("y"), kept, arrived=now)
    sharing._take([reply], ShareBookings(x.rcm.term, "digest"), now - round(took * SECOND))
    assert (await fleet.told()).clocks == clocks


async def test_a_host_that_does_not_answer_turns_no_clock_back() -> None:
    """What others have answered is older by as long as it was waited for."""
    fleet, (x, *_) = await booked("x", "y", "z")
    asked = fleet.silent()
    await asyncio.sleep(120)
    assert asked
    assert x.rcm is not None
    assert x.rcm.bookings.time == pytest.approx(fleet.time(), abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
async def test_no_date_begins_twice_however_clocks_are_set(seed: int) -> None:
    rng = random.Random(seed)  # noqa: S311 - what failed once must fail again
    fleet = BookedFleet("x", "y")
    await led(fleet, "x", "y")
    client, begun = fleet.client("one"), Counter[str]()
    until_ = round(NOON) + 20 * 86_400
    await do(
        client, book("b", "robot/a", at=60, seconds=600, patience=Decimal(300), every=1, until=until_), BookingView
    )
    for number in range(20):
        ahead = fleet.ahead.get("x", 0.0)
        try:
            asked = await client.ask(f"r{number}", "robot/a", seconds=600, booking="b")
        except Refusal:
            asked = None
        # Its date comes, or another one: it is skipped, or was before.
        day = (NOON + 60 - fleet.time() - ahead) % 86_400
        ahead += rng.choice((0.0, day, day - 86_400, day + 86_400 * rng.randrange(-2, 3), rng.uniform(-700, 700)))
        fleet.ahead |= {"x": ahead, "y": ahead}
        await asyncio.sleep(rng.choice((2, 40, 400)))
        news = [notice for notice in client.notices if asked is not None and notice.id == asked.id]
        running = [notice for notice in news if notice.state == "running"] or ([asked] if asked else [])
        if running[:1] and running[0].state == "running":
            begun[running[0].booking] += 1
        fleet.ahead |= dict.fromkeys("xy", ahead := ahead + rng.choice((0.0, 0.0, 86_400.0, -86_400.0, -650.0)))
        await asyncio.sleep(2)
        if asked is not None:
            await client.do(Release(asked.id) if rng.random() < 0.7 or not running else Cancel(asked.id))
    assert begun
    assert set(begun.values()) == {1}
