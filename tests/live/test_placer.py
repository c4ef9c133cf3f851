"""The placer on a real mesh: what is asked for runs somewhere, whatever dies."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import psutil
import pytest

from tests.behaviors.components.kit import ComponentLab, lives
from tests.hang import HANG
from tests.live.lab import Lab
from tests.live.placing import Placing, WitnessRc, register
from zscout.mesh import clock
from zscout.messages import (
    ComponentSpec,
    EndComponent,
    ListPlacements,
    PlaceComponent,
    Placement,
    Placements,
    Problem,
    UncordonHost,
)
from zscout.types import SECOND

pytestmark = [pytest.mark.live, pytest.mark.slow]

RC = "robot/scout33"


async def three(lab: Lab) -> Placing:
    """Three nodes that report, of which h0 and h1 may lead."""
    for host in ("h0", "h1", "h2"):
        lab.node(host)
    client = await lab.begun()
    placing = Placing(client)
    await placing.hosts(3)
    return placing


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


async def test_what_ran_on_a_host_that_dies_runs_elsewhere(tmp_path: Path) -> None:
    # The leader is not the one that dies.
    async with ComponentLab(tmp_path, candidates=["h0"]) as lab, WitnessRc(lab, RC) as rc:
        register(lab)
        for host in ("h0", "h1", "h2"):
            lab.node(host)
        client = await lab.client()
        await lab.ready(client, RC)
        placing = Placing(client)
        await placing.hosts(3)
        held = await placing.place("held", "tally", {"rc": RC, "period": 0.02}, hosts=["h1", "h2"])
        victim = held.host
        assert victim is not None
        await rc.witness.more()
        await placing.place("bare", "counter", hosts=[victim, "h0"])
        await placing.place("mortal", "counter", hosts=[victim], restart="never")
        at = await host_dies(lab, victim)
        moved = await placing.until("held", lambda one: one.state == "running" and one.host != victim)
        took = (clock.now() - at) / SECOND
        print(f"\nhost killed -> its component runs elsewhere: {took:.2f} s")
        assert moved.incarnation > held.incarnation
        # Its ARC was asked for anew, and counts from the beginning.
        await rc.witness.more(3)
        again = rc.witness.counts.index(1, 1)
        assert rc.witness.counts[again:] == list(range(1, len(rc.witness.counts) - again + 1))
        assert (await placing.until("mortal", lambda one: one.state == "ended")).reason


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
