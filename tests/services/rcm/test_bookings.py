"""Bookings on a mesh in memory: made, taken up, given up; over changes of leader, partitions and conflicts."""

from __future__ import annotations

import asyncio
from decimal import Decimal

import pytest
from msgspec.structs import replace

from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import NOON, BookedFleet, book, booked, do, led, states
from tests.services.rcm.kit import Refusal, request
from zscout.messages import BookingView, FindSlots, Release, SlotsTold, Unbook
from zscout.services.rcm.rcm import Rcm
from zscout.types import SECOND, Place, Term


async def test_a_booking_is_kept_by_another_candidate_and_taken_up_at_its_date() -> None:
    fleet, _ = await booked("x", "y")
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


async def test_slots_are_the_times_between_bookings() -> None:
    fleet, _ = await booked("x")
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


async def test_a_date_that_is_not_repeated_is_kept_free_however_far_ahead() -> None:
    fleet, _ = await booked("x")
    client = fleet.client("one")
    far = 300 * 86_400
    await do(client, book("b", "robot/a", at=far), BookingView)
    assert states((await fleet.bookings())["b"]) == ["open"]
    with pytest.raises(Refusal, match=r"not_free.*booked then: b of desk"):
        await do(client, book("c", "robot/a", at=far + 50), BookingView)
    assert (await do(client, Unbook("b"), BookingView)).unbooked
    await do(client, book("c", "robot/a", at=far + 50), BookingView)
    assert set(await fleet.bookings()) == {"c"}


async def test_slots_go_by_what_was_asked_for_and_tell_what_is_likely() -> None:
    fleet, _ = await booked("x")
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


async def test_votes_decide_about_a_sharable_rc() -> None:
    fleet, _ = await booked("x")
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


async def test_a_booking_longer_than_a_hold_may_be_is_refused_with_both_numbers() -> None:
    fleet = BookedFleet("x")
    fleet.fleet = replace(fleet.fleet, limits=replace(fleet.fleet.limits, max_runtime=50 * SECOND))
    await led(fleet, "x")
    client = fleet.client("one")
    too_long = r"bad_date.*100 s long; book at most 50 s \(\[limits\] max_runtime\)"
    with pytest.raises(Refusal, match=too_long):
        await do(client, book("b", "robot/a", at=50), BookingView)
    with pytest.raises(Refusal, match=too_long):
        await do(client, FindSlots("s", request("s", "robot/a").needs, 0, Decimal(100), within=1_000), SlotsTold)
    await do(client, book("b", "robot/a", at=50, seconds=50), BookingView)
    await do(client, book("m", "robot/b", at=50, maintenance=True, patience=Decimal(100)), BookingView)
    assert {*await fleet.bookings()} == {"b", "m"}


async def test_bookings_may_have_a_longest_time_of_their_own() -> None:
    fleet = BookedFleet("x")
    limits = replace(fleet.fleet.limits, max_runtime=50 * SECOND, max_booking=100 * SECOND)
    fleet.fleet = replace(fleet.fleet, limits=limits)
    await led(fleet, "x")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=50), BookingView)
    with pytest.raises(Refusal, match=r"bad_date.*101 s long; book at most 100 s \(\[limits\] max_booking\)"):
        await do(client, book("c", "robot/a", at=500, seconds=101), BookingView)


async def test_of_bookings_that_wait_for_votes_no_more_are_made_than_are_allowed_and_each_once() -> None:
    fleet = BookedFleet("x")
    fleet.fleet = replace(fleet.fleet, limits=replace(fleet.fleet.limits, max_bookings_per_host=2))
    await led(fleet, "x")
    await fleet.joined(fleet.rc("radio/rf0", accept=True))
    client = fleet.client("one")
    wanted = [book(name, "radio/rf0:5", at=50) for name in "bbcd"]
    told = await asyncio.gather(*(do(client, one, BookingView) for one in wanted), return_exceptions=True)
    assert [one.id if isinstance(one, BookingView) else str(one)[:8] for one in told] == ["b", "b", "c", "too_many"]
    assert {*await fleet.bookings()} == {"b", "c"}


