"""A term from request to notice: the real RCM and core on a mesh in memory."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.mesh.kit import until
from tests.services.rcm.kit import FakeClient, FakeFleet, Refusal, fleet_of, grant_of
from zscout.config.access import AccessPolicy, Quota, Roles
from zscout.messages import Cancel, EndedHold, HandOver, Release
from zscout.rcm.state_view import MAX_BUILT, StateView
from zscout.rcm.steps import CoreEvents
from zscout.scheduling.model import Adopted, ArcRequest, RcJoined, RecoveredHold
from zscout.types import SECOND, Grant, Place, Term


async def test_a_grant_is_published_and_the_loser_told_while_its_answer_is_on_the_way() -> None:
    fleet, (robot,) = await fleet_of("robot/a")
    survey, operator = fleet.client("survey"), fleet.client("operator")
    first = await survey.ask("survey", "robot/a")
    fleet.log.clear()
    await operator.ask("drive", "robot/a", priority=10)
    # The first two are under way together, to different processes.
    assert sorted(fleet.log[:2]) == [("all", "grants", "robot/a"), ("survey", "notice", "survey queued")]
    assert fleet.log[2:] == [("operator", "answer", "drive running")]
    (preempted,) = survey.notices
    assert (preempted.outcome, preempted.by, preempted.grant) == ("preempted", "desk/operator/drive", first.grant)
    # Why it waits now is told a little later.
    await until(lambda: len(survey.notices) == 2)
    assert survey.notices[1].reason == "waits for drive (desk/operator): robot/a"
    # The end of a hold that its own client released is told by the answer alone.
    await operator.do(Release("drive"))
    await until(lambda: survey.notices[-1].state == "running")
    assert operator.notices == []
    assert robot.arcs == ["survey"]
    story = [line.text for line in (await fleet.state(arc="survey")).story]
    assert story == [
        "asked for robot/a at priority 0",
        "granted robot/a",
        "preempted by drive (desk/operator), priority 10; queued again",
        "waits for drive (desk/operator): robot/a",
        "granted robot/a",
    ]


async def test_a_reason_is_in_the_story_once_as_soon_as_an_answer_has_it() -> None:
    fleet, _ = await fleet_of("robot/a")
    survey, chat, desk = fleet.client("survey"), fleet.client("chat"), fleet.client("desk")
    await survey.ask("survey", "robot/a")

    async def story() -> list[str]:
        return [line.text for line in (await fleet.state(arc="chat")).story]

    asked = "asked for robot/a at priority 0"
    waits = (await chat.ask("chat", "robot/a")).reason
    assert await story() == [asked, waits]
    await asyncio.sleep(1)
    assert await story() == [asked, waits]
    await chat.do(HandOver("chat", desk.name))
    await asyncio.sleep(1)
    assert await story() == [asked, waits, "handed over to desk/desk", waits]


async def test_who_missed_how_its_hold_ended_is_told_when_it_asks_again() -> None:
    fleet, _ = await fleet_of("robot/a")
    survey, operator = fleet.client("survey"), fleet.client("operator")
    held = grant_of(await survey.ask("survey", "robot/a"))
    await operator.ask("drive", "robot/a", priority=10)
    told = await survey.ask("survey", "robot/a", grant=held)
    assert (told.state, told.outcome, told.by) == ("queued", "preempted", "desk/operator/drive")
    # Of a grant that it can't know nothing is known but that it is none.
    other = Grant(Term(1, "another"), 7)
    assert (await survey.ask("survey", "robot/a", grant=other)).outcome == "lost"
    await operator.do(Release("drive"))
    await until(lambda: survey.notices[-1].state == "running")
    assert (await survey.ask("survey", "robot/a", grant=held)).outcome is None


async def test_what_arrives_in_one_burst_is_one_instant_and_ends_come_first() -> None:
    fleet = FakeFleet()
    rcm = fleet.rcm()
    robots = [fleet.rc(f"robot/{name}") for name in "ab"]
    await fleet.joined(*robots)
    client = fleet.client("one")
    await client.ask("first", "robot/a")
    before, seq = rcm.core.batches, fleet.published[-1].seq
    answers = await asyncio.gather(
        client.ask("second", "robot/a"), client.ask("third", "robot/b"), client.do(Release("first"))
    )
    assert [answer.state for answer in answers] == ["running", "running", "ended"]
    assert rcm.core.batches == before + 1
    assert [grants.prev for grants in fleet.published if grants.seq > seq] == [seq]
    # Of one ARC the order counts: it is asked for and given up, in two instants.
    asked, cancelled = await asyncio.gather(client.ask("fourth", "robot/a"), client.do(Cancel("fourth")))
    assert (asked.state, cancelled.outcome) == ("queued", "cancelled")


async def test_asking_again_tells_how_it_stands_and_what_ended_is_remembered() -> None:
    fleet, _ = await fleet_of("robot/a")
    client = fleet.client("one")
    first = await client.ask("first", "robot/a", seconds=2)
    assert grant_of(await client.ask("first", "robot/a", seconds=2)) == first.grant
    await until(lambda: client.notices)
    assert (client.notices[0].state, client.notices[0].outcome) == ("ended", "completed")
    assert (await client.ask("first", "robot/a", seconds=2)).outcome == "completed"
    await asyncio.sleep(61)
    assert (await client.ask("second", "robot/a")).state == "running"
    await client.do(Release("second"))
    assert (await client.ask("first", "robot/a")).state == "running"
    with pytest.raises(Refusal, match="bad_request: needs is empty"):
        await client.ask("third")


async def test_a_vote_that_is_late_grants_later_and_a_veto_is_a_reason() -> None:
    fleet = FakeFleet()
    fleet.rcm()
    radio = fleet.rc("radio/f", accept=None)
    await fleet.joined(radio)
    client = fleet.client("one")
    begin = asyncio.get_running_loop().time()
    answer = await client.ask("talk", "radio/f:5")
    waited = asyncio.get_running_loop().time() - begin
    assert (answer.state, answer.reason) == ("queued", "radio/f does not answer")
    assert waited == pytest.approx(0.25, abs=0.01)  # the vote is overdue
    await asyncio.sleep(0.5)
    radio.vote(accept=True)
    await until(lambda: client.notices and client.notices[-1].state == "running")
    # A veto is a reason. It stands until the rules of the RC change.
    radio.accept = False
    assert (await client.ask("more", "radio/f:9")).reason == "waits for talk (desk/one): radio/f refuses more: too much"
    await client.ask("more", "radio/f:9")
    assert [len(proposal.holders) for proposal in radio.proposals] == [1, 2]
    radio.accept, radio.rules = True, 1
    radio.publish()
    await until(lambda: radio.arcs == ["talk", "more"])


async def test_a_request_that_an_rc_can_not_read_does_not_keep_others_from_it() -> None:
    fleet = FakeFleet()
    fleet.rcm()
    radio = fleet.rc("radio/f", unreadable="bad")
    await fleet.joined(radio)
    client = fleet.client("one")
    assert (await client.ask("bad", "radio/f:5")).reason == "radio/f refuses: no such parameter: pace"
    assert (await client.ask("good", "radio/f:5")).state == "running"


async def test_an_rc_that_comes_is_granted_and_one_that_goes_ends_the_whole_gang() -> None:
    fleet = FakeFleet()
    fleet.rcm()
    client = fleet.client("one")
    answer = await client.ask("gang", "robot/a", "robot/b")
    assert "not on the mesh" in answer.reason
    robots = [fleet.rc(f"robot/{name}") for name in "ab"]
    await until(lambda: client.notices and client.notices[-1].state == "running")
    place = client.notices[-1].place
    # It can't carry its holder any longer, and then it can.
    robots[0].publish(health="no power")
    await until(lambda: client.notices[-1].outcome == "lost")
    assert client.notices[-1].reason == "robot/a was lost: no power"
    assert fleet.published[-1].rcs == {"robot/a": [], "robot/b": []}
    robots[0].publish()
    await until(lambda: client.notices[-1].state == "running")
    # Its token goes; another instance comes.
    robots[1].token.close()
    await until(lambda: client.notices[-1].reason == "robot/b was lost: it is gone from devices")
    fleet.rc("robot/b", instance="i2")
    await until(lambda: client.notices[-1].state == "running")
    assert client.notices[-1].place == place


async def test_what_an_rc_reports_is_set_right() -> None:
    fleet, (robot,) = await fleet_of("robot/a")
    client = fleet.client("one")
    grant = grant_of(await client.ask("first", "robot/a"))
    (holder,) = robot.holders
    # It has ended the hold of its own: the ARC is queued, and granted anew.
    robot.holders = []
    robot.publish(ended=[EndedHold("first", grant, "lease")])
    await until(lambda: client.notices and client.notices[-1].state == "running")
    assert client.notices[0].reason == "robot/a ended the hold"
    # It has a holder too many: who holds it is published again.
    count = len(fleet.published)
    stranger = msgspec.structs.replace(holder, grant=Grant(Term(1, "other"), 3), arc="stranger")
    robot.holders = [*robot.holders, stranger]
    robot.publish()
    await until(lambda: robot.arcs == ["first"])
    assert len(fleet.published) == count + 1
    # What it does not name and has not heard of yet is not lost.
    robot.holders, robot.seq = [], robot.seq - 1
    robot.publish()
    await asyncio.sleep(1)
    assert client.notices[-1].state == "running"
    assert [view.arc for view in (await fleet.state()).holds] == ["first"]


async def test_a_client_that_is_gone_leaves_nothing() -> None:
    fleet, (robot,) = await fleet_of("robot/a")
    gone, heir = fleet.client("gone"), fleet.client("heir")
    await gone.ask("first", "robot/a")
    await gone.ask("second", "robot/a")
    await heir.ask("third", "robot/a")
    begin = asyncio.get_running_loop().time()
    fleet.network.kill(gone.mesh)
    await until(lambda: robot.arcs == ["third"])
    assert asyncio.get_running_loop().time() - begin < 0.01
    assert (await fleet.state()).queue == []
    # Who asks, shows no token and does not answer is dropped after a lease.
    ghost = FakeClient(fleet.mesh("desk", "ghost"), fleet.log)
    await ghost.ask("fourth", "robot/a", priority=5)
    await until(lambda: robot.arcs == ["fourth"])
    await until(lambda: robot.arcs == ["third"], within=2 * fleet.fleet.mesh.lease)


async def test_a_client_has_a_lease_to_show_itself_and_longer_where_the_leader_stood_still_in_it() -> None:
    fleet = FakeFleet()
    rcm, robot = fleet.rcm(), fleet.rc("robot/a")
    await fleet.joined(robot)
    ghost, lease = FakeClient(fleet.mesh("desk", "ghost"), fleet.log), fleet.fleet.mesh.lease
    await ghost.ask("first", "robot/a")
    await until(lambda: robot.arcs == ["first"])
    await asyncio.sleep(0.7 * lease)
    stall = rcm._stall
    stall.length, stall.ended = round(0.6 * lease * SECOND), rcm.mesh.now()
    await asyncio.sleep(lease)
    assert robot.arcs == ["first"]
    await until(lambda: not robot.arcs, within=lease)


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("goes_first", [False, True])
async def test_a_client_that_goes_in_the_burst_of_its_request_leaves_nothing(goes_first: bool, alone: bool) -> None:
    """`alone`: no other host is there that could say whether the leader was away."""
    fleet = FakeFleet()
    fleet.rcm()
    if not alone:
        await fleet.joined(fleet.rc("robot/a"))
    client = fleet.client("brief")
    if goes_first:
        client.token.close()
    asking = asyncio.ensure_future(client.ask("brief", "robot/a"))
    await asyncio.sleep(0)
    client.token.close()
    await asking
    await asyncio.sleep(2 * fleet.fleet.mesh.lease)
    state = await fleet.state()
    assert (state.holds, state.queue, fleet.failures) == ([], [], [])


async def test_a_hand_over_is_one_publication_and_can_be_repeated() -> None:
    fleet, robots = await fleet_of("robot/a", "robot/b")
    old, new, rival = fleet.client("old"), fleet.client("new"), fleet.client("rival")
    first = await old.ask("first", "robot/a", seconds=600)
    await rival.ask("rival", "robot/b")
    place = (await old.ask("second", "robot/b", seconds=600)).place
    await rival.ask("third", "robot/a")
    count = len(fleet.published)
    order = HandOver("first", new.name, ["second", "none"])
    answer = await old.do(order)
    assert (answer.client, answer.state, answer.place) == (new.name, "running", first.place)
    assert grant_of(answer) > grant_of(first)
    assert len(fleet.published) == count + 1
    assert [holder.client for holder in robots[0].holders] == [new.name]
    assert [(notice.arc, notice.state) for notice in new.notices] == [("first", "running"), ("second", "queued")]
    assert new.notices[1].place == place
    assert {notice.arc: notice.outcome for notice in old.notices} == dict.fromkeys(("first", "second"), "handed_over")
    # Doing it twice is doing it once; the new client may have missed it.
    new.notices.clear()
    assert (await old.do(order)).grant == answer.grant
    await until(lambda: {notice.arc for notice in new.notices} == {"first", "second"})
    with pytest.raises(Refusal, match="not_running"):
        await old.do(HandOver("other", new.name))
    with pytest.raises(Refusal, match="unknown_client"):
        await new.do(HandOver("first", "desk/nobody"))
    # What went on elsewhere is not queued once more at its old place.
    await asyncio.sleep(61)
    await new.do(Cancel("second"))
    again = await old.ask("first", "robot/a", place=first.place)
    assert (again.outcome, again.reason) == ("handed_over", "handed over to another client")


async def test_a_hold_that_is_adopted_and_displaced_in_one_instant_is_told_as_it_ended() -> None:
    fleet = FakeFleet()
    rcm, one, two = fleet.rcm(counter=5), fleet.client("one"), fleet.client("two")
    await until(lambda: rcm.roster.clients.keys() >= {one.name, two.name})
    assert (await two.ask("next", "robot/a")).state == "queued"
    before, at = Term(4, "before"), rcm.mesh.now()
    kept = ArcRequest(f"{one.name}/id", one.name, {"robot/a": {}}, 0, SECOND, keep=True, label="tally")
    held = RecoveredHold(kept, Place(before, 1), Grant(before, 3), at - 5 * SECOND, at - 4 * SECOND)
    rcm._take_now(CoreEvents([RcJoined("robot/a", sharable=False), Adopted(held)]))
    await until(lambda: one.notices)
    assert [(it.state, it.outcome, it.grant) for it in one.notices] == [("ended", "completed", Grant(before, 3))]


async def test_who_waited_is_told_of_its_grant_before_the_rcs_are() -> None:
    fleet, _ = await fleet_of("robot/a")
    holder, waiter = fleet.client("holder"), fleet.client("waiter")
    await holder.ask("first", "robot/a")
    await waiter.ask("next", "robot/a")
    fleet.log.clear()
    await holder.do(Release("first"))
    assert fleet.log == [
        ("waiter", "notice", "next running"),
        ("all", "grants", "robot/a"),
        ("holder", "answer", "first ended"),
    ]


async def test_who_is_preempted_and_granted_in_one_instant_is_told_in_that_order() -> None:
    fleet, _ = await fleet_of("robot/a", "robot/b")
    client, operator = fleet.client("any"), fleet.client("operator")
    first = (await client.ask("any", "robot/*")).rcs
    await operator.ask("drive", *first, priority=10)
    await until(lambda: len(client.notices) >= 2)
    assert [(notice.state, notice.outcome, notice.rcs) for notice in client.notices[:2]] == [
        ("queued", "preempted", first),
        ("running", None, ["robot/a" if first == ["robot/b"] else "robot/b"]),
    ]
    assert client.notices[0].step < client.notices[1].step


async def test_rcs_settle_unless_the_client_says_that_its_program_is_gone() -> None:
    """One that started anew under its name gives back what it knows nothing of: a program of that may run yet."""
    fleet, _ = await fleet_of("robot/a")
    client = fleet.client("one")
    for arc, left in (("first", False), ("second", True)):
        await client.ask(arc, "robot/a", direct=True)
        await client.do(Release(arc, left=left))
        assert [one.own for one in fleet.published[-1].revoked] == [left]


async def test_a_hand_over_needs_room_at_the_new_client_and_on_its_host() -> None:
    fleet = FakeFleet()
    limits = msgspec.structs.replace(fleet.fleet.limits, max_requests_per_client=2, max_requests_per_host=3)
    fleet.fleet = msgspec.structs.replace(fleet.fleet, limits=limits)
    fleet.rcm()
    await fleet.joined(fleet.rc("robot/a"))
    old, new, beside = (fleet.client(name, host) for name, host in (("old", "desk"), ("new", "h2"), ("more", "h2")))
    for client, arcs in ((old, "ab"), (new, "c"), (beside, "de")):
        for arc in arcs:
            await client.ask(arc, "robot/a")
    with pytest.raises(Refusal, match="too_many: h2/new has room for 1 more requests, not for 2"):
        await old.do(HandOver("a", new.name, ["b"]))
    with pytest.raises(Refusal, match="too_many: the clients of h2 have room for 0 more requests, not for 1"):
        await old.do(HandOver("a", new.name))
    await beside.do(Cancel("e"))
    assert (await old.do(HandOver("a", new.name))).client == new.name
    # What is there already needs none.
    assert (await old.do(HandOver("a", new.name))).client == new.name
    # Among the programs of one host nothing is added to what it has.
    await old.ask("f", "robot/a")
    await old.do(HandOver("b", fleet.client("next").name))


async def test_an_arc_that_is_open_at_its_new_client_already_counts_once_against_a_quota() -> None:
    """A hand-over is repeated so where the RCM changed, and the new client asked before the old one did."""
    fleet = FakeFleet()
    access = AccessPolicy(roles=Roles(client=("desk", "h2")), quotas={"h2": Quota(arcs=1, rcs=1)})
    fleet.fleet = msgspec.structs.replace(fleet.fleet, security=Path("keys"), access=access)
    fleet.rcm()
    await fleet.joined(fleet.rc("robot/a"), fleet.rc("robot/b"))
    old, new = fleet.client("old"), fleet.client("new", "h2")
    await old.ask("a", "robot/a")
    assert (await new.ask("a", "robot/a")).state == "queued"
    assert (await old.do(HandOver("a", new.name))).client == new.name
    await old.ask("b", "robot/b")
    with pytest.raises(Refusal, match="not_allowed: h2 may have 1 open requests, and would have more"):
        await old.do(HandOver("b", new.name))


async def test_many_questions_about_the_state_cost_what_a_few_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, _ = await fleet_of("robot/a")
    built, real = [], StateView.state

    def counted(self: StateView, *args: Any) -> Any:
        built.append(args)
        return real(self, *args)

    monkeypatch.setattr(StateView, "state", counted)
    client = fleet.client("one")
    asked = [fleet.state(forecast=bool(number % 2)) for number in range(400)]
    states = await asyncio.gather(*asked, *(client.ask(f"a{number}", "robot/a") for number in range(20)))
    assert len(states) == 420
    assert len(built) <= 2 * MAX_BUILT * 2  # two kinds, in at most two spans
    # RCs reckon ends by this one.
    built.clear()
    await asyncio.gather(*(fleet.state(holds_only=True) for _ in range(5)))
    assert len(built) == 5
