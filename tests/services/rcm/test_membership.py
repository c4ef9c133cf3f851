"""RCs that join with holds of earlier terms, and what RCs report, compared with what the RCM believes."""

from __future__ import annotations

import asyncio
from decimal import Decimal
from typing import Any
from unittest.mock import ANY

import pytest
from msgspec.structs import replace

from tests.mesh.kit import until
from tests.services.rcm.kit import FakeFleet, FakeRc, fleet_of, sees
from zscout.config.fleet import default_fleet
from zscout.mesh import IncomingQuery
from zscout.messages import Holder, OpenRequest, RcAsk, RcState
from zscout.rcm.recovery import RecoveredState
from zscout.rcm.roster import discrepancies
from zscout.rcm.state_view import holders_of
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, HandedOver, LeadTaken, RcJoined, Requested
from zscout.scheduling.strategies import STRATEGIES
from zscout.testing.link import Disturbance
from zscout.testing.virtual_time import VirtualTimeLoop
from zscout.types import SECOND, Grant, Place, Term

RC = "robot/x"
TERM = Term(1, "m")
NOW = 1000 * SECOND


def granted() -> Core:
    """A core in which h/one holds RC."""
    core = Core(STRATEGIES["priority"]())
    request = ArcRequest("h/one/id", "h/one", {RC: {}}, 0, 60 * SECOND, label="tally")
    core.handle(NOW, RcJoined(RC, sharable=False), LeadTaken(TERM, (), ()), Requested(request))
    return core


def reports(core: Core, *, holds: bool = True) -> RcState:
    """What an RC reports that has received all that was published so far."""
    holders = holders_of(core.holders(RC), RC, NOW) if holds else []
    return RcState(rc=RC, host="d", instance="i", sharable=False, term=TERM, seq=core.seq, holders=list(holders))


def test_a_hold_that_its_rc_does_not_know_is_lost() -> None:
    core = granted()
    assert discrepancies(reports(core, holds=False), core.holders(RC), NOW, current=True) == (("h/one/id",), False)


def test_an_rc_that_presents_what_was_handed_over_has_not_heard_of_it_yet() -> None:
    """It read the state, with this number, before the publication came: the hand-over stands."""
    core = granted()
    before = reports(core)
    core.handle(NOW, HandedOver("h/one/id", "h/two", "h/two/id"))
    assert discrepancies(before, core.holders(RC), NOW, current=True) == ((), True)
    assert discrepancies(reports(core), core.holders(RC), NOW, current=True) == ((), False)


BEFORE = Term(4, "before")
RCS, MINUTE = ["robot/a", "robot/b"], Decimal(60)
HELD = Holder("tally", "tally", "desk/one", Grant(BEFORE, 9), Place(BEFORE, 7), RCS, MINUTE, remaining=50.0)
"""What robot/a and robot/b hold together since an earlier term."""
OTHER = replace(HELD, id="other", arc="other", grant=Grant(BEFORE, 5), place=Place(BEFORE, 3), rcs=["robot/c"])
"""What robot/c holds for the same client."""
BELIEVED: dict[str, Any] = {"grant": HELD.grant, "rcs": HELD.rcs, "place": HELD.place}
"""What its client says of it when it asks again."""


def listed(held: Holder = HELD) -> OpenRequest:
    """What its client tells of a hold."""
    needs: dict[str, dict[str, Decimal]] = {rc: {} for rc in held.rcs}
    return OpenRequest(held.arc, held.arc, needs, 0, Decimal(60), place=held.place, grant=held.grant, rcs=held.rcs)


