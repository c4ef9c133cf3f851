"""The placer and the load balancer on a real mesh: what is asked for runs somewhere, whatever dies."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import psutil
import pytest

from tests.behaviors.components.kit import ComponentLab, lives
from tests.hang import HANG
from tests.live.lab import Lab, answered, awaited
from tests.live.placing import Placing, WitnessRc, register, three
from zscout.behaviors.client.client import Client
from zscout.behaviors.sensor_net.place_sensor_net import component_of
from zscout.keyexpr import Role
from zscout.messages import (
    MAX_COMPONENT_NAME,
    ComponentSpec,
    EndComponent,
    HostRanking,
    ListPlacements,
    PlaceComponent,
    Placement,
    Placements,
    Problem,
    RankAsk,
    UncordonHost,
)

pytestmark = pytest.mark.live

RC = "robot/scout33"


def family(lab: Lab, host: str) -> list[psutil.Process]:
    return psutil.Process(lab.nodes[host].pid).children(recursive=True)


async def host_dies(lab: Lab, host: str) -> int:
    """A host loses power: all that runs there is gone at one moment. Returns when."""
    processes = family(lab, host)
    at = lab.signal(host, signal.SIGKILL)
    for process in processes:
        process.kill()
    await asyncio.to_thread(psutil.wait_procs, processes, HANG)
    return at


@pytest.mark.slow
async def test_placing_is_idempotent_and_stopping_is_for_good(lab: ComponentLab) -> None:
    placing = await three(lab)
    first = await placing.place("one", "counter")
    assert (first.state, first.wanted) == ("running", True)
    again = await placing.place("one", "counter")
    assert (again.incarnation, again.host) == (first.incarnation, first.host)
    other = await placing.ask(PlaceComponent("one", ComponentSpec("spin")), Placement)
    assert isinstance(other, Problem)
    assert other.code == "exists"
    ended = await placing.get(EndComponent("one"), Placement)
    assert (ended.state, ended.wanted) == ("ended", False)
    assert first.host is not None
    (view,) = await placing.views("one", first.host)
    assert (view.phase, view.ended) == ("ended", "stopped")
    anew = await placing.place("one", "counter")
    assert anew.incarnation > first.incarnation
    unknown = await placing.ask(EndComponent("nothing"), Placement)
    assert isinstance(unknown, Problem)
    assert unknown.code == "unknown_component"


@pytest.mark.slow
async def test_what_does_not_start_there_starts_elsewhere_or_is_given_up(tmp_path: Path) -> None:
    async with ComponentLab(tmp_path, rules="restarts = 2\nback_off = 0.05\n") as lab:
        lab.node("h0", extra="[components]\nallow = false")
        lab.node("h1", extra='[components]\nkinds = ["counter"]')
        lab.node("h2", extra='labels = ["gpu"]')
        client = await lab.begun()
        placing = Placing(client)
        await placing.hosts(3)
        # The first two will not, whichever is the best.
        spun = await placing.place("spun", "spin")
        assert (spun.state, spun.host) == ("running", "h2")

        await placing.place("nowhere", "no-such-kind")  # hosts are asked whether they have it by now
        nowhere = await placing.until("nowhere", lambda placement: placement.state == "given_up")
        assert "no-such-kind" in nowhere.reason
        labelled = await placing.place("labelled", "counter", labels=["gpu", "lidar"])
        assert labelled.state == "waiting"
        assert "lidar" in labelled.reason

        await placing.place("broken", "brief", {"how": "raise"})
        broken = await placing.until("broken", lambda one: one.state == "given_up")
        assert "the camera fell off" in broken.tail
        once = await placing.place("once", "brief", {"how": "children"}, restart="never")
        assert once.state in ("running", "ended")
        assert (await placing.until("once", lambda one: one.state == "ended")).restarts == 0
        await placing.place("badly", "counter", {"period": -1})
        badly = await placing.until("badly", lambda one: one.state == "given_up")
        assert "period" in badly.reason


@pytest.mark.slow
async def test_what_ran_on_a_host_that_dies_runs_elsewhere(tmp_path: Path) -> None:
    # The leader is not the one that dies.
    async with ComponentLab(tmp_path, candidates=["h0"]) as lab, WitnessRc(lab, RC) as rc:
        register(lab)
        placing = await three(lab, RC)
        held = await placing.place("held", "tally", {"rc": RC, "period": 0.02}, hosts=["h1", "h2"])
        victim = held.host
        assert victim is not None
        await rc.witness.more()
        await placing.place("bare", "counter", hosts=[victim, "h0"])
        await placing.place("mortal", "counter", hosts=[victim], restart="never")
        await host_dies(lab, victim)
        moved = await placing.until("held", lambda one: one.state == "running" and one.host != victim)
        assert moved.incarnation > held.incarnation
        # Its ARC was asked for anew, and counts from the beginning.
        await rc.witness.more(3)
        again = rc.witness.counts.index(1, 1)
        assert rc.witness.counts[again:] == list(range(1, len(rc.witness.counts) - again + 1))
        assert (await placing.until("mortal", lambda one: one.state == "ended")).reason


@pytest.mark.slow
async def test_the_leader_dies_with_a_component_and_the_next_placer_knows(lab: ComponentLab) -> None:
    placing = await three(lab)
    leader = (await lab.state(placing.client, lambda state: bool(state.host))).host
    others = sorted({"h0", "h1", "h2"} - {leader})
    lost = await placing.place("lost", "counter", hosts=[leader, others[0]])
    kept = await placing.place("kept", "counter", hosts=[others[1]])
    doomed = [leader] if lost.host == leader else []
    # Who leads next sees the other, and what runs there.
    await lab.candidates(placing.client, *others)
    await host_dies(lab, leader)
    moved = await placing.until("lost", lambda one: one.state == "running" and one.host == others[0])
    assert (moved.incarnation > lost.incarnation) is bool(doomed)
    still = await placing.until("kept", lambda one: one.state == "running")
    assert (still.host, still.incarnation) == (kept.host, kept.incarnation)
    listed = await placing.get(ListPlacements(), Placements)
    assert {one.component for one in listed.components} == {"lost", "kept"}
    ended = await placing.get(EndComponent("kept"), Placement)
    assert ended.state == "ended"


@pytest.mark.slow
async def test_a_component_that_is_killed_starts_again(tmp_path: Path) -> None:
    async with ComponentLab(tmp_path, rules="back_off = 0.05\n") as lab:
        placing = await three(lab)
        first = await placing.place("one", "counter")
        assert first.host is not None
        (view,) = await placing.views("one", first.host)
        assert view.pid is not None
        assert lives(view.pid)
        psutil.Process(view.pid).kill()
        again = await placing.until("one", lambda one: one.state == "running" and one.incarnation > first.incarnation)
        assert again.restarts == 1
        assert (await placing.get(UncordonHost("h1"), Placements)).cordoned == []


HOSTS = {"h1", "h2", "h3"}


async def ranked(client: Client, asked: RankAsk, hosts: set[str]) -> HostRanking:
    """The answer, once it names exactly these hosts."""
    mesh = client.mesh
    return await awaited(
        lambda: answered(lambda: mesh.ask_one(mesh.keys.ask_rank(mesh.me), asked, HostRanking, timeout=HANG)),
        lambda ranking: {one.host for one in ranking.hosts} == hosts,
    )


@pytest.mark.slow
async def test_the_balancer_ranks_whom_it_hears(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=["h1", "h2"]) as lab:
        for host in sorted(HOSTS):
            lab.node(host, f"robot/{host}")
        client = await lab.client()
        await lab.ready(client, *(f"robot/{host}" for host in HOSTS))

        best = await ranked(client, RankAsk(), HOSTS)
        assert best.metric == "composite"
        assert all(one.reason.startswith("would run at ") for one in best.hosts)
        assert [one.score for one in best.hosts] == sorted((one.score for one in best.hosts), reverse=True)
        assert not best.left_out

        some = await ranked(client, RankAsk(hosts=["h2", "h9"], metric="available_memory"), {"h2"})
        assert some.left_out == {"h9": "no report of it"}
        none = await ranked(client, RankAsk(labels=["gpu"]), set())
        assert set(none.left_out.values()) == {"it has no label gpu"}
        reply = await client.mesh.ask_one(
            client.mesh.keys.ask_rank(client.mesh.me), RankAsk(at_most=1), HostRanking, timeout=HANG
        )
        assert reply is not None
        assert reply.message is not None
        assert (len(reply.message.hosts), reply.message.more) == (1, 2)

        # A host that dies is named no more; a new leader's balancer knows the others from their reports.
        await lab.candidates(client, "h2")
        lab.signal("h1", signal.SIGKILL)
        await lab.living(client, Role.RCM, lambda hosts: hosts == ["h2"])
        await ranked(client, RankAsk(), {"h2", "h3"})


QUIET = 4.0
"""Seconds: more than the fleet of this test needs for a move."""
NAMES = [f"part-{number}" for number in range(4)]


@pytest.mark.slow
async def test_what_is_on_one_host_spreads_and_then_stays(tmp_path: Path) -> None:
    rules = f"[placement]\nstart_timeout = {HANG}\nrebalance = true\ngain = 0.1\nsteady = 1\nrest = 2\n"
    async with Lab(tmp_path, candidates=["h1"], extra=rules) as lab:
        lab.node("h1", extra='load = "tree"')
        client = await lab.begun()
        placing = Placing(client)
        await placing.hosts(1)
        # More than this machine carries, if it has two processors.
        for name in NAMES:
            await placing.place(name, "spin", {"cpu": 0.7})
        lab.node("h2", extra='load = "tree"')
        await placing.hosts(2)
        hosts: set[str | None] = set()
        async with asyncio.timeout(3 * HANG):
            while hosts != {"h1", "h2"}:
                hosts = {one.host for one in await running(placing)}
                await asyncio.sleep(0.1)
        await asyncio.sleep(QUIET)
        after = await running(placing)
        assert {one.host for one in after} == {"h1", "h2"}
        assert {one.host for one in after if one.moves} == {"h2"}
        # Whatever went, has not come back.
        assert all(one.moves <= 1 for one in after)
        assert any("runs" in one.reason and one.moves for one in after)


async def running(placing: Placing) -> list[Placement]:
    listed = await placing.get(ListPlacements(), Placements)
    return [one for one in listed.components if one.state == "running"]


@pytest.mark.slow
async def test_a_component_that_others_placed_under_its_name_is_left_alone(lab: ComponentLab) -> None:
    lab.node("a", "robot/r1", "robot/r2")
    client = await lab.begun()
    placing = Placing(client)
    await placing.hosts(1)
    # Somebody's component stands in the way of the net's first robot.
    await placing.place("net-r1", "counter", {"period": 0.05})
    await placing.place("net", "place_sensor_net", {"robots": ["robot/r1", "robot/r2"], "wanted": 1})
    # So the net takes its second robot; the other component counts on.
    second = await placing.until("net-r2", lambda one: one.state == "running")
    assert second.spec.params["robot"] == "robot/r2"
    assert (await placing.placement("net-r1")).state == "running"
    # Whatever is stopped of the net, and the net itself, leave the stranger at work.
    await placing.get(EndComponent("net-r2", wait=10.0), Placement)
    await placing.get(EndComponent("net", wait=10.0), Placement)
    assert (await placing.placement("net-r1")).state == "running"


def test_components_of_long_names_are_told_apart() -> None:
    net = "n" * MAX_COMPONENT_NAME
    names = {component_of(net, f"robot/scout{number}") for number in range(100)}
    assert len(names) == 100
    assert all(len(name) <= MAX_COMPONENT_NAME for name in names)
    assert component_of("net", "robot/scout33") == "net-scout33"
