"""Bookings on a mesh in memory: made, kept by others, taken up, given up; over changes of leader, partitions and
restarts."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from decimal import Decimal
from typing import Any, TypeVar

import pytest
from msgspec.structs import replace

from tests.mesh.kit import run, until
from tests.services.rcm.kit import FakeClient, FakeFleet, Refusal, request
from zscout.keyexpr import Role, Token
from zscout.lab.faults.memory import MemoryMesh, MemoryTransport
from zscout.mesh import IncomingQuery
from zscout.mesh.supervision import Supervisor
from zscout.messages import (
    Book,
    BookingRecord,
    BookingsAsk,
    BookingsTold,
    BookingView,
    FindSlots,
    OpenRequest,
    Operation,
    Release,
    ShareBookings,
    SlotsTold,
    Unbook,
)
from zscout.services.bookings.keeper import MAX_SAVING, BookingKeeper
from zscout.services.bookings.records import MAX_BYTES
from zscout.services.rcm.bookings import BookedDanger
from zscout.services.rcm.candidate import Candidate
from zscout.types import Grant, Place, Term

R = TypeVar("R")
FIELDS = Book.__struct_fields__
NOON = 1_800_000_000.0
"""Seconds since 1970 at the beginning of each story."""


class Disk:
    """What outlives a process, in memory."""

    def __init__(self) -> None:
        self.records: list[BookingRecord] = []
        self.broken = False

    def read(self) -> list[BookingRecord]:
        return list(self.records)

    async def write(self, records: list[BookingRecord]) -> None:
        if self.broken:
            raise OSError("no space left")
        self.records = list(records)


class BookedFleet(FakeFleet):
    """Candidates with disks and clocks of their own."""

    def __init__(self, *candidates: str) -> None:
        self.meshes: list[MemoryMesh] = []
        super().__init__(*candidates, strategy="adaptive")
        self.disks: dict[str, Disk] = {}
        self.ahead: dict[str, float] = {}
        """By how many seconds a host's clock is ahead."""
        loop = asyncio.get_running_loop()
        begun = loop.time()
        self.time: Callable[[], float] = lambda: NOON + loop.time() - begun

    def mesh(self, host: str, client: str = "node") -> MemoryMesh:
        self.meshes.append(super().mesh(host, client))
        return self.meshes[-1]

    def part(self, host: str) -> None:
        """Cuts the links between a host and all others."""
        for one in self.meshes:
            for other in self.meshes:
                if (one.me.host == host) is not (other.me.host == host):
                    self.network.cut(one, other)

    def candidate(self, host: str, *_: Any, **how: Any) -> Candidate:
        disk = self.disks.setdefault(host, Disk())
        mesh = self.mesh(host)
        ahead = self.ahead.get(host, 0.0)
        keeper = BookingKeeper(mesh, disk, wall=lambda: self.time() + ahead)
        candidate = Candidate(mesh, self.fleet, keeper=keeper, **how)
        candidate.start()
        return candidate

    def silent(self) -> list[IncomingQuery[ShareBookings]]:
        """A host that answers no question about bookings: those that it was asked."""
        mesh, asked = self.mesh("silent"), list[IncomingQuery[ShareBookings]]()
        mesh.serve(mesh.keys.bookings("silent"), ShareBookings, asked.append)
        return asked

    async def bookings(self, **asked: Any) -> dict[str, BookingView]:
        key = self.watcher.keys.rcm_bookings
        reply = await self.watcher.ask_one(key, BookingsAsk(**asked), BookingsTold, timeout=1)
        assert reply is not None
        assert reply.message is not None, reply.problem
        return {view.id: view for view in reply.message.bookings}


async def do(client: FakeClient, operation: Operation, kind: type[R]) -> R:
    reply = await client.mesh.ask_one(client.mesh.keys.schedule(client.mesh.me), operation, kind, timeout=10)
    assert reply is not None, "the RCM did not answer"
    if reply.message is None:
        assert reply.problem is not None
        raise Refusal(reply.problem)
    return reply.message


