"""Who leads: taking over, being deposed, and what becomes of a candidate in which something fails."""

from __future__ import annotations

import asyncio
import itertools
from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from typing import Any

import pytest
from msgspec import structs

from tests.mesh.kit import run, until
from tests.services.rcm.kit import FakeFleet, Refusal
from zscout.config.scheduling_policy import FairShares
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Role
from zscout.mesh.supervision import StallWatch
from zscout.messages import LAST_TERMS, Cancel, Grants, Notice, OpenRequest, RcAsk, RcState, Release
from zscout.services.rcm import candidate as candidate_module
from zscout.services.rcm.candidate import Candidate
from zscout.services.rcm.election import BACKOFF_S, JOIN_TIME, MAX_BACKOFF_S
from zscout.types import NO_TERM, SECOND, Term


def open_request(notice: Notice) -> OpenRequest:
    needs: dict[str, dict[str, Decimal]] = {rc: {} for rc in notice.rcs}
    return OpenRequest(notice.id, notice.arc, needs, 0, Decimal(60), place=notice.place, grant=notice.grant)


async def living(fleet: FakeFleet, role: str) -> list[tuple[str, str]]:
    """Host and instance of each token of a role."""
    tokens = await fleet.watcher.living(fleet.watcher.keys.alive_any(role), timeout=1)
    return [(token.host, token.instance) for token in tokens]


async def test_a_takeover_carries_on_what_stands_and_nobody_is_disturbed() -> None:
    fleet = FakeFleet("x", "y")
    leader, heir = fleet.candidate("x"), fleet.candidate("y")
    robots = [fleet.rc(f"robot/{name}") for name in "ab"]
    await until(lambda: leader.rcm)
    await fleet.joined(*robots)
    client, late = fleet.client("one"), fleet.client("late")
    held, waits = await client.ask("held", "robot/a"), await client.ask("waits", "robot/a")
    half = await late.ask("half", "robot/b")
    client.open = [open_request(held), open_request(waits)]
    late.open = [open_request(half)]
    fleet.network.kill(leader.mesh)
    await until(lambda: heir.rcm)
    assert heir.rcm is not None
    assert heir.rcm.term.counter == 2
    state = await fleet.state()
    assert {view.arc: view.grant for view in state.holds} == {"held": held.grant, "half": half.grant}
    assert [(view.arc, view.place) for view in state.queue] == [("waits", waits.place)]
    # It carries the queue on.
    await client.do(Release("held"))
    await until(lambda: robots[0].arcs == ["waits"])
    assert late.notices == []


async def test_a_takeover_goes_on_with_what_groups_had() -> None:
    fleet = FakeFleet("x", "y", strategy="adaptive")
    policy = replace(fleet.fleet.scheduling, fair_shares=FairShares(3_600 * SECOND))
    fleet.fleet = structs.replace(fleet.fleet, scheduling=policy)
    leader, heir = fleet.candidate("x"), fleet.candidate("y")
    robot = fleet.rc("robot/a")
    await until(lambda: leader.rcm)
    await fleet.joined(robot)
    client, other = fleet.client("one", "ws1"), fleet.client("two", "ws2")
    held, waits = await client.ask("held", "robot/a", seconds=600), await other.ask("waits", "robot/a", seconds=600)
    client.open, other.open = [open_request(held)], [open_request(waits)]
    await asyncio.sleep(100)
    had = (await fleet.state()).charged
    assert had == {"ws1": pytest.approx(99, abs=1.5)}
    fleet.network.kill(leader.mesh)
    await until(lambda: heir.rcm)
    taken = (await fleet.state()).charged
    assert had["ws1"] - 11 < taken["ws1"] < had["ws1"] + 2, "it was told at most 10 s before"
    await asyncio.sleep(50)
    assert (await fleet.state()).charged["ws1"] == pytest.approx(taken["ws1"] + 50, rel=0.05)


async def test_a_takeover_goes_on_with_the_patience_and_with_who_is_protected() -> None:
    fleet = FakeFleet("x", "y", strategy="adaptive")
    leader, heir = fleet.candidate("x"), fleet.candidate("y")
    robot = fleet.rc("robot/a")
    await until(lambda: leader.rcm)
    await fleet.joined(robot)
    client = fleet.client("one", "ws1")
    held = await client.ask("held", "robot/a", seconds=600)
    client.open = [open_request(held)]
    assert [holder.protected_from for holder in robot.holders] == [450]
    await asyncio.sleep(100)
    other = fleet.client("two", "ws2")
    await other.do(Cancel((await other.ask("waits", "robot/a")).id))  # an instant, by which it is worked out
    await asyncio.sleep(11)  # it is published every 10 s
    assert (await fleet.state()).patience == 28 * 600
    fleet.network.kill(leader.mesh)
    await until(lambda: heir.rcm)
    state = await fleet.state()
    assert state.patience == 28 * 600
    assert [hold.protected_from for hold in state.holds] == [pytest.approx(450, abs=1)]