async def test_a_booking_outlives_its_leader_and_its_taker_goes_on() -> None:
    fleet, (leader, heir) = await booked("x", "y")
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


async def test_two_halves_book_the_same_and_the_earlier_of_the_higher_priority_stands() -> None:
    fleet, (x, y) = await booked("x", "y")
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
    assert views["low"].dates[0].danger == "higher of y takes precedence"
    # Where that one is given up the other stands.
    await do(there, Unbook("higher"), BookingView)
    await asyncio.sleep(1)
    assert states((await fleet.bookings())["low"]) == ["open"]


async def test_who_took_up_a_date_that_is_in_conflict_waits_for_it_and_has_it_once_it_stands() -> None:
    fleet, (_, y) = await booked("x", "y")
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


async def test_who_took_up_a_date_that_its_leader_does_not_know_yet_waits_for_it_and_has_it() -> None:
    fleet = BookedFleet("x", "y")
    (leader,) = await led(fleet, "x")
    await do(fleet.client("there", "y"), book("b", "robot/b", at=500), BookingView)
    (known,) = leader.learned.keeper.records
    hers, not_hers = (fleet.client("one", host) for host in ("y", "z"))
    for number, client in enumerate((hers, not_hers), 1):
        place = Place(Term(0, "elsewhere"), number)
        told = await client.ask("mine", "robot/a", seconds=100, place=place, booking="late@1800000500")
        assert (told.state, told.reason) == ("queued", "the time of its booking is still to come")
    leader.learned.keeper.records.take([replace(known, id="late", name="late", needs={"robot/a": {}})])
    leader.learned.keeper.shared.set()
    await asyncio.sleep(1)
    assert states((await fleet.bookings())["late"]) == ["taken"]
    await asyncio.sleep(NOON + 501 - fleet.time())
    assert hers.notices[-1].state == "running"
    assert "running" not in {notice.state for notice in not_hers.notices}


async def test_what_is_no_booking_is_refused_in_one_line() -> None:
    fleet, _ = await booked("x")
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
        (replace(good, maintenance=True, needs={"@a b": {}}), "bad_request"),
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


async def test_a_candidate_that_sees_a_higher_term_while_dates_enter_leads_above_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fleet, enter = BookedFleet("x"), Rcm.enter

    async def interrupted(rcm: Rcm) -> None:
        await enter(rcm)
        candidate._learn(Term(7, "other"))

    monkeypatch.setattr(Rcm, "enter", interrupted)
    candidate = fleet.candidate("x")
    await asyncio.sleep(3)
    monkeypatch.undo()
    assert candidate.terms_led == 0 or candidate.known.counter > 7
    await until(lambda: candidate.rcm)
    assert candidate.rcm is not None
    assert candidate.rcm.term.counter == 8


async def test_other_strategies_keep_no_bookings() -> None:
    fleet = BookedFleet("x")
    fleet.fleet = replace(fleet.fleet, strategy="priority")
    await led(fleet, "x")
    with pytest.raises(Refusal, match=r'wrong_strategy.*"adaptive"'):
        await do(fleet.client("one"), book("b", "robot/a", at=50), BookingView)


