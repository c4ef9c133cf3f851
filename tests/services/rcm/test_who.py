"""Who asks goes with a request wherever it goes, and whoever is in its way is told."""

from __future__ import annotations

import asyncio
from decimal import Decimal

import pytest

from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import do
from tests.services.rcm.kit import FakeFleet, Refusal, fleet_of
from zscout.messages import Cancel, ClientRequests, Foresee, Foresight, HandOver, OpenRequest, Who
from zscout.services.rcm.recovery import take_over
from zscout.types import Place, Term

ALICE = Who("alice", "ws1", "survey.py")
BOB = Who("bob", "ws2", "zscout take", "the gripper is stuck")


async def test_who_preempts_and_why_is_told_to_whom_it_preempts() -> None:
    fleet, (robot,) = await fleet_of("robot/a")
    survey, operator = fleet.client("survey"), fleet.client("operator")
    await survey.ask("survey", "robot/a", who=ALICE)
    assert [holder.who for holder in robot.holders] == [ALICE]
    await operator.ask("drive", "robot/a", priority=10, seconds=60, who=BOB)
    (preempted,) = survey.notices
    assert preempted.reason == "preempted by drive (bob@ws2), priority 10: the gripper is stuck"
    (revoked,) = fleet.published[-1].revoked
    assert revoked.reason == preempted.reason
    for why in (preempted.why, revoked.why):
        assert why is not None
        assert [(one.client, one.id, one.priority, one.who) for one in why.by] == [("desk/operator", "drive", 10, BOB)]
    await until(lambda: len(survey.notices) == 2)
    waits = survey.notices[1]
    assert (waits.reason, waits.who) == ("waits for drive (bob@ws2): robot/a", ALICE)
    state = await fleet.state(arc="survey")
    assert [(hold.arc, hold.who) for hold in state.holds] == [("drive", BOB)]
    assert [(wait.arc, wait.who) for wait in state.queue] == [("survey", ALICE)]
    assert [line.text for line in state.story] == [
        "asked for robot/a at priority 0",
        "granted robot/a",
        "preempted by drive (bob@ws2), priority 10: the gripper is stuck; queued again",
        "waits for drive (bob@ws2): robot/a",
    ]


async def test_until_when_it_waits_at_the_latest_is_a_duration() -> None:
    """Of whom it outranks or equals the end of the minimum runtime; of a kept hold of higher rank nothing is known."""
    fleet, _ = await fleet_of("robot/a", "robot/b", "robot/c")
    client = fleet.client("one")
    await client.ask("equal", "robot/a", seconds=60, keep=True)
    await client.ask("higher", "robot/b", seconds=60, priority=5)
    await client.ask("kept", "robot/c", seconds=60, priority=5, keep=True)
    waits = await client.ask("late", "robot/a", "robot/b", "robot/c")
    assert waits.why is not None
    told = {one.arc: one.yields_in for one in waits.why.by}
    assert told == {"equal": pytest.approx(60, abs=0.1), "higher": pytest.approx(60, abs=0.1), "kept": None}
    await asyncio.sleep(20)
    (wait,) = (await fleet.state()).queue
    assert wait.why is not None
    assert {one.arc: one.yields_in for one in wait.why.by}["higher"] == pytest.approx(40, abs=0.1)


async def test_all_choices_of_a_pattern_are_named() -> None:
    fleet = FakeFleet()
    fleet.rcm()
    grabbers = [fleet.rc(f"framegrabber/fg{number}") for number in range(4)]
    await fleet.joined(*grabbers, robot := fleet.rc("robot/a"))
    client = fleet.client("one")
    for number in range(4):
        await client.ask(f"user{number}", f"framegrabber/fg{number}", priority=1, who=Who(f"u{number}", "ws", "x"))
    answer = await client.ask("any", "framegrabber/*", "robot/a")
    assert answer.reason == (
        "waits for one of framegrabber/fg0 (held by user0 (u0@ws)), fg1 (held by user1 (u1@ws)), "
        "fg2 (held by user2 (u2@ws)), fg3 (held by user3 (u3@ws))"
    )
    assert answer.why is not None
    assert (answer.why.pattern, answer.why.count) == ("framegrabber/*", 4)
    assert answer.why.patterns == ["framegrabber/*"] * 4
    await client.ask("drives", "robot/a", priority=1, who=ALICE)
    await until(lambda: client.notices and "robot/a" in client.notices[-1].reason)
    assert client.notices[-1].reason.startswith(
        "waits for drives (alice@ws1): robot/a; for one of framegrabber/fg0 (held by user0 (u0@ws)), fg1 "
    )
    assert robot.arcs == ["drives"]