def book(name: str, *needs: str, at: float, seconds: float = 100, **more: Any) -> Book:
    """A booking whose id is its name; `at`: seconds after the beginning of the story."""
    wanted = request(name, *needs).needs
    settings = {"priority": 0, "patience": Decimal(20), **more}
    return Book(id=name, name=name, needs=wanted, start=round(NOON + at), runtime=Decimal(str(seconds)), **settings)


async def led(fleet: BookedFleet, *hosts: str) -> list[Candidate]:
    """Candidates, of which one leads, and two robots that count as there."""
    candidates = [fleet.candidate(host) for host in hosts]
    robots = [fleet.rc(f"robot/{name}") for name in "ab"]
    await until(lambda: any(one.rcm is not None and one.rcm.bookings.settled for one in candidates))
    await fleet.joined(*robots)
    return candidates


def states(view: BookingView) -> list[str]:
    return [date.state for date in view.dates]


def test_a_booking_is_kept_by_another_candidate_and_taken_up_at_its_date() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        await led(fleet, "x", "y")
        client, other = fleet.client("one"), fleet.client("two")
        made = await do(client, book("b", "robot/a", "robot/*", at=50), BookingView)
        assert states(made) == ["open"]
        assert made.dates[0].bound == {"robot/*": "robot/b"}
        assert made.owner == "desk"
        # It is on both disks before it is acknowledged.
        assert [record.id for disk in fleet.disks.values() for record in disk.records] == ["b", "b"]
        # Who would not be over by then waits, and who would be runs.
        assert (await other.ask("long", "robot/a", seconds=60)).state == "queued"
        assert (await other.ask("short", "robot/a", seconds=20)).state == "running"
        waits = await client.ask("mine", "robot/a", "robot/*", seconds=100, booking="b")
        assert waits.state == "queued"
        assert waits.booking == f"b@{round(NOON + 50)}"
        assert states((await fleet.bookings())["b"]) == ["taken"]
        await asyncio.sleep(NOON + 50 - fleet.time() + 0.01)
        await until(lambda: client.notices[-1].state == "running")
        assert client.notices[-1].rcs == ["robot/a", "robot/b"]
        assert client.notices[-1].remaining == pytest.approx(100, abs=0.1)

    run(story())


def test_slots_are_the_times_between_bookings() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        await led(fleet, "x")
        client = fleet.client("one")
        await do(client, book("b", "robot/a", at=50), BookingView)
        await do(client, book("c", "robot/b", at=250), BookingView)
        needs = request("s", "robot/a", "robot/b").needs
        asked = FindSlots("s", needs, 0, Decimal(60), within=1_000)
        told = await do(client, asked, SlotsTold)
        assert told.complete
        assert [(slot.start - NOON, slot.latest - NOON) for slot in told.slots] == [
            (150, 190),
            (350, pytest.approx(1_000, abs=2)),
        ]
        with pytest.raises(Refusal, match=r"not_free.*robot/a.*booked then: b of desk"):
            await do(client, book("d", "robot/a", at=100), BookingView)
        assert (await do(client, Unbook("b"), BookingView)).unbooked
        await do(client, book("d", "robot/a", at=100), BookingView)
        # The same again is the same booking.
        assert (await do(client, book("d", "robot/a", at=100), BookingView)).id == "d"
        assert set(await fleet.bookings()) == {"c", "d"}

    run(story())


def test_a_date_that_is_not_repeated_is_kept_free_however_far_ahead() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        await led(fleet, "x")
        client = fleet.client("one")
        far = 300 * 86_400
        await do(client, book("b", "robot/a", at=far), BookingView)
        assert states((await fleet.bookings())["b"]) == ["open"]
        with pytest.raises(Refusal, match=r"not_free.*booked then: b of desk"):
            await do(client, book("c", "robot/a", at=far + 50), BookingView)
        assert (await do(client, Unbook("b"), BookingView)).unbooked
        await do(client, book("c", "robot/a", at=far + 50), BookingView)
        assert set(await fleet.bookings()) == {"c"}

    run(story())


