"""Forged lists of clients, states of RCs and records of keepers, on a secured fleet in memory."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs

from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import NOON, BookedFleet, book, do, record
from tests.services.rcm.kit import FakeClient, FakeRc, Refusal, grant_of, request
from zscout.config.access import AccessPolicy, Ceiling, Quota, Roles
from zscout.keyexpr import Role, Token
from zscout.mesh.supervision import Supervisor
from zscout.messages import (
    MAX_HELD,
    MAX_LISTED,
    BookingView,
    Foresee,
    Foresight,
    HandOver,
    Holder,
    Notice,
    OpenRequest,
    Unbook,
    Who,
)
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.rcm import booking_handler
from zscout.services.rcm.candidate import Candidate
from zscout.types import Grant, Place, Term

KEY = bytes(range(32))
OLD = Term(1, "0ld")
ROLES = Roles(
    client=("bob", "eve"), operator=("ada",), viewer=("wall",), manager=("x", "y"), node={"devices": ("robot/*",)}
)
ACCESS = AccessPolicy(ROLES, access={"robot/arm": ("ada",)})


class ClosedFleet(BookedFleet):
    def __init__(self, *candidates: str, access: AccessPolicy = ACCESS, **limits: int) -> None:
        super().__init__(*candidates)
        limited = structs.replace(self.fleet.limits, **limits)
        self.fleet = structs.replace(self.fleet, security=Path("keys"), access=access, limits=limited)

    def candidate(self, host: str, *_: Any, **how: Any) -> Candidate:
        return super().candidate(host, places_key=KEY, **how)

    async def taken_over(self, leader: Candidate, heir: Candidate) -> None:
        self.network.kill(leader.mesh)
        await until(lambda: heir.rcm)


async def closed(*robots: str, **how: Any) -> tuple[ClosedFleet, Candidate, Candidate, list[FakeRc]]:
    """A secured fleet: its leader, another candidate, RCs that are there."""
    fleet = ClosedFleet("x", "y", **how)
    leader = fleet.candidate("x")
    await until(lambda: leader.rcm and leader.rcm.bookings.settled)
    heir, found = fleet.candidate("y"), [fleet.rc(f"robot/{name}") for name in robots]
    await fleet.joined(*found)
    return fleet, leader, heir, found


def listed(name: str, *needs: str, priority: int = 0, **more: Any) -> OpenRequest:
    wanted = request(name, *needs).needs
    return OpenRequest(name, name, wanted, priority, Decimal(60), **({"place": Place(OLD, 1)} | more))


def lists(notice: Notice, **more: Any) -> OpenRequest:
    """An honest client's open request, from its notice."""
    return listed(notice.arc, *notice.rcs, place=notice.place, seal=notice.seal, **more)


def refusals(client: FakeClient) -> dict[str, str]:
    return {item.id: item.problem.code for item in client.notices if item.problem is not None and item.state == "ended"}


async def served(client: FakeClient, robot: str) -> None:
    """Awaits a grant for an honest client within 0.5 s."""
    async with asyncio.timeout(0.5):
        assert (await client.ask("honest", robot)).state == "running"


# What clients list


