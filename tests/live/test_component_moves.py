"""Components on the move between real nodes: with their state, their ARCs and their holds, or not at all."""

from __future__ import annotations

import signal
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.behaviors.components.kit import ComponentLab, Hosts, counts, counts_on, gone
from tests.live.bench import until
from tests.live.placing import register
from zscout.messages import (
    MAX_CHECKPOINT,
    Checkpoint,
    CheckpointComponent,
    ComponentList,
    Grants,
    ListComponents,
    MoveComponent,
    Moved,
    Output,
    Problem,
    ReadOutput,
)

pytestmark = pytest.mark.live

QUICK: dict[str, Any] = {"period": 0.02}


async def went_on(hosts: Hosts, source: str, target: str) -> None:
    """Waits until all that was counted at the source has come out of there, and the target's next after that."""
    await hosts.ended(source, "c")
    old, new = await counts(hosts, source), await counts(hosts, target)
    assert new[0] == old[-1] + 1
    assert old == list(range(old[0], old[-1] + 1))


async def move(hosts: Hosts, source: str, target: str, incarnation: int, kind: str, params: dict[str, Any]) -> Moved:
    """Moves "c" as a placer does."""
    view = await hosts.start(target, "c", kind, params, incarnation=incarnation + 1, standby=True)
    assert view.phase == "standby", view
    order = MoveComponent("c", incarnation, target, incarnation + 1)
    moved = await hosts.get(source, order, Moved)
    assert (moved.component, moved.host, moved.incarnation) == ("c", target, incarnation + 1)
    # Asked again it tells the same.
    assert await hosts.get(source, order, Moved) == moved
    return moved


@pytest.mark.slow
async def test_a_component_without_arcs_moves_there_and_back_and_counts_on(lab: ComponentLab) -> None:
    lab.node("a")
    lab.node("b")
    client = await lab.client()
    hosts = Hosts(client)
    first = await hosts.start("a", "c", "counter", QUICK)
    await lab.ready(client)
    await counts_on(hosts, "a")
    there = await move(hosts, "a", "b", 1, "counter", QUICK)
    await counts_on(hosts, "b")
    await went_on(hosts, "a", "b")
    left = await hosts.ended("a", "c")
    assert (left.ended, left.incarnation) == ("moved", 1)
    assert first.pid is not None
    await gone(first.pid)
    back = await move(hosts, "b", "a", 2, "counter", QUICK)
    await counts_on(hosts, "a")
    await went_on(hosts, "b", "a")
    whole = {"size": MAX_CHECKPOINT}
    await hosts.start("a", "d", "restless", whole)
    await hosts.start("b", "d", "restless", whole, incarnation=2, standby=True)
    large = await hosts.get("a", MoveComponent("d", 1, "b", 2), Moved)
    print(f"with the largest state: {large.dead * 1000:.1f} ms")
    state = (await hosts.get("b", CheckpointComponent("d"), Checkpoint)).state
    assert len(state) == MAX_CHECKPOINT
    print(f"dead for {there.dead * 1000:.1f} and {back.dead * 1000:.1f} ms")