def test_slots_go_by_what_was_asked_for_and_tell_what_is_likely() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        await led(fleet, "x")
        client, other = fleet.client("one"), fleet.client("two")
        asked = FindSlots("s", request("s", "robot/a").needs, 0, Decimal(60), within=1_000)
        for number in range(4):
            await other.do(replace(request("survey", "robot/a", seconds=600), id=f"survey{number}"))
            begun = fleet.time()
            told = await do(client, asked, SlotsTold)
            assert told.slots[0].start == pytest.approx(begun + 600, abs=2)
            assert told.likely == (None if number < 3 else pytest.approx(begun + 30, abs=2))
            await asyncio.sleep(30)
            await other.do(Release(f"survey{number}"))

    run(story())


def test_votes_decide_about_a_sharable_rc() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        await led(fleet, "x")
        radio = fleet.rc("radio/rf0", accept=True)
        await fleet.joined(radio)
        client = fleet.client("one")
        await do(client, book("b", "radio/rf0:5", at=50), BookingView)
        await do(client, book("c", "radio/rf0:5", at=60), BookingView)
        assert {one.id.partition("@")[0] for one in radio.proposals[-1].holders} == {"b", "c"}
        radio.accept = False
        with pytest.raises(Refusal, match=r"not_free"):
            await do(client, book("d", "radio/rf0:5", at=70), BookingView)
        radio.accept = None
        with pytest.raises(Refusal, match="busy"):
            await do(client, book("e", "radio/rf0:1", at=55, seconds=10), BookingView)

    run(story())


def test_a_booking_outlives_its_leader_and_its_taker_goes_on() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        leader, heir = await led(fleet, "x", "y")
        client = fleet.client("one")
        await do(client, book("b", "robot/a", at=50, every=1, until=round(NOON + 86_400 * 3 + 50)), BookingView)
        waits = await client.ask("mine", "robot/a", seconds=100, booking="b")
        fleet.network.kill(leader.mesh)
        await until(lambda: heir.rcm)
        view = (await fleet.bookings())["b"]
        assert states(view) == ["open", "open", "open", "open"]
        # Its client asks again, by the name that it was told.
        again = await client.ask("mine", "robot/a", seconds=100, place=waits.place, booking=waits.booking)
        assert again.state == "queued"
        assert states((await fleet.bookings())["b"]) == ["taken", "open", "open", "open"]
        await asyncio.sleep(NOON + 51 - fleet.time())
        assert client.notices[-1].state == "running"
        await asyncio.sleep(100)
        assert states((await fleet.bookings())["b"]) == ["open", "open", "open"]
        assert fleet.disks["y"].records[0].over == [round(NOON + 50)]

    run(story())


def test_a_fleet_restarted_whole_reads_its_bookings() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        both = await led(fleet, "x", "y")
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

    run(story())


def test_two_halves_book_the_same_and_the_earlier_of_the_higher_priority_stands() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        x, y = await led(fleet, "x", "y")
        assert x.rcm is not None
        here, there = fleet.client("here", "x"), fleet.client("there", "y")
        await do(here, book("both", "robot/b", at=900), BookingView)
        far = fleet.rc("robot/far")
        await fleet.joined(far)
        fleet.part("y")
        await until(lambda: y.rcm)
        await do(here, book("low", "robot/a", at=500), BookingView)
        await do(here, book("high", "robot/b", at=500, priority=5), BookingView)
        # Its only other candidate is seen no more, and so its disk has to do, which fails.
        fleet.disks["x"].broken = True
        with pytest.raises(Refusal, match="not_kept"):
            await do(here, book("lost", "robot/far", at=500), BookingView)
        fleet.disks["x"].broken = False
        await do(there, book("higher", "robot/a", at=500, priority=2), BookingView)
        await do(there, book("lower", "robot/b", at=550, priority=4), BookingView)
        await do(there, Unbook("both"), BookingView)
        fleet.network.heal()
        await asyncio.sleep(70)
        views = await fleet.bookings()
        assert {name: states(view) for name, view in views.items()} == {
            "low": ["conflict"],
            "high": ["open"],
            "higher": ["open"],
            "lower": ["conflict"],
        }
        assert views["low"].dates[0].danger == "higher of y stands"
        # Where that one is given up the other stands.
        await do(there, Unbook("higher"), BookingView)
        await asyncio.sleep(1)
        assert states((await fleet.bookings())["low"]) == ["open"]

    run(story())