async def test_what_a_client_lists_passes_the_door_of_what_it_asks_for() -> None:
    fleet, leader, heir, _ = await closed("a", "b", "arm")
    bob, eve, ada = fleet.client("one", "bob"), fleet.client("two", "eve"), fleet.client("three", "ada")
    await do(ada, book("hers", "robot/b", at=5000), BookingView)
    held, waits = await bob.ask("held", "robot/a"), await bob.ask("waits", "robot/a")
    bob.open = [lists(held, grant=held.grant, rcs=held.rcs), lists(waits)]
    assert waits.place is not None
    eve.open = [
        listed("high", "robot/a", priority=1_000_000),
        listed("operators", "robot/a", priority=10),
        listed("barred", "robot/arm"),
        listed("theirs", "robot/b", booking=f"hers@{NOON + 5000:.0f}"),
        listed("never", "robot/a", place=Place(OLD, 0)),
        listed("posing", "robot/a", place=waits.place, who=Who("ada", "laptop")),
        listed("no name", "robot/a"),
        structs.replace(listed("nothing", "robot/a"), needs={}),
    ]
    await fleet.taken_over(leader, heir)
    await until(lambda: len(refusals(eve)) == 6)
    refused = dict.fromkeys(["never", "nothing"], "bad_request")
    assert refusals(eve) == refused | dict.fromkeys(["high", "operators", "barred", "theirs"], "not_allowed")
    [why] = [item.reason for item in eve.notices if item.id == "operators"]
    assert why == "the leader refuses it: eve (client) may not request priority 10; at most 9; ada may"
    state = await fleet.state()
    assert [(item.client, item.arc) for item in state.holds] == [("bob/one", "held")]
    # A place without its seal and another's name are ignored.
    assert [(item.arc, item.who and item.who.user) for item in state.queue] == [("waits", None), ("posing", "eve")]
    assert (state.queue[0].place, state.queue[1].place.term) == (waits.place, state.term)
    assert not bob.notices
    assert next(iter(await fleet.bookings())) == "hers"
    await served(bob, "robot/b")


async def test_of_what_a_client_lists_no_more_counts_than_it_may_have_open() -> None:
    fleet, leader, heir, _ = await closed("a", "b", max_requests_per_client=3, max_requests_per_host=4)
    bob, flood, more = fleet.client("one", "bob"), fleet.client("two", "eve"), fleet.client("three", "eve")
    held = await bob.ask("held", "robot/a")
    bob.open = [lists(held, grant=held.grant, rcs=held.rcs)]
    flood.open = [listed(f"f{number}", "robot/a", place=Place(OLD, 9 + number)) for number in range(1_000)]
    more.open = [listed(f"m{number}", "robot/a", place=Place(OLD, 1 + number)) for number in range(3)]
    await fleet.taken_over(leader, heir)
    await until(lambda: sum(map(len, map(refusals, (flood, more)))) == 2)
    state = await fleet.state()
    assert Counter(item.client for item in state.queue).total() == 4
    assert {*refusals(flood).values(), *refusals(more).values()} == {"too_many"}
    await served(bob, "robot/b")


async def test_a_list_or_a_state_that_is_too_long_is_not_decoded_and_harms_nobody_else(
    caplog: pytest.LogCaptureFixture,
) -> None:
    fleet, leader, heir, _ = await closed("a", "b")
    bob, flood = fleet.client("one", "bob"), fleet.client("two", "eve")
    held = await bob.ask("held", "robot/a")
    bob.open = [lists(held, grant=held.grant, rcs=held.rcs)]
    flood.open = [listed(f"f{number}", "robot/a", place=Place(OLD, 9 + number)) for number in range(30_000)]
    robot = fleet.rc("robot/c")
    robot.holders = [
        Holder(f"q{n}", "q", "eve/two", Grant(OLD, n), Place(OLD, n), ["robot/c"], Decimal(60), 60.0)
        for n in range(20_000)
    ]
    await fleet.taken_over(leader, heir)
    state = await fleet.state()
    assert [(item.client, item.arc) for item in state.holds] == [("bob/one", "held")]
    assert not [item for item in state.queue if item.client == "eve/two"]
    assert f"at most {MAX_LISTED} are accepted" in caplog.text
    assert f"at most {MAX_HELD} are accepted" in caplog.text
    await served(bob, "robot/b")
    # What it asks for itself is as good as anybody's.
    flood.open = []
    await flood.ask("asked", "robot/b")
    await until(lambda: heir.rcm and heir.rcm.core.arc("eve/two/asked"))