def holding(fleet: FakeFleet, name: str, **how: bool) -> FakeRc:
    return fleet.rc(name, term=HELD.grant.term, holders=[HELD], **how)


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("apart", [0.1, 0.7])
async def test_rcs_that_join_one_after_the_other_keep_what_they_hold_together(apart: float, alone: bool) -> None:
    """Though nothing shows yet that the second is there: links to hosts that were cut off come back one by one."""
    fleet = FakeFleet()
    there = [] if alone else [fleet.rc("robot/c").state()]
    rcm = fleet.rcm(5, RecoveredState({state.rc: state for state in there}))
    client = fleet.client("one")
    client.open = [listed()]
    first = holding(fleet, "robot/a")
    await until(lambda: first.asked)
    await asyncio.sleep(apart)
    second = holding(fleet, "robot/b")
    await fleet.joined(first, second)
    assert (await client.ask("tally", *HELD.rcs, **BELIEVED)).grant == HELD.grant
    assert not fleet.revoked
    assert [holder.grant for holder in (*first.holders, *second.holders)] == [HELD.grant] * 2
    assert rcm.core.waiting == 0


async def test_a_leader_whose_links_come_back_waits_for_the_rest_of_a_gang_that_it_has_recovered() -> None:
    fleet = FakeFleet()
    first, other = holding(fleet, "robot/a"), fleet.rc("robot/c")
    promised = [replace(one.state(), term=Term(5, "rcm")) for one in (first, other)]
    client = fleet.client("one")
    client.open = [listed()]
    fleet.rcm(5, RecoveredState({"robot/c": promised[1]}, promised[:1], patient=True))
    await asyncio.sleep(0.7)
    await fleet.joined(first, holding(fleet, "robot/b"), other)
    assert not fleet.revoked


async def test_an_rc_that_has_not_joined_is_not_named_where_a_hold_of_it_ends() -> None:
    """What else it holds is not known: it may be about to come."""
    fleet = FakeFleet()
    fleet.rcm(5)
    holding(fleet, "robot/a")
    await until(lambda: fleet.revoked, within=5)
    (told,) = [one for one in fleet.published if one.revoked]
    assert (told.revoked[0].rcs, told.rcs) == (HELD.rcs, {"robot/a": []})


async def test_a_client_whose_rcs_come_back_one_after_the_other_has_a_lease_from_the_last_to_show_itself() -> None:
    fleet = FakeFleet()
    fleet.rcm(5)
    first = fleet.rc("robot/c", term=HELD.grant.term, holders=[OTHER])
    await asyncio.sleep(0.7)
    robots = [holding(fleet, name) for name in HELD.rcs]
    await asyncio.sleep(0.7)
    client = fleet.client("one")
    client.open = [listed(HELD), listed(OTHER)]
    await asyncio.sleep(3)
    assert [rc.holders for rc in (first, *robots)] == [[ANY], [ANY], [ANY]]
    assert not fleet.revoked


async def test_an_rc_with_several_gangs_has_its_lease_though_that_of_another_of_them_is_over() -> None:
    """`radio/r` answers as the wait of `robot/a`, with which it shares a gang, is over; `robot/c` comes after that."""
    fleet, term = FakeFleet(), HELD.grant.term
    fleet.rcm(5)
    first, second = replace(HELD, rcs=["radio/r", "robot/a"]), replace(OTHER, rcs=["radio/r", "robot/c"])
    client = fleet.client("one")
    client.open = [listed(first), listed(second)]
    robot = fleet.rc("robot/a", term=term, holders=[first])
    await asyncio.sleep(0.9)
    radio = fleet.rc("radio/r", term=term, holders=[first, second])
    await asyncio.sleep(0.6)
    other = fleet.rc("robot/c", term=term, holders=[second])
    await asyncio.sleep(3)
    assert not fleet.revoked
    assert [len(rc.holders) for rc in (robot, radio, other)] == [1, 2, 1]