def test_who_took_up_a_date_that_is_in_conflict_waits_for_it_and_has_it_once_it_stands() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        _, y = await led(fleet, "x", "y")
        here, there = fleet.client("here", "x"), fleet.client("there", "y")
        fleet.part("y")
        await until(lambda: y.rcm)
        await do(here, book("low", "robot/a", at=500), BookingView)
        waits = await here.ask("mine", "robot/a", seconds=100, booking="low")
        await do(there, book("higher", "robot/a", at=500, priority=2), BookingView)
        fleet.network.heal()
        await asyncio.sleep(70)
        place, booking = waits.place, waits.booking
        again = await here.ask("mine", "robot/a", seconds=100, place=place, booking=booking)
        assert (again.state, again.booking) == ("queued", "low@1800000500")
        await asyncio.sleep(70)
        assert states((await fleet.bookings())["low"]) == ["conflict"]
        assert [notice.state for notice in here.notices].count("running") == 0
        await do(there, Unbook("higher"), BookingView)
        await asyncio.sleep(1)
        assert states((await fleet.bookings())["low"]) == ["taken"]
        await asyncio.sleep(NOON + 501 - fleet.time())
        assert here.notices[-1].state == "running"

    run(story())


def test_who_took_up_a_date_that_its_leader_does_not_know_yet_waits_for_it_and_has_it() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        (leader,) = await led(fleet, "x")
        await do(fleet.client("there", "y"), book("b", "robot/b", at=500), BookingView)
        (known,) = leader._keeper.records
        hers, not_hers = (fleet.client("one", host) for host in ("y", "z"))
        for number, client in enumerate((hers, not_hers), 1):
            place = Place(Term(0, "elsewhere"), number)
            told = await client.ask("mine", "robot/a", seconds=100, place=place, booking="late@1800000500")
            assert (told.state, told.reason) == ("queued", "the time of its booking is still to come")
        leader._keeper.records.take([replace(known, id="late", name="late", needs={"robot/a": {}})])
        leader._keeper.on_shared()
        await asyncio.sleep(1)
        assert states((await fleet.bookings())["late"]) == ["taken"]
        await asyncio.sleep(NOON + 501 - fleet.time())
        assert hers.notices[-1].state == "running"
        assert "running" not in {notice.state for notice in not_hers.notices}

    run(story())


@pytest.mark.parametrize("ahead", [3_600, -3_600])
def test_a_leader_whose_clock_is_an_hour_off_goes_on_in_the_time_of_the_fleet(ahead: float) -> None:
    async def story() -> None:
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
        reply = await fleet.watcher.ask_one(fleet.watcher.keys.rcm_bookings, BookingsAsk(), BookingsTold, timeout=1)
        assert reply is not None
        assert reply.message is not None
        assert reply.message.clocks == {"y": pytest.approx(ahead, abs=2)}

    run(story())


def test_what_is_no_booking_is_refused_in_one_line() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        await led(fleet, "x")
        client = fleet.client("one")
        good = book("b", "robot/a", at=50)
        for wrong, code in [
            (replace(good, start=round(NOON - 100)), "bad_date"),
            (replace(good, start=round(NOON + 400 * 86_400)), "bad_date"),
            (replace(good, every=1), "bad_date"),
            (replace(good, every=1, until=round(NOON + 86_400 * 9), runtime=Decimal(86_000)), "bad_date"),
            (replace(good, zone="Europe/Nowhere"), "bad_request"),
            (replace(good, zone="../../etc/passwd"), "bad_request"),
            (replace(good, needs={"robot": {}}), "bad_name"),
            (replace(good, runtime=Decimal(0)), "bad_request"),
            (replace(good, runtime=Decimal("1e400")), "bad_request"),
            (replace(good, priority=10**9), "bad_request"),
            (replace(good, maintenance=True, needs={"robot/*": {}}), "bad_request"),
        ]:
            with pytest.raises(Refusal) as refusal:
                await do(client, wrong, BookingView)
            assert refusal.value.code in {code, "bad_request"}, wrong
        with pytest.raises(Refusal, match="unknown_booking"):
            await do(client, Unbook("nobody"), BookingView)
        await do(client, good, BookingView)
        with pytest.raises(Refusal, match=r"bad_request.*needs"):
            await client.ask("mine", "robot/b", booking="b")
        with pytest.raises(Refusal, match="unknown_booking"):
            await client.ask("mine", "robot/a", booking="c")
        assert set(await fleet.bookings()) == {"b"}

    run(story())