async def test_quotas_and_ceilings_count_for_what_waits_and_end_nothing_that_runs() -> None:
    fleet, leader, heir, _ = await closed("a", "b", "c")
    bob = fleet.client("one", "bob")
    runs = await bob.ask("runs", "robot/a", priority=9, keep=True, seconds=600)
    waits = [await bob.ask(f"w{number}", "robot/a", priority=number) for number in (5, 4, 3)]
    bob.open = [lists(runs, priority=9, keep=True, grant=runs.grant, rcs=runs.rcs)]
    bob.open += [lists(item, priority=5 - number) for number, item in enumerate(waits)]
    lowered = AccessPolicy(
        ROLES,
        access={"robot/a": ("bob",)},
        quotas={"bob": Quota(arcs=2)},
        ceilings={"client": Ceiling(priority=4, runtime=60_000_000_000)},
    )
    assert heir._authority is not None
    heir._authority.reload(structs.replace(fleet.fleet, access=lowered))
    await fleet.taken_over(leader, heir)
    await until(lambda: len(refusals(bob)) == 2)
    assert refusals(bob) == dict.fromkeys(["w5", "w3"], "not_allowed")
    state = await fleet.state()
    [hold] = state.holds
    assert (hold.arc, hold.grant, hold.priority, hold.keep, hold.min_runtime) == (
        "runs",
        grant_of(runs),
        4,
        True,
        Decimal(60),
    )
    assert [item.arc for item in state.queue] == ["w4"]


async def test_what_is_asked_again_while_it_runs_is_not_refused_for_what_was_lowered_meanwhile() -> None:
    fleet, leader, _, _ = await closed("a")
    bob, ada = fleet.client("one", "bob"), fleet.client("three", "ada")
    held = await bob.ask("held", "robot/a", seconds=600)
    leader._authority.reload(structs.replace(fleet.fleet, access=AccessPolicy(ROLES, access={"robot/a": ("ada",)})))
    leader.on_reload(leader.fleet)
    again = await bob.ask("held", "robot/a", seconds=600, grant=held.grant, rcs=held.rcs)
    assert again.grant == held.grant
    # The rights count once it would be queued again.
    await ada.ask("takes", "robot/a", priority=10)
    await until(lambda: bob.notices)
    assert (bob.notices[-1].state, bob.notices[-1].outcome) == ("ended", "preempted")


# What RCs report


def forged(grant: Grant, *rcs: str, client: str = "bob/one", **more: Any) -> Holder:
    fields: dict[str, Any] = {
        "place": Place(OLD, 1), "priority": 1_000_000, "keep": True, "bound": {"robot/*": rcs[0]},
        "booking": f"hers@{NOON + 5000:.0f}", "who": Who("ada"), "continues": "x",
    }  # fmt: skip
    told = fields | more
    return Holder("q", "q", client, grant, rcs=list(rcs), min_runtime=Decimal(600), remaining=600.0, **told)


async def reporting(client: str = "bob/one", **more: Any) -> tuple[ClosedFleet, Candidate, FakeRc, FakeClient]:
    """An heir that found a forged hold at an RC, and an honest client."""
    fleet, leader, heir, (robot, *_) = await closed("a", "b")
    ada = fleet.client("three", "ada")
    await do(ada, book("hers", "robot/a", at=5000), BookingView)
    robot.holders = [forged(Grant(OLD, 7), "robot/a", client=client, **more)]
    await fleet.taken_over(leader, heir)
    return fleet, heir, robot, ada


async def test_of_a_hold_that_an_rc_reports_the_rest_is_its_clients_word() -> None:
    fleet, _, robot, ada = await reporting()
    [hold] = (await fleet.state()).holds
    assert (hold.grant, hold.priority, hold.bound, hold.booking, hold.who) == (Grant(OLD, 7), 9, {}, "", None)
    assert hold.place.term > OLD
    assert [(item.priority, item.bound, item.continues) for item in robot.holders] == [(9, {}, "")]
    await served(ada, "robot/b")
    # Its RC's word does not protect it from an operator.
    assert (await ada.ask("over", "robot/a", priority=10)).state == "running"