async def test_whoever_of_its_gangs_goes_on_answering_an_rc_waits_for_three_leases_at_most() -> None:
    """Each answers within a lease of the one before, with which it shares a gang, and the next is always missing."""
    fleet, term = FakeFleet(), HELD.grant.term
    fleet.rcm(5)
    gangs = [
        replace(HELD, id=f"g{n}", arc=f"g{n}", grant=Grant(term, 9 + n), rcs=[f"radio/r{n}", f"radio/r{n + 1}"])
        for n in range(6)
    ]
    for number in range(5):
        fleet.rc(f"radio/r{number}", term=term, holders=gangs[max(0, number - 1) : number + 1])
        await asyncio.sleep(0.8)
        there = {view.rc for view in (await fleet.state()).rcs if view.present}
        assert ("radio/r0" in there) == (number >= 3), (number, there)


async def test_what_somebody_asked_for_long_ago_is_waited_for_whoever_believes_to_hold_it_now() -> None:
    """As on a host that was cut off and led alone: its own client asked first, and nobody else was there."""
    fleet = FakeFleet()
    fleet.rcm(5)
    later = replace(OTHER, client="desk/two")
    one, two = fleet.client("one"), fleet.client("two")
    first = asyncio.create_task(one.ask("tally", "robot/c", grant=HELD.grant, rcs=["robot/c"]))
    await asyncio.sleep(0.8)
    asking = asyncio.create_task(two.ask("other", "robot/c", grant=later.grant, rcs=["robot/c"]))
    assert (await first).state == "queued"
    fleet.rc("robot/c", term=HELD.grant.term, holders=[later])
    assert (await asking).grant == later.grant


async def test_an_rc_that_began_again_alone_is_waited_for_though_it_was_seen_before() -> None:
    """As on a host that began before its network was there: its client's link comes before its RC's."""
    fleet = FakeFleet()
    fleet.rcm(5)
    before = fleet.rc("robot/c")
    await fleet.joined(before)
    await before.mesh.close()
    await asyncio.sleep(5)
    one = fleet.client("one")
    asking = asyncio.create_task(one.ask("other", "robot/c", grant=OTHER.grant, rcs=["robot/c"]))
    await asyncio.sleep(0.5)
    fleet.rc("robot/c", term=OTHER.grant.term, holders=[OTHER], instance="i2")
    assert (await asking).grant == OTHER.grant


async def test_a_leader_that_stood_still_waits_for_what_may_be_held_as_if_it_had_just_been_asked() -> None:
    """What has come meanwhile is not handled yet."""
    fleet, loop = FakeFleet(), asyncio.get_running_loop()
    assert isinstance(loop, VirtualTimeLoop)
    fleet.rcm(5)
    alone = replace(OTHER, rcs=["robot/c"])
    asking = asyncio.create_task(fleet.client("one").ask("other", "robot/c", grant=alone.grant, rcs=["robot/c"]))
    await asyncio.sleep(0.5)
    loop.jump(1.2)
    fleet.rc("robot/c", term=alone.grant.term, holders=[replace(alone, client="desk/one")])
    assert (await asking).grant == alone.grant


async def test_a_leader_that_stood_still_waits_for_the_rest_of_a_gang_as_if_its_links_had_just_come_back() -> None:
    fleet, loop = FakeFleet(), asyncio.get_running_loop()
    assert isinstance(loop, VirtualTimeLoop)
    fleet.rcm(5)
    client = fleet.client("one")
    client.open = [OpenRequest("tally", "tally", {rc: {} for rc in HELD.rcs}, 0, Decimal(60), grant=HELD.grant)]
    first = holding(fleet, HELD.rcs[0])
    await asyncio.sleep(0.5)
    loop.jump(1.2)
    second = holding(fleet, HELD.rcs[1])
    await fleet.joined(first, second)
    assert [rc.arcs for rc in (first, second)] == [["tally"]] * 2
    assert not fleet.revoked


async def test_what_its_client_gave_up_with_another_leader_ends_once_the_client_is_heard() -> None:
    """That one's last word did not reach the RCs."""
    fleet = FakeFleet()
    fleet.rcm(5)
    robots = [holding(fleet, name) for name in HELD.rcs]
    await fleet.joined(*robots)
    assert [robot.arcs for robot in robots] == [["tally"]] * 2
    fleet.client("one")
    await until(lambda: not any(robot.holders for robot in robots))
    assert [(one.grant, one.outcome) for one in fleet.published[-1].revoked] == [(HELD.grant, "released")]