async def test_who_is_unknown_is_named_by_client_and_arc_and_who_cancels_by_name() -> None:
    fleet, _ = await fleet_of("robot/a")
    plain, operator = fleet.client("plain"), fleet.client("operator")
    await plain.ask("survey", "robot/a")
    answer = await operator.ask("late", "robot/a")
    assert answer.reason == "waits for survey (desk/plain): robot/a"
    await operator.do(Cancel("survey", "desk/plain", BOB))
    await until(lambda: plain.notices)
    assert plain.notices[-1].reason == "cancelled by bob@ws2"
    await plain.do(Cancel("late", "desk/operator"))
    await until(lambda: operator.notices and operator.notices[-1].state == "ended")
    assert operator.notices[-1].reason == "cancelled by desk/plain"


async def test_it_goes_on_elsewhere_under_the_same_user_on_the_new_host() -> None:
    fleet, (robot,) = await fleet_of("robot/a")
    old, new = fleet.client("old"), fleet.client("new")
    await old.ask("counter", "robot/a", who=ALICE)
    await old.do(HandOver("counter", new.name))
    assert [holder.who for holder in robot.holders] == [Who("alice", "", "survey.py")]
    assert (await new.ask("late", "robot/a")).reason == "waits for counter (alice@desk): robot/a"


async def test_the_next_leader_knows_it_from_the_rcs_and_from_the_clients() -> None:
    fleet = FakeFleet()
    first = fleet.rcm()
    robot = fleet.rc("robot/a")
    await fleet.joined(robot)
    client, other = fleet.client("one"), fleet.client("two")
    held = await client.ask("survey", "robot/a", who=ALICE)
    client.open = [OpenRequest("survey", "survey", {"robot/a": {}}, 0, Decimal(60), place=held.place)]
    first.stop()
    waits = OpenRequest("late", "late", {"robot/a": {}}, 0, Decimal(60), place=Place(Term(1, "rcm"), 9), who=BOB)
    other.open = [waits]
    recovered = take_over([robot.state()], [ClientRequests(other.name, [waits])], client.mesh.now())
    assert [held.grant for held in recovered.holds] == [held.grant]
    fleet.rcm(2, recovered)
    await fleet.joined(robot)
    state = await fleet.state()
    assert [hold.who for hold in state.holds] == [ALICE]
    assert [(wait.who, wait.reason) for wait in state.queue] == [(BOB, "waits for survey (alice@ws1): robot/a")]


async def test_a_forecast_names_whom_it_would_preempt() -> None:
    fleet, _ = await fleet_of("robot/a")
    client = fleet.client("one")
    await client.ask("survey", "robot/a", who=ALICE)
    foreseen = await do(client, Foresee("x", "x", {"robot/a": {}}, 5, Decimal(1)), Foresight)
    assert foreseen.preempts == ["survey"]
    assert [(one.id, one.who) for one in foreseen.victims] == [("survey", ALICE)]


@pytest.mark.parametrize("who", [Who("u" * 65), Who(host="h" * 65), Who(command="c" * 65), Who(comment="c" * 201)])
async def test_what_is_too_long_to_be_shown_is_refused(who: Who) -> None:
    fleet, _ = await fleet_of("robot/a")
    with pytest.raises(Refusal, match=r"malformed: not a valid operation: .*length <= "):
        await fleet.client("one").ask("survey", "robot/a", who=who)
    assert not (await fleet.state()).holds
