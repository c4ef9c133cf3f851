"""A client that books: what it repeats, what it does not, and what it keeps of what it has taken up."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from decimal import Decimal
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from msgspec.structs import asdict

from tests.behaviors.client.small_fleet import RC, SmallFleet, small_fleet
from tests.behaviors.client.test_open_arc import NOW, RUNS, TAKEN, WAITS, arc
from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import Disk
from zscout.behaviors.client.bookings import BookingsClient, RcmSilent
from zscout.behaviors.client.client import Client, RequestRefused
from zscout.behaviors.client.request import OpenArc
from zscout.config.fleet import default_fleet
from zscout.keyexpr import Sender
from zscout.mesh import IncomingQuery, Refused
from zscout.messages import Book, BookingView, OpenRequest, Operation, Who
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.rcm.candidate import Candidate, CandidateParts
from zscout.testing.memory import MemoryNetwork
from zscout.types import SECOND

FLEET = default_fleet()
AT = datetime(2026, 12, 1, 14, 0, tzinfo=ZoneInfo("Europe/Berlin"))
NEEDS: dict[str, dict[str, Any]] = {"robot/a": {}, "radio/rf0": {"command_rate": 0.1}}


class Leader:
    """Answers operations as `answer` does."""

    def __init__(self, answer: Callable[[IncomingQuery[Operation]], object]) -> None:
        network = MemoryNetwork()
        self.mesh = network.open(FLEET.name, Sender("a", "x"))
        self.client = Client(network.open(FLEET.name, Sender("b", "c")), FLEET)
        self.client.who = Who("alice", "b")
        self.asked: list[Operation] = []
        self._answer = answer
        self._served = self.mesh.serve(self.mesh.keys.schedule(self.client.mesh.me), Operation, self._on_query)

    def _on_query(self, query: IncomingQuery[Operation]) -> None:
        self.asked.append(query.message)
        self._answer(query)


def view(book: Operation) -> BookingView:
    assert isinstance(book, Book)
    return BookingView(**asdict(book), owner="b")


async def test_a_booking_is_asked_for_until_it_is_told_and_stays_one() -> None:
    codes = ["busy", "not_leading", ""]

    def answer(query: IncomingQuery[Operation]) -> None:
        if code := codes.pop(0):
            raise Refused(code, "no")
        query.answer(view(query.message))

    leader = Leader(answer)
    booked = await BookingsClient(leader.client).book(NEEDS, AT, 7200, name="survey", every=7, comment="a class")
    assert len(leader.asked) == 3
    first = leader.asked[0]
    assert leader.asked == [first] * 3, "under one id"
    assert isinstance(first, Book)
    assert (booked.id, len(first.id)) == (first.id, 32)
    assert (first.start, first.zone, first.every) == (int(AT.timestamp()), "Europe/Berlin", 7)
    assert first.needs["radio/rf0"] == {"command_rate": Decimal("0.1")}
    assert [first.runtime, first.patience] == [7200, 900]
    assert first.who == Who("alice", "b", comment="a class")
    terms = BookingsClient.terms(booked)
    assert terms == {"needs": first.needs, "priority": 0, "min_runtime": 7200, "booking": first.id}


async def test_a_refusal_is_raised_at_once_and_silence_after_the_time_given() -> None:
    def refuse(_: object) -> None:
        raise Refused("not_free", "robot/a is booked by bob")

    leader = Leader(refuse)
    with pytest.raises(RequestRefused, match="booked by bob") as refused:
        await BookingsClient(leader.client).slots(NEEDS, 60, 3600)
    assert (refused.value.code, len(leader.asked)) == ("not_free", 1)
    silent, began = Leader(lambda _: None), asyncio.get_running_loop().time()
    with pytest.raises(
        RcmSilent, match="the operation may or may not have been done: see zscout booking list, and try again"
    ):
        await BookingsClient(silent.client, timeout=12.0).unbook("x")
    assert len(set(map(id, silent.asked))) >= 2
    assert 12 <= asyncio.get_running_loop().time() - began < 20


async def test_an_rcm_that_knows_no_bookings_is_told_as_such() -> None:
    with pytest.raises(RcmSilent, match="did not answer; its version may not support bookings"):
        await BookingsClient(Leader(lambda _: None).client).list()


async def test_what_is_no_date_is_refused_before_anybody_is_asked() -> None:
    leader = Leader(lambda _: None)
    bookings = BookingsClient(leader.client)
    offset = AT.astimezone(timezone(timedelta(hours=1)))
    for start, every, why in ((AT.replace(tzinfo=None), 0, "has no zone"), (offset, 7, "ZoneInfo")):
        with pytest.raises(ValueError, match=why):
            await bookings.book(NEEDS, start, 60, name="x", every=every)
    with pytest.raises(ValueError, match="runtime"):
        await bookings.book(NEEDS, AT, 0, name="x")
    assert not leader.asked


@pytest.mark.parametrize("start", [AT, AT.astimezone(UTC), AT.astimezone(timezone(timedelta(hours=1)))])
async def test_an_instant_is_one_in_any_zone(start: datetime) -> None:
    leader = Leader(lambda query: query.answer(view(query.message)))
    booked = await BookingsClient(leader.client).book(NEEDS, start, 600, name="x")
    assert [booked.start, booked.patience] == [int(AT.timestamp()), 600]


def test_the_date_that_an_rcm_has_linked_is_shown_to_the_next() -> None:
    it = arc()
    it.booking = "b1"
    assert it._ask(NOW).booking == "b1"
    assert it._take(type(WAITS)(**{**asdict(WAITS), "step": 1, "booking": "b1@1796130000"}), NOW)
    assert it._take(RUNS, NOW), "a notice that says nothing of it changes nothing"
    assert it._ask(NOW).booking == it._open_request(NOW).booking == "b1@1796130000"
    assert it._take(TAKEN, NOW)
    assert it._ask(NOW).booking == "b1@1796130000", "preempted, it waits for the same date"
    assert isinstance(it._open_request(NOW), OpenRequest)
    assert OpenArc._expected(it._open_request(NOW), NOW).booking == "b1@1796130000", "handed over as well"


class BookedFleet(SmallFleet):
    """Candidates with disks, in the virtual time of the test."""

    def candidate(self, host: str) -> Candidate:
        mesh = self.mesh(host, "node")
        keeper = BookingKeeper(mesh, Disk(), wall=lambda: AT.timestamp() + mesh.now() / SECOND)
        candidate = self.candidates[host] = Candidate(mesh, self.fleet, CandidateParts(keeper=keeper))
        candidate.start()
        return candidate


async def test_what_a_program_has_taken_up_it_has_at_its_date_though_the_leader_dies() -> None:
    async with small_fleet("one", "two", kind=BookedFleet) as (fleet, (one, two)):
        fleet.candidate("h1")
        bookings = BookingsClient(one)
        start = datetime.fromtimestamp((await bookings.list()).time + 60, UTC)
        booking = await bookings.book({RC: {}}, start, 30, name="survey", every=1, until=start + timedelta(days=3))
        mine = await one.request("survey", **bookings.terms(booking))
        assert (mine.state, mine.booking) == ("queued", f"{booking.id}@{booking.start}"), "the first date"
        await fleet.lose_leader()
        await until(lambda: one.leader == "h1" and two.leader == "h1", within=30)
        # What would not be over by then does not start, though it is asked for first.
        long = await two.request("long", {RC: {}}, min_runtime=600)
        assert await one.granted(mine) is not None
        told = await bookings.list()
        assert 0 <= told.time - booking.start < 1
        [dates] = [view.dates for view in told.bookings]
        assert [(date.state, date.arc) for date in dates][:2] == [("taken", f"h/one/{mine.id}"), ("open", None)]
        assert (mine.booking, long.state) == (f"{booking.id}@{booking.start}", "queued")
        # At its end it yields to who waits, and what asks for the booking anew has its next date.
        assert await two.granted(long) is not None
        assert 30 <= (await bookings.list()).time - booking.start < 32
        assert mine.outcome == "completed"
        again = await one.request("survey", **bookings.terms(booking))
        assert again.booking == f"{booking.id}@{booking.start + 86_400}"