async def test_what_its_client_says_counts_once_it_answers() -> None:
    fleet, _, robot, _ = await reporting()
    bob = fleet.mesh("bob", "one")
    client = FakeClient(bob, fleet.log)
    client.open = [listed("q", "robot/*", priority=3, grant=Grant(OLD, 7), rcs=["robot/a"], who=Who("x", "desk"))]
    client.start()
    await until(lambda: [item.priority for item in robot.holders] == [3])
    [hold] = (await fleet.state()).holds
    assert (hold.grant, hold.bound, hold.who) == (Grant(OLD, 7), {"robot/*": "robot/a"}, Who("bob", "desk"))
    assert hold.keep is False
    assert client.notices[-1].state == "running"


@pytest.mark.parametrize("needs", [(), ("robot/b",), ("robot/a", "robot/b"), ("robot/a:5",)], ids=str)
async def test_what_its_client_does_not_ask_for_ends(needs: tuple[str, ...]) -> None:
    fleet, _, robot, _ = await reporting()
    client = FakeClient(fleet.mesh("bob", "one"), fleet.log)
    client.open = [listed("q", *needs, grant=Grant(OLD, 7), rcs=["robot/a"])] if needs else []
    client.start()
    await until(lambda: Grant(OLD, 7) not in [item.grant for item in robot.holders])
    assert Grant(OLD, 7) in [item.grant for item in fleet.revoked]
    assert "ended" not in [item.state for item in client.notices] or not needs


async def test_what_its_client_asks_for_counts_as_well() -> None:
    fleet, _, robot, _ = await reporting()
    client = FakeClient(fleet.mesh("bob", "one"), fleet.log)
    asked = await client.ask("q", "robot/b", priority=2)
    assert (asked.state, asked.rcs, asked.priority) == ("running", ["robot/b"], 2)
    await until(lambda: not robot.holders)


async def test_a_forged_hold_that_is_reported_again_stays_the_word_of_its_rc() -> None:
    fleet, heir, robot, _ = await reporting()
    robot.token.close()
    robot.instance, robot.holders = "i2", [forged(Grant(OLD, 9), "robot/a")]
    again = robot.mesh.alive(Token("devices", Role.RC, "robot/a", "i2"))
    await until(lambda: [hold.priority for hold in robot.holders] == [9])
    assert heir.rcm is not None
    arc = heir.rcm.core.arc("bob/one/q")
    assert arc is not None
    assert not arc.vouched
    client = FakeClient(fleet.mesh("bob", "one"), fleet.log)
    client.open = [listed("q", "robot/b")]
    client.start()
    await until(lambda: client.notices and client.notices[-1].rcs == ["robot/b"])
    again.close()


@pytest.mark.parametrize("client", ["mallory/c1", "wall/c1"])
async def test_a_hold_for_nobody_is_revoked_by_name(client: str) -> None:
    fleet, _, robot, ada = await reporting(client)
    await until(lambda: not robot.holders)
    [revoked] = fleet.revoked
    assert (revoked.grant, revoked.client) == (Grant(OLD, 7), client)
    assert revoked.reason == "released by the fleet file, which names its owner under no role"
    await served(ada, "robot/a")


async def test_a_client_that_answered_has_its_own_word_in_the_same_instant() -> None:
    fleet, leader, heir, (robot, other) = await closed("a", "b")
    bob, ada = fleet.client("one", "bob"), fleet.client("three", "ada")
    held = await bob.ask("q", "robot/*", priority=2)
    bob.open = [listed("q", "robot/*", priority=2, place=held.place, seal=held.seal, grant=held.grant, rcs=held.rcs)]
    robot = next(item for item in (robot, other) if item.holders)
    robot.holders = [forged(grant_of(held), *held.rcs, bound={"*/a#9": held.rcs[0]})]
    await fleet.taken_over(leader, heir)
    [hold] = (await fleet.state()).holds
    assert (hold.grant, hold.priority, hold.keep, hold.place) == (held.grant, 2, False, held.place)
    assert hold.bound == held.bound
    assert not bob.notices
    await served(ada, next(item for item in ("robot/a", "robot/b") if item not in held.rcs))