async def test_while_most_rcs_see_a_leader_nobody_takes_over() -> None:
    fleet = FakeFleet()
    robots = [fleet.rc(f"robot/{name}", leader=True) for name in "abc"]
    candidate = fleet.candidate("x")
    await asyncio.sleep(5)
    assert candidate.rcm is None
    robots[0].leader = robots[1].leader = False
    await until(lambda: candidate.rcm)


@pytest.mark.parametrize("stalled", [False, True])
async def test_a_candidate_that_has_stalled_does_not_lead_alone_at_once(
    stalled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be it that the others have lost."""
    fleet = FakeFleet("x", "y")
    leader, heir = fleet.candidate("x"), fleet.candidate("y")
    await until(lambda: leader.rcm)
    await asyncio.sleep(5)
    monkeypatch.setattr(heir._candidacy.stall, "fresh", lambda: stalled)
    before = heir.mesh.now()
    fleet.network.kill(leader.mesh)
    await until(lambda: heir.rcm)
    assert (heir.mesh.now() - before >= heir.election.silence) == stalled


async def test_a_leader_steps_down_for_a_higher_term_and_asks_nothing_more() -> None:
    fleet = FakeFleet()
    candidate = fleet.candidate("x")
    await until(lambda: candidate.rcm)
    (leading,) = await living(fleet, Role.RCM)
    # An RC that comes has promised a higher term: it refuses this one, however often it is asked.
    robot = fleet.rc("robot/a", term=Term(7, "other"), leader=True)
    await until(lambda: candidate.rcm is None)
    assert candidate.known == Term(7, "other")
    await asyncio.sleep(5)
    assert [asked.promise for asked in robot.asked if asked.promise] == [Term(1, leading[1])]
    robot.leader = False
    await until(lambda: candidate.rcm)
    assert robot.term.counter == 8


def break_in(candidate: Candidate, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rcm = candidate.rcm
    assert rcm is not None
    objects: dict[str, tuple[object, str]] = {
        "loop": (candidate._changed, "clear"),
        "core": (rcm.core, "handle"),
        "handler": (rcm.leader.registry, "enter"),
        "heartbeat": (rcm, "_publish"),
    }
    monkeypatch.setattr(*objects[where], lambda *_: 1 / 0)
    if where == "loop":
        candidate._changed.set()


@pytest.mark.parametrize("broken", ["loop", "core", "handler", "heartbeat"])
def test_a_leader_in_which_something_fails_steps_down_and_stands_again(
    broken: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def story() -> None:
        fleet = FakeFleet("x", "y")
        first = fleet.candidate("x")
        second = fleet.candidate("y")
        await until(lambda: first.rcm)
        robot, client = fleet.rc("robot/a"), fleet.client("one")
        await fleet.joined(robot)
        held = await client.ask("held", "robot/a")
        client.open = [open_request(held)]
        before = dict(await living(fleet, Role.CANDIDATE))["x"]
        begin = asyncio.get_running_loop().time()
        break_in(first, broken, monkeypatch)
        refusal = await asyncio.gather(client.ask("next", "robot/a"), return_exceptions=True)
        await until(lambda: first.rcm is None)
        monkeypatch.undo()
        if broken in ("core", "handler"):
            # Its operation is answered at once: another RCM has to be asked.
            assert isinstance(refusal[0], Refusal)
            assert refusal[0].code == "not_leading"
        # Another takes over meanwhile, with all that stands.
        await until(lambda: second.rcm)
        assert [host for host, _ in await living(fleet, Role.CANDIDATE)] == ["y"]
        assert {view.grant for view in (await fleet.state()).holds} == {held.grant}
        # It stands again after a while, as a new candidate, and leads when it must.
        while len(tokens := await living(fleet, Role.CANDIDATE)) < 2:  # noqa: ASYNC110
            await asyncio.sleep(0.1)
        assert asyncio.get_running_loop().time() - begin < 10
        assert dict(tokens)["x"] != before
        fleet.network.kill(second.mesh)
        await until(lambda: first.rcm)
        assert (await fleet.state()).holds[0].grant == held.grant
        await first.stop()
        await second.stop()

    run(story())
    failures = [record for record in caplog.records if record.exc_info and "failed" in record.message]
    assert len(failures) == 1
    assert "never retrieved" not in caplog.text


async def test_a_candidate_that_always_fails_tries_less_and_less(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    stood: list[float] = []

    async def fails(_: Any) -> None:
        stood.append(asyncio.get_running_loop().time())
        raise ZeroDivisionError

    monkeypatch.setattr(Candidate, "_run", fails)
    fleet = FakeFleet()
    candidate = fleet.candidate("x")
    await asyncio.sleep(120)
    await candidate.stop()
    count = len(stood)
    await asyncio.sleep(120)
    assert len(stood) == count
    gaps = [round(later - earlier) for earlier, later in pairwise(stood)]
    assert gaps[:6] == [BACKOFF_S, 2, 4, 8, 16, MAX_BACKOFF_S]
    assert set(gaps[6:]) == {MAX_BACKOFF_S}


async def test_a_term_that_is_over_asks_nothing_more() -> None:
    fleet = FakeFleet()
    rcm = fleet.rcm()
    # A token that stands for nothing: its RC never answers, and is asked again and again.
    robot = fleet.rc("robot/a", term=Term(9, "newer"))
    await until(lambda: fleet.newer)
    rcm.stop()
    count = len(robot.asked)
    await asyncio.sleep(5)
    assert len(robot.asked) == count
    assert fleet.failures == []


async def a_robot(fleet: FakeFleet) -> ResourceController:
    """As it is, on a host of its own."""
    mesh, lease = fleet.mesh("h2"), fleet.fleet.timing.hold_lease / SECOND
    robot = ResourceController(mesh, "robot/a", ExclusiveDriver(), hold_lease=lease, stall=StallWatch(mesh.now).start())
    await robot.start()
    return robot


@pytest.mark.parametrize("has_token", [True, False])
async def test_the_fleet_goes_above_the_term_that_an_rc_obeys_however_high(has_token: bool) -> None:
    """But not at the word of who has no token."""
    fleet = FakeFleet("h1")
    robot = await a_robot(fleet)
    candidate = fleet.candidate("h1")
    await until(lambda: candidate.rcm and candidate.rcm.core.status().rcs)
    far = Term(10**9, "mad")
    mad = fleet.rc("robot/b", term=far)
    if not has_token:
        mad.token.close()
    if has_token:
        await until(lambda: candidate.rcm is None)
    await asyncio.sleep(5)
    assert candidate.rcm is not None
    joined = {one.name for one in candidate.rcm.core.status().rcs if one.present}
    wanted = (far.counter + 1, {"robot/a", "robot/b"}) if has_token else (1, {"robot/a"})
    assert (candidate.rcm.term.counter, joined) == wanted
    assert robot.holds.term == candidate.rcm.term


@pytest.mark.parametrize("who", ["a client", "an RC"])
async def test_a_leader_goes_above_what_somebody_whom_it_sees_obeys(who: str) -> None:
    """Else nobody who obeys it would be served while the leader lives."""
    fleet = FakeFleet("h1")
    robot = fleet.rc("robot/a")
    candidate = fleet.candidate("h1")
    await until(lambda: candidate.rcm and candidate.rcm.core.status().rcs)
    far = Term(10**9, "mad")
    if who == "an RC":
        robot.term = far
        robot.publish()
    else:
        with pytest.raises(Refusal, match="old_term"):
            await fleet.client("one").ask("tally", "robot/a", term=far)
    await until(lambda: candidate.rcm and candidate.rcm.term > far)


async def test_a_device_that_was_cut_off_follows_a_leader_far_above_its_term_at_once() -> None:
    """It heard the leader of another term within the hold lease, and refuses the first question."""
    fleet = FakeFleet("h1")
    robot, candidate = await a_robot(fleet), fleet.candidate("h1")
    await until(lambda: candidate.rcm and candidate.rcm.core.status().rcs)
    fleet.network.isolate(robot.mesh)
    cut_at = robot.mesh.now()
    far = Term(10**9, "mad")
    fleet.rc("robot/b", term=far)
    await until(lambda: candidate.rcm and candidate.rcm.term > far)
    fleet.network.heal()
    await until(
        lambda: candidate.rcm and "robot/a" in {rc.name for rc in candidate.rcm.core.status().rcs if rc.present}
    )
    assert robot.holds.term > far
    assert robot.mesh.now() - cut_at < fleet.fleet.timing.hold_lease


async def test_of_two_that_stand_at_once_one_leads_and_the_other_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would depose the first with a term above, and the RCs would be led by who may fail next."""
    fleet = FakeFleet("h1", "h2")
    fleet.rc("robot/a")
    late = fleet.rc("robot/b", deaf=True)
    names = itertools.chain(["1", "2", "x"], map(str, itertools.count(3)))
    monkeypatch.setattr(candidate_module, "new_instance", names.__next__)
    first = fleet.candidate("h2")
    await asyncio.sleep(JOIN_TIME / SECOND + 0.03)
    second = fleet.candidate("h1")
    await until(lambda: any(one.promise for one in late.asked))
    # The first waits for this promise; the second waits for nobody.
    late.deaf = False
    await until(lambda: first.rcm)
    await asyncio.sleep(5)
    assert (first.rcm is not None and first.rcm.term, second.rcm) == (Term(1, "x"), None)


async def test_a_candidate_that_alone_believes_a_forged_term_leads_once_rcs_believe_it_too() -> None:
    """While they hear the RCM of another term, it would lead nobody."""
    fleet = FakeFleet("h1", "h3")
    robot, first, misled = await a_robot(fleet), fleet.candidate("h1"), fleet.candidate("h3")
    await until(lambda: robot.holds.term != NO_TERM)
    misled.terms.highest = Term(10**9, "mad")
    await first.stop()
    await until(lambda: misled.rcm)
    assert misled.rcm is not None
    assert [one.name for one in misled.rcm.core.status().rcs if one.present] == ["robot/a"]
    assert robot.holds.term == misled.rcm.term


@pytest.mark.parametrize("has_token", [True, False])
async def test_a_candidate_that_rcs_misled_before_it_knew_better_tells_the_others_so(has_token: bool) -> None:
    """It believed their term as it heard of no other: to those that did it is absurd."""
    fleet = FakeFleet("h1", "h3")
    robot, first, misled = await a_robot(fleet), fleet.candidate("h1"), fleet.candidate("h3")
    await until(lambda: robot.holds.term != NO_TERM)
    misled.terms.highest = far = Term(10**9, "mad")
    fleet.network.kill(first.mesh)
    mad = fleet.rc("robot/b", term=far)
    if not has_token:
        mad.token.close()
    await until(lambda: misled.rcm)
    assert misled.rcm is not None
    joined = {one.name for one in misled.rcm.core.status().rcs if one.present}
    assert joined == ({"robot/a", "robot/b"} if has_token else {"robot/b"})


async def test_a_leader_without_rcs_steps_down_where_those_it_sees_do_not_believe_its_term() -> None:
    fleet = FakeFleet("h1", "h3")
    robot, first, misled = await a_robot(fleet), fleet.candidate("h1"), fleet.candidate("h3")
    await until(lambda: robot.holds.term != NO_TERM)
    fleet.network.isolate(misled.mesh)
    misled.terms.highest = Term(10**9, "mad")
    await until(lambda: misled.rcm)
    fleet.network.heal()
    await until(lambda: misled.rcm is None)
    await asyncio.sleep(5)
    assert (misled.rcm, first.rcm is not None, robot.holds.term.counter) == (None, True, 1)


async def test_the_last_terms_come_one_by_one_and_who_does_not_know_them_asks() -> None:
    """Nobody uses up at once those that are left; a fleet that has come so far goes on."""
    fleet = FakeFleet("h1")
    far = Term(LAST_TERMS + 500, "old")
    fleet.rc("robot/b", term=far)
    robot = await a_robot(fleet)
    candidate = fleet.candidate("h1")
    await until(lambda: candidate.rcm and len(candidate.rcm.core.status().rcs) == 2)
    assert candidate.rcm is not None
    assert candidate.rcm.term.counter == far.counter + 1
    assert robot.holds.term == candidate.rcm.term
    forged = Term(far.counter + 3, "forged")
    stranger = fleet.mesh("h3")
    asked = await stranger.ask(stranger.keys.rc_state("robot/a"), RcAsk(promise=forged), RcState, timeout=1)
    assert [reply.problem is not None and reply.problem.code for reply in asked] == ["old_term"]
    stranger.publisher(stranger.keys.grants, Grants).put(Grants(term=forged, seq=1, prev=0, every=0.5))
    await asyncio.sleep(5)
    assert robot.holds.term == candidate.rcm.term