@pytest.mark.essential
async def test_a_component_takes_its_hold_along_and_a_rival_gets_nothing(lab: ComponentLab) -> None:
    register(lab)
    lab.node("a")
    lab.node("b")
    lab.node("r", "robot/x", "robot/y")
    client = await lab.client()
    hosts = Hosts(client)
    await lab.ready(client, "robot/x", "robot/y")
    params = QUICK | {"rc": "robot/x"}
    await hosts.start("a", "c", "tally", params)
    await counts_on(hosts, "a")
    rival = await client.request("rival", {"robot/x": {}}, min_runtime=1)
    said: list[Grants] = []
    client.mesh.subscribe(client.mesh.keys.grants, Grants, lambda _, grants: said.append(grants))
    dead = []
    for incarnation, (source, target) in enumerate(pairwise("aba"), 1):
        dead.append((await move(hosts, source, target, incarnation, "tally", params)).dead)
        await counts_on(hosts, target)
        await went_on(hosts, source, target)
        assert "lost" not in (await hosts.get(target, ReadOutput("c"), Output)).text
        (holder,) = (await lab.rc(client, "robot/x")).holders
        assert (holder.arc, holder.client) == ("c", f"{target}/c.{incarnation + 1}")
    # Each hand-over was one publication, and there was no other word about who holds it.
    # All that is published comes to this client later than to the RC, and perhaps the first grant too.
    await until(lambda: sum(len(grants.revoked) for grants in said) >= len(dead))
    told = [[(one.arc, one.client) for one in grants.rcs["robot/x"]] for grants in said if grants.rcs]
    told = told[1:] if told[0] == [("c", "a/c.1")] else told
    assert told == [[("c", f"{host}/c.{number}")] for number, host in enumerate("ba", 2)]
    ends = [(one.outcome, one.client) for grants in said for one in grants.revoked]
    assert ends == [("handed_over", f"{host}/c.{number}") for number, host in enumerate("ab", 1)]
    assert rival.state == "queued"
    print("dead for", *(f"{1000 * seconds:.1f}" for seconds in dead), "ms")
    await hosts.stop("a", "c")
    await lab.held_by(client, "robot/x", "rival")


@pytest.mark.slow
async def test_what_waits_for_its_arc_moves_with_its_place(lab: ComponentLab) -> None:
    register(lab)
    lab.node("a")
    lab.node("b", "robot/x")
    client = await lab.client()
    hosts = Hosts(client)
    await lab.ready(client, "robot/x")
    first = await client.request("first", {"robot/x": {}}, min_runtime=600)
    assert await client.granted(first) is not None
    params = {"rc": "robot/x"}
    await hosts.start("a", "c", "tally", QUICK | params)
    await lab.state(client, lambda state: [view.arc for view in state.queue] == ["c"])
    # It waits in `async with`, where it comes to no safe point.
    await hosts.start("b", "c", "tally", QUICK | params, incarnation=2, standby=True)
    assert await hosts.refused("a", MoveComponent("c", 1, "b", 2, patience=0.2)) == "not_safe"
    await client.end(first)
    await counts_on(hosts, "a")
    assert (await hosts.get("a", ListComponents("c"), ComponentList)).components[0].incarnation == 1
    moved = await hosts.get("a", MoveComponent("c", 1, "b", 2), Moved)
    assert moved.host == "b"
    await counts_on(hosts, "b")


@pytest.mark.slow
async def test_a_move_that_fails_before_the_commit_changes_nothing(tmp_path: Path) -> None:
    async with ComponentLab(tmp_path, candidates=["a"]) as lab:
        register(lab)
        lab.node("a", "robot/x")
        lab.node("b")
        client = await lab.client()
        hosts = Hosts(client)
        await lab.ready(client, "robot/x")
        await hosts.start("a", "c", "tally", QUICK | {"rc": "robot/x"})
        await counts_on(hosts, "a")
        (holder,) = (await lab.rc(client, "robot/x")).holders

        async def fails(host: str, incarnation: int) -> str:
            problem = await hosts.ask("a", MoveComponent("c", 1, host, incarnation), Moved)
            assert isinstance(problem, Problem)
            assert problem.code == "move_failed"
            await counts_on(hosts, "a")
            return problem.message

        assert "no component 'c'" in await fails("b", 2)
        await hosts.start("b", "c", "still", incarnation=2, standby=True)
        assert "no checkpoint() and restore()" in await fails("b", 2)
        await hosts.stop("b", "c")
        assert "it is ended here" in await fails("b", 2)
        await hosts.start("b", "c", "restless", {"broken": True}, incarnation=3, standby=True)
        assert "this state is rotten" in await fails("b", 3)
        assert (await hosts.ended("b", "c")).ended == "failed"
        await hosts.start("b", "c", "tally", QUICK | {"rc": "robot/x"}, incarnation=4, standby=True)
        lab.signal("b", signal.SIGKILL)
        assert "b did not answer" in await fails("b", 4)

        lost = [line for line in (await hosts.get("a", ReadOutput("c"), Output)).text.splitlines() if "lost" in line]
        assert lost == []
        numbers = await counts(hosts, "a")
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        assert (await lab.rc(client, "robot/x")).holders[0].grant == holder.grant