async def test_a_client_that_is_seen_and_does_not_say_what_it_asks_for_is_a_contradiction(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Its link came back without its queryable: what it gave up would be held for as long as it lives."""
    fleet = FakeFleet()
    fleet.network.disturb({"requests": Disturbance(lost=1.0)})
    fleet.rcm(5)
    robots = [holding(fleet, name) for name in HELD.rcs]
    await fleet.joined(*robots)
    fleet.client("one")
    said = "desk/one is seen and does not answer: reopening the mesh session"
    await until(lambda: said in caplog.messages)
    fleet.network.disturb({})
    await until(lambda: not any(robot.holders for robot in robots))


async def test_what_was_queued_by_the_word_of_an_rc_alone_ends_once_its_client_does_not_ask_for_it() -> None:
    """One RC of the gang had heard that it is over, the other had not: it is queued, and granted anew."""
    fleet = FakeFleet("h1")
    robots = [holding(fleet, "robot/a"), fleet.rc("robot/b")]
    fleet.candidate("h1")
    await until(lambda: all(robot.arcs == ["tally"] for robot in robots))
    assert all(robot.holders[0].grant > HELD.grant for robot in robots)
    fleet.client("one")
    await until(lambda: not any(robot.holders for robot in robots))


async def test_without_one_of_its_rcs_a_hold_ends_by_name_and_keeps_its_place() -> None:
    fleet = FakeFleet()
    fleet.rcm(5)
    client = fleet.client("one")
    client.open = [listed()]
    await fleet.joined(holding(fleet, "robot/a"))
    await until(lambda: client.notices)
    (revoked,) = fleet.published[-1].revoked
    assert (revoked.grant, revoked.outcome) == (HELD.grant, "lost")
    assert (client.notices[0].state, client.notices[0].grant) == ("queued", HELD.grant)
    assert (await client.ask("tally", *HELD.rcs)).place == HELD.place


@pytest.mark.parametrize("hears_again", [0.5, None])
async def test_an_rc_that_answers_a_new_leader_late_keeps_the_hold_of_its_gang(hears_again: float | None) -> None:
    """For a lease: then the RC that is seen and does not answer counts as gone."""
    fleet = FakeFleet("h1")
    client = fleet.client("one")
    client.open = [listed()]
    first, late = holding(fleet, "robot/a"), holding(fleet, "robot/b", deaf=True)
    candidate = fleet.candidate("h1")
    await until(lambda: candidate.rcm)
    # Its client is not told anything before it is known.
    answer = asyncio.create_task(client.ask("tally", *HELD.rcs, **BELIEVED))
    if hears_again is not None:
        await asyncio.sleep(hears_again)
        assert not answer.done()
        late.deaf = False
        await fleet.joined(first, late)
        assert (await answer).grant == HELD.grant
        assert not fleet.revoked
    else:
        notice = await answer
        assert (notice.state, notice.outcome, notice.place) == ("queued", "lost", HELD.place)
        assert [one.grant for one in fleet.revoked] == [HELD.grant]


@pytest.mark.parametrize("late", ["robot/a", "robot/c"])
async def test_a_hold_ends_when_its_rcs_end_it_however_long_a_new_leader_waited_for_others(late: str) -> None:
    """For one of its gang, or for one that it has nothing to do with."""
    fleet = FakeFleet("h1")
    client = fleet.client("one")
    client.open = [listed()]
    robots = {name: holding(fleet, name, deaf=name == late) for name in HELD.rcs}
    other = fleet.rc("robot/c", deaf=late == "robot/c")
    candidate = fleet.candidate("h1")
    await until(lambda: any(one.promise for one in robots["robot/b"].asked))
    ends = fleet.watcher.now() / SECOND + HELD.remaining
    await until(lambda: candidate.rcm)
    assert candidate.rcm is not None
    robots["robot/a"].deaf = other.deaf = False
    robots["robot/a"].holders = [replace(HELD, remaining=ends - fleet.watcher.now() / SECOND)]
    await fleet.joined(*robots.values())
    (arc,) = candidate.rcm.core.holders("robot/a")
    assert arc.hold is not None
    assert arc.hold.end / SECOND == pytest.approx(ends, abs=0.02)


async def test_what_its_client_gave_up_is_not_carried_on_when_its_rcs_answer_late() -> None:
    fleet = FakeFleet("h1")
    fleet.client("one")
    first, late = holding(fleet, "robot/a"), holding(fleet, "robot/b", deaf=True)
    candidate = fleet.candidate("h1")
    await until(lambda: candidate.rcm)
    late.deaf = False
    await fleet.joined(first, late)
    await until(lambda: not first.holders and not late.holders)


async def test_a_grant_that_was_answered_and_never_published_is_lost_before_any_vote() -> None:
    fleet = FakeFleet()
    fleet.rcm(5)
    radio = fleet.rc("radio/rf0", accept=None)
    await fleet.joined(radio)
    client = fleet.client("one")
    believed: dict[str, Any] = {"grant": HELD.grant, "rcs": ["radio/rf0"], "place": HELD.place}
    notice = await client.ask("tally", "radio/rf0:5", **believed)
    assert (notice.state, notice.outcome, notice.place) == ("queued", "lost", HELD.place)
    await until(lambda: radio.unanswered)
    radio.vote(True)
    await until(lambda: client.notices)
    granted = client.notices[-1].grant
    assert granted is not None
    assert granted > HELD.grant
    assert (await client.ask("tally", "radio/rf0:5", grant=HELD.grant, rcs=["radio/rf0"])).grant == granted


@pytest.mark.parametrize("seconds", [1.01, 1.5])
async def test_a_leader_that_is_cut_off_for_longer_than_the_lease_drops_nobody(seconds: float) -> None:
    """It loses its links to all hosts, one after the other, and takes that for no death."""
    fleet = FakeFleet()
    rcm, rc, client = fleet.rcm(), fleet.rc("robot/a"), fleet.client("one")
    await fleet.joined(rc)
    running = await client.ask("tally", "robot/a", seconds=60)
    assert running.state == "running"
    for other, late in ((client.mesh, 0.0), (rc.mesh, 0.1), (fleet.watcher, 0.15)):
        await asyncio.sleep(late)
        fleet.cut(rcm.mesh, other)
    await asyncio.sleep(seconds - 0.1)
    fleet.network.heal()
    await asyncio.sleep(3)
    (hold,) = (await fleet.state()).holds
    assert hold.grant == running.grant
    assert not fleet.revoked


async def test_the_link_to_one_rc_of_a_host_may_be_the_first_that_a_leader_which_is_cut_off_loses() -> None:
    """Others of that host are seen still, and do not answer."""
    fleet = FakeFleet()
    rcm, rc, other, client = fleet.rcm(), fleet.rc("robot/a"), fleet.rc("robot/b"), fleet.client("one")
    await fleet.joined(rc, other)
    running = await client.ask("tally", "robot/a", seconds=60)
    for of, late in ((rc.mesh, 0.0), (other.mesh, 0.15), (client.mesh, 0.0), (fleet.watcher, 0.0)):
        await asyncio.sleep(late)
        fleet.cut(rcm.mesh, of)
    await asyncio.sleep(0.95)
    fleet.network.heal()
    # What comes now answers what was asked as this leader was cut off.
    fleet.cut(rcm.mesh, rc.mesh)
    await asyncio.sleep(0.3)
    fleet.network.heal()
    await asyncio.sleep(3)
    (hold,) = (await fleet.state()).holds
    assert hold.grant == running.grant


async def test_a_client_whose_whole_host_dies_is_dropped_as_soon_as_another_host_answers() -> None:
    fleet, _ = await fleet_of("robot/a")
    client = fleet.client("one")
    await client.ask("tally", "robot/a", seconds=60)
    fleet.network.kill(client.mesh)
    died = fleet.watcher.now()
    await until(lambda: fleet.revoked)
    assert fleet.watcher.now() - died < SECOND // 20


class FakeEndingRc(FakeRc):
    """Its hold ends just before it is asked for a promise."""

    def _on_asked(self, query: IncomingQuery[RcAsk]) -> None:
        if query.message.promise is not None:
            self.holders = []
        super()._on_asked(query)


async def test_an_answer_from_before_the_promise_is_none() -> None:
    fleet = FakeFleet("h1")
    held = replace(HELD, rcs=["robot/a"])
    rc = FakeEndingRc(fleet.mesh("devices"), "robot/a", term=HELD.grant.term, holders=[held])
    rc.start()
    fleet.network.disturb({"rc/state": Disturbance(old=1.0)})
    fleet.candidate("h1")
    await until(lambda: rc.term > HELD.grant.term, within=5)
    await asyncio.sleep(2)
    assert len(rc.asked) > 1
    assert not [holder for grants in fleet.published for holder in grants.rcs.get("robot/a", [])]


async def test_what_an_rc_holds_for_a_client_that_has_handed_it_over_waits_for_no_second_one() -> None:
    """The new client asks for it at its place. It runs once: under its old client until that is dropped, then here."""
    fleet = FakeFleet()
    rcm = fleet.rcm(5)
    two = fleet.client("two")
    assert (await two.ask("tally", "radio/r", place=HELD.place)).state == "queued"
    rc = fleet.rc("radio/r", term=HELD.grant.term, holders=[replace(HELD, rcs=["radio/r"])])
    await until(lambda: [holder.client for holder in rc.holders] == ["desk/two"])
    held = [[holder.client for holder in grants.rcs.get("radio/r", [])] for grants in fleet.published]
    assert max(map(len, held)) == 1
    assert rcm.core.waiting == 0


def elsewhere(fleet: FakeFleet, host: str, instance: str) -> FakeRc:
    rc = FakeRc(fleet.mesh(host), RC, instance=instance)
    rc.start()
    return rc


async def seconds_until_used(fleet: FakeFleet, rc: FakeRc) -> float:
    """From now until this instance has joined."""
    began = fleet.watcher.now()
    await until(lambda: any(one.instance == rc.instance for one in rc.asked))
    return (fleet.watcher.now() - began) / SECOND


@pytest.mark.parametrize("settle", [None, 2.0])
async def test_an_instance_elsewhere_is_taken_in_once_the_one_before_let_go_and_settled(settle: float | None) -> None:
    fleet = FakeFleet()
    fleet.rcm()
    first = elsewhere(fleet, "d1", "i1")
    await fleet.joined(first)
    first.publish(settle=settle)
    second = elsewhere(fleet, "d2", "i2")
    await asyncio.sleep(1)
    fleet.network.kill(first.mesh)
    lease = fleet.fleet.timing.hold_lease / SECOND
    assert await seconds_until_used(fleet, second) == pytest.approx(lease + (settle or 0), abs=0.1)


@pytest.mark.parametrize(("home", "waits"), [("d2", 0.0), ("d1", 5.0 + default_fleet().timing.hold_lease / SECOND)])
async def test_a_reign_that_never_saw_the_instance_at_home_lets_others_wait(home: str, waits: float) -> None:
    fleet = FakeFleet()
    fleet.fleet = replace(fleet.fleet, devices={home: (RC,)})
    elsewhere(fleet, "d2", "i2")
    fleet.candidate("boss")
    began = fleet.watcher.now()
    await sees(fleet.watcher, RC, present=True)
    assert (fleet.watcher.now() - began) / SECOND == pytest.approx(waits, abs=1)