def test_other_strategies_keep_no_bookings() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        fleet.fleet = replace(fleet.fleet, strategy="priority")
        await led(fleet, "x")
        with pytest.raises(Refusal, match=r'wrong_strategy.*"adaptive"'):
            await do(fleet.client("one"), book("b", "robot/a", at=50), BookingView)

    run(story())


def test_fleet_time_does_not_jump_in_a_reign() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y", "z")
        fleet.ahead |= {"y": 10.0, "z": 10.0}
        x = fleet.candidate("x")
        await until(lambda: x.rcm)
        assert x.rcm is not None
        await until(lambda: x.rcm and x.rcm.bookings.settled)
        dates = x.rcm.bookings.dates
        assert dates.time == pytest.approx(fleet.time(), abs=0.1)
        fleet.candidate("y"), fleet.candidate("z")
        last, at = dates.time, fleet.time()
        for _ in range(1_500):
            await asyncio.sleep(1)
            gone = dates.time - last
            assert 0.989 < gone / (fleet.time() - at) < 1.011
            last, at = dates.time, fleet.time()
        assert dates.time == pytest.approx(fleet.time() + 10, abs=0.1)

    run(story())


def test_maintenance_goes_before_what_is_booked_and_both_are_told() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        await led(fleet, "x")
        client = fleet.client("one")
        await do(client, book("b", "robot/a", at=300), BookingView)
        drain = await do(client, book("m", "robot/a", "robot/b", at=200, seconds=200, maintenance=True), BookingView)
        assert drain.priority == fleet.fleet.operator_priority
        views = await fleet.bookings()
        assert states(views["m"]) == ["open"]
        assert states(views["b"]) == ["conflict"]
        assert views["b"].dates[0].danger == "m of desk stands"
        with pytest.raises(Refusal, match=r"bad_request.*nobody takes it up"):
            await client.ask("mine", "robot/a", "robot/b", booking="m", priority=drain.priority)
        kept = await client.ask("kept", "robot/b", seconds=30, keep=True)
        late = await client.ask("late", "robot/a", seconds=250, estimate=True)
        assert (kept.state, late.state) == ("running", "queued")
        assert late.starts_in == pytest.approx(400 - (fleet.time() - NOON), abs=1)
        await asyncio.sleep(NOON + 201 - fleet.time())
        assert [(one.state, one.outcome) for one in client.notices if one.id == "kept"][-1] == ("ended", "completed")
        await asyncio.sleep(200)
        assert [one.state for one in client.notices if one.id == "late"][-1] == "running"

    run(story())


def test_a_booking_is_in_danger_while_what_it_needs_is_away() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        (leader,) = await led(fleet, "x")
        assert leader.rcm is not None
        dangers: list[BookedDanger] = []
        leader.rcm.bookings.on_danger = dangers.append
        far = fleet.rc("robot/far")
        await fleet.joined(far)
        client = fleet.client("one")
        await do(client, book("b", "robot/far", at=300), BookingView)
        fleet.network.kill(far.mesh)
        await asyncio.sleep(3)
        assert "robot/far" in (await fleet.bookings())["b"].dates[0].danger
        back = fleet.rc("robot/far")
        await fleet.joined(back)
        assert not (await fleet.bookings())["b"].dates[0].danger
        # What passes at once is not told.
        assert dangers == []
        fleet.network.kill(back.mesh)
        await asyncio.sleep(10)
        await fleet.joined(fleet.rc("robot/far"))
        await asyncio.sleep(10)
        assert [(one.record.id, bool(one.why)) for one in dangers] == [("b", True), ("b", False)]

    run(story())


