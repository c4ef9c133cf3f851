"""The placer as a service: its requests, its commands to nodes, what it publishes, and its failures."""

from __future__ import annotations

import asyncio

import pytest

from tests.mesh.kit import until
from tests.services.kit import Refusal
from tests.services.placement.kit import JOB, PlacerFleet, fail, placing
from zscout.messages import (
    ComponentSpec,
    DrainHost,
    EndComponent,
    ListComponents,
    ListPlacements,
    MigrateComponent,
    PlaceComponent,
    Placement,
    Placements,
    StartComponent,
    UncordonHost,
)
from zscout.placement.placer import Placer
from zscout.services.placement import component_placer


async def test_a_component_is_placed_moved_and_stopped_and_each_change_is_published() -> None:
    fleet = await placing("a", "b")
    placed = await fleet.ask(PlaceComponent("counter", JOB), Placement)
    assert (placed.state, placed.incarnation) == ("running", 1001)
    source = fleet.nodes[placed.host or ""]
    assert source.running == ["counter"]
    [start] = [one for one in source.commands if isinstance(one, StartComponent)]
    assert (start.spec, start.standby) == (JOB, False)
    moved = await fleet.ask(MigrateComponent("counter"), Placement)
    assert (moved.state, moved.moves, moved.dead) == ("running", 1, 0.25)
    assert moved.host != placed.host
    assert source.running == []
    ended = await fleet.ask(EndComponent("counter"), Placement)
    assert (ended.state, ended.wanted) == ("ended", False)
    assert fleet.states("counter") == ["starting", "running", "moving", "running", "stopping", "ended"]
    listed = await fleet.ask(ListPlacements(), Placements)
    assert [one.component for one in listed.components] == ["counter"]
    assert fleet.failures == []


async def test_what_ends_is_started_again_and_what_a_lost_host_had_is_started_elsewhere() -> None:
    fleet = await placing("a", "b")
    placed = await fleet.ask(PlaceComponent("counter", JOB), Placement)
    fleet.nodes[placed.host or ""].end("counter", placed.incarnation, "failed", "it broke")
    await until(lambda: fleet.published[-1].state == "running" and fleet.published[-1].restarts == 1)
    again = fleet.published[-1]
    fleet.network.kill(fleet.nodes[again.host or ""].mesh)
    await until(lambda: fleet.published[-1].state == "running" and fleet.published[-1].host != again.host)
    assert fleet.published[-1].incarnation > again.incarnation


async def test_requests_wait_until_all_nodes_have_listed_what_runs_there_and_a_bad_one_is_refused_at_once() -> None:
    fleet = PlacerFleet("a", "b")
    fleet.nodes["b"].silent = True
    fleet.nodes["a"].run("counter", 7)
    await fleet.lead()
    loop = asyncio.get_running_loop()
    asked_at = loop.time()
    early = asyncio.create_task(fleet.ask(PlaceComponent("counter", JOB), Placement))
    bad = ComponentSpec("job", hosts=["no host"])
    with pytest.raises(Refusal, match="bad_name"):
        await fleet.ask(PlaceComponent("other", bad), Placement)
    assert loop.time() < asked_at + component_placer.BEGIN / 2
    placed = await early
    # It ran already: it is not started twice.
    assert (placed.state, placed.host, placed.incarnation) == ("running", "a", 7)
    assert loop.time() >= asked_at + component_placer.BEGIN - 0.1
    lists = [one for one in fleet.nodes["b"].commands if isinstance(one, ListComponents)]
    assert len(lists) > 1


async def test_a_request_is_answered_with_how_it_stands_when_its_wait_is_over() -> None:
    fleet = PlacerFleet("a")
    fleet.nodes["a"].refuses["StopComponent"] = "busy"
    await fleet.lead()
    loop = asyncio.get_running_loop()
    await fleet.ask(PlaceComponent("counter", JOB), Placement)
    before = loop.time()
    stopping = await fleet.ask(EndComponent("counter", wait=3.0), Placement)
    assert stopping.state == "stopping"
    assert 3.0 <= loop.time() - before < 3.1
    fleet.nodes["a"].refuses.clear()
    assert (await fleet.ask(EndComponent("counter"), Placement)).state == "ended"