async def test_maintenance_goes_before_what_is_booked_and_both_are_told() -> None:
    fleet, _ = await booked("x")
    client = fleet.client("one")
    await do(client, book("b", "robot/a", at=300), BookingView)
    drain = await do(client, book("m", "robot/a", "robot/b", at=200, seconds=200, maintenance=True), BookingView)
    assert drain.priority == fleet.fleet.operator_priority
    views = await fleet.bookings()
    assert states(views["m"]) == ["open"]
    assert states(views["b"]) == ["conflict"]
    assert views["b"].dates[0].danger == "m of desk takes precedence"
    with pytest.raises(Refusal, match=r"bad_request.*no request can use"):
        await client.ask("mine", "robot/a", "robot/b", booking="m", priority=drain.priority)
    kept = await client.ask("kept", "robot/b", seconds=30, keep=True)
    late = await client.ask("late", "robot/a", seconds=250, estimate=True)
    assert (kept.state, late.state) == ("running", "queued")
    assert late.starts_in == pytest.approx(400 - (fleet.time() - NOON), abs=1)
    await asyncio.sleep(NOON + 201 - fleet.time())
    assert [(one.state, one.outcome) for one in client.notices if one.id == "kept"][-1] == ("ended", "completed")
    await asyncio.sleep(200)
    assert [one.state for one in client.notices if one.id == "late"][-1] == "running"


async def test_the_danger_of_maintenance_that_is_given_up_is_over() -> None:
    fleet, _ = await booked("x", "y")
    dangers = fleet.dangers["x"]
    client = fleet.client("one", "desk")
    await do(client, book("b", "robot/a", at=500, priority=1), BookingView)
    await do(client, book("m", "robot/a", at=400, seconds=300, maintenance=True), BookingView)
    await asyncio.sleep(5)
    assert states((await fleet.bookings())["b"]) == ["conflict"]
    await do(client, Unbook("m"), BookingView)
    await asyncio.sleep(5)
    (date,) = (await fleet.bookings())["b"].dates
    assert (date.state, date.danger) == ("open", "")
    assert [(one.record.id, bool(one.why)) for one in dangers] == [("b", True), ("b", False)]


async def test_what_is_repeated_is_kept_from_the_instant_that_a_date_is_within_60_days() -> None:
    fleet, _ = await booked("x", "y")
    await do(fleet.client("one"), book("b", "robot/a", at=500, every=1, until=round(NOON) + 300 * 86_400), BookingView)
    await asyncio.sleep(NOON + 499 - fleet.time())
    assert (await fleet.bookings())["b"].dates[-1].start == NOON + 59 * 86_400 + 500
    await asyncio.sleep(2)
    last = (await fleet.bookings())["b"].dates[-1]
    assert (last.start, last.state, last.danger) == (NOON + 60 * 86_400 + 500, "open", "")


async def test_a_booking_is_in_danger_while_what_it_needs_is_away() -> None:
    fleet, _ = await booked("x")
    dangers = fleet.dangers["x"]
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


async def test_of_all_dates_of_a_booking_a_danger_is_told_once_and_the_next_dates_first() -> None:
    fleet, _ = await booked("x")
    dangers = fleet.dangers["x"]
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


async def test_a_date_in_conflict_is_not_voted_on_again_and_again() -> None:
    fleet, (_, y) = await booked("x", "y")
    radio = fleet.rc("radio/rf0")
    await fleet.joined(radio)
    here, there = fleet.client("here", "x"), fleet.client("there", "y")
    fleet.part("y")
    await until(lambda: y.rcm)
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


async def test_a_date_by_pattern_goes_to_another_shared_rc_once_that_has_voted() -> None:
    fleet, (_, y) = await booked("x", "y")
    here, there = fleet.client("here", "x"), fleet.client("there", "y")
    first = fleet.rc("radio/rf0")
    await fleet.joined(first)
    fleet.part("y")
    await until(lambda: y.rcm)
    await do(here, book("low", "radio/*:1", at=500), BookingView)
    later = fleet.rc("radio/rf1")
    fleet.part("y")
    await fleet.joined(later)
    await do(there, book("high", "radio/rf0:1", at=500, priority=5), BookingView)
    first.accept = False
    fleet.network.heal()
    await asyncio.sleep(70)
    views = await fleet.bookings()
    assert {name: states(view) for name, view in views.items()} == {"low": ["open"], "high": ["open"]}
    assert views["low"].dates[0].bound == {"radio/*": "radio/rf1"}