def test_of_all_dates_of_a_booking_a_danger_is_told_once_and_the_next_dates_first() -> None:
    async def story() -> None:
        fleet = BookedFleet("x")
        (leader,) = await led(fleet, "x")
        assert leader.rcm is not None
        dangers: list[BookedDanger] = []
        leader.rcm.bookings.on_danger = dangers.append
        far = fleet.rc("robot/far")
        await fleet.joined(far)
        client = fleet.client("one")
        for name, at in (("a", 3_000), ("z", 300)):
            until = round(NOON + at + 4 * 86_400)
            await do(client, book(name, "robot/far", at=at, every=1, until=until), BookingView)
        await do(client, book("m", "robot/far", at=200 * 86_400), BookingView)
        fleet.network.kill(far.mesh)
        await asyncio.sleep(10)
        assert [(one.record.id, one.start - NOON, one.later) for one in dangers] == [
            ("z", 300, 4),
            ("a", 3_000, 4),
            ("m", 200 * 86_400, 0),
        ]

    run(story())


def test_what_is_long_over_is_forgotten_by_all_who_keep_bookings() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        await led(fleet, "x", "y")
        await do(fleet.client("one"), book("b", "robot/a", at=500), BookingView)
        # A host with RCs, which can't lead, comes back after a month.
        old = BookingRecord(**{name: getattr(book("old", "robot/a", at=-86_400 * 30), name) for name in FIELDS})
        fleet.disks["far"] = Disk()
        fleet.disks["far"].records = [old]
        far = BookingKeeper(fleet.mesh("far"), fleet.disks["far"], candidate=False, wall=fleet.time)
        asked = 0

        def count() -> None:
            nonlocal asked
            asked += 1

        far.on_shared = count
        far.start(Supervisor("far", lambda error: pytest.fail(str(error))))
        far.mesh.alive(Token("far", Role.NODE, "node", "1"))
        await asyncio.sleep(40)
        assert {disk: [one.id for one in fleet.disks[disk].records] for disk in ("x", "y", "far")} == {
            "x": ["b"],
            "y": ["b"],
            "far": ["b"],
        }
        assert asked == 1

    run(story())


def test_a_keeper_that_was_busy_is_told_before_long() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y", "z")
        *_, last = await led(fleet, "x", "y", "z")
        client = fleet.client("one")
        last._keeper._waiting = MAX_SAVING
        await do(client, book("b", "robot/a", at=500), BookingView)
        await asyncio.sleep(1)
        assert not fleet.disks["z"].records
        last._keeper._waiting = 0
        await asyncio.sleep(6)
        assert [one.id for one in fleet.disks["z"].records] == ["b"]

    run(story())


def test_what_changes_after_a_restart_of_all_counts_though_terms_begin_anew() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        before = Grant(Term(9, "old"), 50)
        asked = book("b", "robot/*", at=500, every=1, until=round(NOON) + 200_000)
        old = BookingRecord(
            **{name: getattr(asked, name) for name in FIELDS}, owner="desk", made=before, changed=before
        )
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

    run(story())


def test_a_booking_right_after_another_stands_though_fleet_time_is_slewed() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y", "z")
        fleet.ahead |= {"y": 10.0, "z": 10.0}
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

    run(story())


def test_a_host_that_has_no_room_for_a_booking_does_not_keep_it() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        _, other = await led(fleet, "x", "y")
        client = fleet.client("one")
        await do(client, book("b", "robot/a", at=500), BookingView)
        other._keeper.records.size = MAX_BYTES
        with pytest.raises(Refusal, match="not_kept"):
            await do(client, book("c", "robot/b", at=500), BookingView)
        with pytest.raises(Refusal, match="not_kept"):
            await do(client, Unbook("b"), BookingView)
        other._keeper.records.size = 1_000
        assert (await do(client, Unbook("b"), BookingView)).unbooked

    run(story())