async def test_what_the_core_refuses_is_answered_with_its_code() -> None:
    fleet = await placing("a")
    await fleet.ask(PlaceComponent("counter", JOB), Placement)
    for operation, code in (
        (PlaceComponent("counter", ComponentSpec("other")), "exists"),
        (EndComponent("nothing"), "unknown_component"),
        (MigrateComponent("counter"), "move_failed"),
        (DrainHost("nowhere"), "unknown_host"),
    ):
        with pytest.raises(Refusal) as refusal:
            await fleet.ask(operation, Placement)
        assert refusal.value.code == code


async def test_a_drained_host_is_emptied_and_used_again_when_it_is_uncordoned() -> None:
    fleet = await placing("a", "b")
    placed = await fleet.ask(PlaceComponent("counter", JOB), Placement)
    host = placed.host or ""
    answer = await fleet.ask(DrainHost(host), Placements)
    assert (answer.cordoned, [one.component for one in answer.components]) == ([host], ["counter"])
    await until(lambda: fleet.nodes[host].running == [] and fleet.published[-1].state == "running")
    assert fleet.published[-1].host != host
    assert (await fleet.ask(UncordonHost(host), Placements)).cordoned == []


async def test_a_move_that_the_component_refuses_is_refused_and_it_stays() -> None:
    fleet = await placing("a", "b")
    placed = await fleet.ask(PlaceComponent("counter", JOB), Placement)
    fleet.nodes[placed.host or ""].refuses["MoveComponent"] = "not_safe"
    with pytest.raises(Refusal, match=r"move_failed: it did not move to .*: not_safe here"):
        await fleet.ask(MigrateComponent("counter"), Placement)
    assert fleet.nodes[placed.host or ""].running == ["counter"]


async def test_too_many_requests_are_refused_as_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(component_placer, "MAX_WAITING", 2)
    fleet = PlacerFleet("a")
    fleet.nodes["a"].silent = True
    placer = await fleet.lead()
    waiting = [asyncio.create_task(fleet.ask(PlaceComponent(name, JOB, wait=10.0), Placement)) for name in "xy"]
    await asyncio.sleep(0.1)
    with pytest.raises(Refusal, match="busy"):
        await fleet.ask(PlaceComponent("z", JOB), Placement)
    # A placer that stops refuses what waits: another one has to be asked.
    placer.stop()
    for task in waiting:
        with pytest.raises(Refusal, match="not_leading"):
            await task


async def test_a_core_that_raises_fails_the_placer_once_and_it_does_nothing_more(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fleet = await placing("a")
    await fleet.ask(PlaceComponent("counter", JOB), Placement)
    monkeypatch.setattr(Placer, "handle", fail)
    with pytest.raises(Refusal, match="internal"):
        await fleet.ask(PlaceComponent("other", JOB), Placement)
    fleet.nodes["a"].end("counter", 1001)
    await asyncio.sleep(30)
    assert [str(error) for error in fleet.failures] == ["a fault of the core"]
    assert "the component placer failed" in caplog.text


async def test_an_answer_that_makes_the_core_raise_fails_the_placer(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = await placing("a")
    await fleet.ask(ListPlacements(), Placements)
    monkeypatch.setattr("zscout.placement.lifecycle.Lifecycle.start_answered", fail)
    await fleet.ask(PlaceComponent("counter", JOB), Placement)
    await until(lambda: fleet.failures)
    assert [str(error) for error in fleet.failures] == ["a fault of the core"]


async def test_what_no_host_can_start_is_given_up_with_the_hosts_reasons() -> None:
    fleet = PlacerFleet("a", "b")
    for node in fleet.nodes.values():
        node.refuses["StartComponent"] = "unknown_kind"
    await fleet.lead()
    given_up = await fleet.ask(PlaceComponent("counter", JOB), Placement)
    assert given_up.state == "given_up"
    assert "a refused it: unknown_kind here" in given_up.reason
    assert "b refused it: unknown_kind here" in given_up.reason


async def test_a_start_without_an_answer_is_repeated_under_the_same_incarnation() -> None:
    fleet = await placing("a")
    await fleet.ask(ListPlacements(), Placements)
    node = fleet.nodes["a"]
    node.silent = True
    asked = await fleet.ask(PlaceComponent("counter", JOB, wait=40.0), Placement)
    assert asked.state == "starting"
    assert "a does not say whether it started: a did not answer" in asked.reason
    node.silent = False
    await until(lambda: fleet.published[-1].state == "running", within=60)
    starts = [one for one in node.commands if isinstance(one, StartComponent)]
    assert len(starts) > 1
    assert {one.incarnation for one in starts} == {1001}
    assert fleet.failures == []