async def test_an_rc_that_joins_later_is_believed_no_more() -> None:
    fleet, _, _, _ = await closed("a")
    ada = fleet.client("three", "ada")
    late = FakeRc(fleet.mesh("devices", "late"), "robot/late")
    late.holders = [forged(Grant(OLD, 7), "robot/late"), forged(Grant(OLD, 8), "robot/late", client="wall/c1")]
    late.start()
    await fleet.joined(late)
    holds = (await fleet.state()).holds
    assert [(item.client, item.priority) for item in holds if item.client == "bob/one"] in ([], [("bob/one", 9)])
    assert "wall/c1" not in [item.client for item in holds]
    await served(ada, "robot/a")


# Keepers


async def test_records_and_fleet_time_are_taken_from_managers_only() -> None:
    fleet, leader, heir, _ = await closed("a")
    keeper = BookingKeeper(fleet.mesh("devices", "node"), candidate=True, wall=lambda: fleet.time() + 86_400)
    keeper.records.take([record(book("forged", "robot/a", at=30), owner="ada")])
    keeper._offset, keeper._run = 1_900_000_000 * 10**9, 900_000_000 * 10**9
    keeper.start(Supervisor("devices", lambda error: pytest.fail(str(error))))
    token = keeper.mesh.alive(Token("devices", Role.NODE, "node", "1"))
    await asyncio.sleep(10)
    for candidate in (leader, heir):
        told = await fleet.told()
        assert (told.bookings, abs(told.time - fleet.time()) < 1, told.clocks) == ([], True, {})
        if candidate is leader:
            await fleet.taken_over(leader, heir)
            await asyncio.sleep(5)
    # It still gets the records, and its own ones cause no repeated sharing.
    bob = fleet.client("one", "bob")
    fleet.candidate("x")
    await do(bob, book("his", "robot/a", at=500), BookingView)
    await asyncio.sleep(2)
    assert {item.id for item in keeper.records} == {"forged", "his"}
    assert heir.rcm is not None
    assert heir.rcm.sharing._behind is False
    token.close()


# What is asked


async def test_a_dry_run_and_a_hand_over_pass_the_same_door() -> None:
    fleet, _, _, _ = await closed("a", max_requests_per_client=2)
    bob, eve = fleet.client("one", "bob"), fleet.client("two", "eve")
    await bob.ask("one", "robot/a")
    await bob.ask("two", "robot/a")
    for priority, code in ((0, "too_many"), (10, "not_allowed"), (10**7, "bad_request")):
        asked = request("dry", "robot/a", priority=priority)
        for operation in (asked, Foresee("dry", "dry", asked.needs, asked.priority, Decimal(60))):
            with pytest.raises(Refusal) as refused:
                await do(bob, operation, Foresight)
            assert refused.value.code == code
    await eve.ask("one", "robot/a")
    await eve.ask("other", "robot/a")
    with pytest.raises(Refusal, match="eve/two has room for 0 more requests, not for 1"):
        await bob.do(HandOver("two", "eve/two"))


@pytest.mark.parametrize("what", ["records", "dates"])
async def test_one_name_has_half_of_the_room_for_bookings(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with what it gave up, which is kept until its last date, a year ahead at most."""
    monkeypatch.setattr(booking_handler, "MAX_BOOKINGS" if what == "records" else "MAX_CLAIMS", 6)
    fleet, _, _, _ = await closed("a")
    bob, eve = (fleet.client("c", name) for name in ("bob", "eve"))
    series = {"every": 1, "until": round(NOON) + 2 * 86_400 + 500} if what == "dates" else {}
    told = []
    for number in range(4 if what == "records" else 2):
        try:
            await do(bob, book(f"b{number}", "robot/a", at=500 + 200 * number, **series), BookingView)
            told.append("booked")
        except Refusal as refusal:
            told.append(str(refusal)[:8])
        if what == "records":
            with contextlib.suppress(Refusal):
                await do(bob, Unbook(f"b{number}"), BookingView)
    assert told == [*["booked"] * (len(told) - 1), "too_many"]
    await do(eve, book("hers", "robot/a", at=5000), BookingView)