def test_what_becomes_of_one_booking_is_not_told_of_another() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        leader, other = await led(fleet, "x", "y")
        await do(fleet.client("one"), book("b", "robot/a", at=500), BookingView)
        (known,) = other._keeper.records
        other._keeper.records.size = MAX_BYTES
        assert leader.rcm is not None
        sharing = leader.rcm.bookings._sharing

        async def catch_up() -> str:
            async with sharing._sharing:
                await sharing._share()
            return ""

        # The second tells of the fourth as well, and the third of nothing.
        new = leader._keeper.records.take(replace(known, id=name) for name in "cde")
        keeping = [sharing.keep(record) for record in new]
        kept = await asyncio.gather(*keeping[:2], catch_up(), keeping[2])
        assert [*map(bool, kept)] == [True, True, False, True]

    run(story())


def test_a_booking_that_one_leader_could_not_keep_stands_where_another_one_has_it() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        _, y = await led(fleet, "x", "y")
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

    run(story())


def test_after_a_restart_of_all_hosts_nothing_is_decided_by_one_wrong_clock() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y", "z")
        old = await led(fleet, "x", "y", "z")
        client = fleet.client("one")
        await do(client, book("b", "robot/a", at=300, patience=Decimal(30)), BookingView)
        await do(client, book("c", "robot/b", at=400), BookingView)
        await asyncio.sleep(1)
        for one in old:
            fleet.network.kill(one.mesh)
        await asyncio.sleep(5)
        # The first to be back is two days ahead, by which both would be over, and long forgotten.
        fleet.ahead["x"] = 2 * 86_400
        first = fleet.candidate("x")
        await until(lambda: first.rcm)
        assert first.rcm is not None
        assert not first.rcm.bookings.settled
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

    run(story())


def test_what_ends_by_one_wrong_clock_after_a_restart_of_all_is_not_over() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y", "z")
        old = await led(fleet, "x", "y", "z")
        client = fleet.client("one")
        await do(client, book("m", "robot/a", at=300, maintenance=True), BookingView)
        await do(client, book("b", "robot/b", at=300, patience=Decimal(100)), BookingView)
        mine = await client.ask("mine", "robot/b", seconds=100, booking="b")
        client.open = [
            OpenRequest("mine", "mine", {"robot/b": {}}, 0, Decimal(100), place=mine.place, booking="b@1800000300")
        ]
        for one in old:
            fleet.network.kill(one.mesh)
        await asyncio.sleep(5)
        # By the clock of the first to be back both end as it has just begun to lead.
        fleet.ahead["x"] = NOON + 399.2 - fleet.time()
        first = fleet.candidate("x")
        await until(lambda: first.rcm)
        await asyncio.sleep(0.5)
        assert first.rcm is not None
        assert not first.rcm.bookings.settled
        assert first.rcm.bookings.dates.time > NOON + 400
        fleet.candidate("y")
        fleet.candidate("z")
        await asyncio.sleep(5)
        views = await fleet.bookings()
        assert {name: states(view) for name, view in views.items()} == {"m": ["open"], "b": ["taken"]}

    run(story())


@pytest.mark.parametrize("ahead", [NOON + 310, NOON + 2 * 86_400], ids=["its date has come", "it is over"])
@pytest.mark.parametrize("known", [True, False], ids=["known", "not known"])
def test_who_waits_for_a_date_does_not_begin_by_one_wrong_clock_after_a_restart_of_all(
    ahead: float, known: bool
) -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y", "z")
        old = await led(fleet, "x", "y", "z")
        client = fleet.client("one")
        await do(client, book("b", "robot/b", at=300, patience=Decimal(100)), BookingView)
        mine = await client.ask("mine", "robot/b", seconds=100, booking="b")
        await asyncio.sleep(1)
        client.open = [
            OpenRequest("mine", "mine", {"robot/b": {}}, 0, Decimal(100), place=mine.place, booking=mine.booking)
        ]
        for one in old:
            fleet.network.kill(one.mesh)
        await asyncio.sleep(5)
        fleet.ahead["x"] = ahead - fleet.time()
        fleet.disks["x"].records *= known
        first = fleet.candidate("x")
        await until(lambda: first.rcm)
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

    run(story())


def test_the_older_of_two_fleet_times_goes_on() -> None:
    async def story() -> None:
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

    run(story())


def test_a_host_that_does_not_answer_turns_no_clock_back() -> None:
    """What others have answered is older by as long as it was waited for."""

    async def story() -> None:
        fleet = BookedFleet("x", "y", "z")
        x, *_ = await led(fleet, "x", "y", "z")
        asked = fleet.silent()
        await asyncio.sleep(120)
        assert asked
        assert x.rcm is not None
        assert x.rcm.bookings.time == pytest.approx(fleet.time(), abs=0.02)

    run(story())


def test_a_date_in_conflict_is_not_voted_on_again_and_again() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        await led(fleet, "x", "y")
        radio = fleet.rc("radio/rf0")
        await fleet.joined(radio)
        here, there = fleet.client("here", "x"), fleet.client("there", "y")
        fleet.part("y")
        await asyncio.sleep(4)
        await do(here, book("beside", "radio/rf0:1", at=500), BookingView)
        await do(here, book("low", "radio/rf0:1", "robot/a", at=500), BookingView)
        await do(there, book("high", "robot/a", at=500, priority=5), BookingView)
        fleet.network.heal()
        await asyncio.sleep(70)
        assert states((await fleet.bookings())["low"]) == ["conflict"]
        asked = len(radio.proposals)
        await do(here, book("later", "radio/rf0:1", at=900), BookingView)
        await asyncio.sleep(10)
        assert len(radio.proposals) - asked < 10

    run(story())


def test_a_date_by_pattern_goes_to_another_shared_rc_once_that_has_voted() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        await led(fleet, "x", "y")
        here, there = fleet.client("here", "x"), fleet.client("there", "y")
        first = fleet.rc("radio/rf0")
        await fleet.joined(first)
        fleet.part("y")
        await asyncio.sleep(4)
        await do(here, book("low", "radio/*:1", at=500), BookingView)
        await fleet.joined(fleet.rc("radio/rf1"))
        await do(there, book("high", "radio/rf0:1", at=500, priority=5), BookingView)
        first.accept = False
        fleet.network.heal()
        await asyncio.sleep(70)
        views = await fleet.bookings()
        assert {name: states(view) for name, view in views.items()} == {"low": ["open"], "high": ["open"]}
        assert views["low"].dates[0].bound == {"radio/*": "radio/rf1"}

    run(story())


def forget_how_to_ask(fleet: BookedFleet, host: str) -> None:
    """The links to a host have come back without what it had declared to be asked by about bookings."""
    (mesh,) = (mesh for mesh in fleet.meshes if mesh.me.host == host)
    session = mesh._transport.current
    assert isinstance(session, MemoryTransport)
    forgotten = {one for one in session.queryables.all if "/bookings" in str(one)}
    assert forgotten
    for other in fleet.network.nodes:
        fleet.network.between(session, other).hidden |= forgotten


def test_a_keeper_that_nobody_asks_joins_the_mesh_anew() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        await led(fleet, "x", "y")
        client = fleet.client("one", "x")
        await asyncio.sleep(1)
        forget_how_to_ask(fleet, "y")
        with pytest.raises(Refusal, match="not_kept"):
            await do(client, book("b", "robot/a", at=500), BookingView)
        await asyncio.sleep(60)
        await do(client, book("c", "robot/a", at=700), BookingView)
        await asyncio.sleep(1)
        assert [record.id for record in fleet.disks["y"].records][-1] == "c"

    run(story())


def test_a_keeper_that_can_not_lead_and_that_nobody_asks_joins_the_mesh_anew() -> None:
    async def story() -> None:
        fleet = BookedFleet("x", "y")
        await led(fleet, "x", "y")
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

    run(story())
