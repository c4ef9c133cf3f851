"""All that one client asked for and holds goes on in another: what the move of a component rests on."""

from __future__ import annotations

import asyncio

import pytest
from msgspec.structs import replace

from tests.behaviors.client.small_fleet import ECHO, RC, SmallFleet, begin_move, held, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.client import Client, RequestRefused
from zscout.behaviors.client.request import OpenArc
from zscout.mesh.renewal import Suspicions
from zscout.messages import ClientRequests, Grants, Notice, RcAsk
from zscout.testing.link import Disturbance
from zscout.testing.memory import MemoryMesh
from zscout.types import Grant, Place, Term


async def running(old: Client) -> OpenArc:
    arc, _ = await held(old, "runs", min_runtime=3600)
    return arc


async def succeed(next_leader: MemoryMesh, fleet: SmallFleet, old: Client) -> None:
    """The leader dies, and RCs answer the next one after clients."""
    answers = fleet.network.link(fleet.devices, next_leader)
    usual, answers.delay = answers.delay, 0.3
    await fleet.lose_leader()
    await until(lambda: old.leader == "h1")
    answers.delay = usual


async def runs_and_waits(old: Client) -> tuple[Grant, list[tuple[str, Place | None]]]:
    """Two ARCs for RC: the grant of the one that runs, and the ids and places of both."""
    runs = await running(old)
    grant = runs.grant
    assert grant is not None
    waits = await old.request("waits", {RC: {}}, min_runtime=3600)
    return grant, [(arc.id, arc._place) for arc in (runs, waits)]


async def both_go_on(new: Client, grant: Grant, places: list[tuple[str, Place | None]]) -> None:
    """Under their ids, at their places; what ran was granted anew."""
    runs, waits = [await new.request(name, {RC: {}}, min_runtime=3600) for name in ("runs", "waits")]
    assert [(arc.id, arc._place) for arc in (runs, waits)] == places
    granted = await new.granted(runs)
    assert granted is not None
    assert granted > grant
    assert ((await new.command(RC, granted, ECHO)).result, waits.state) == (7, "queued")


async def test_all_goes_on_in_another_client_though_its_rc_hears_of_it_late() -> None:
    """What a component's move rests on: nobody of equal priority gets in between."""
    async with small_fleet("old", "new", "rival") as (fleet, (old, new, rival)):
        await held(old, "tally", min_runtime=3600)
        waits = await rival.request("rival", {RC: {}}, min_runtime=1)
        holders: list[str] = []
        states: list[str] = [waits.state]
        rival.internals.watch(lambda arc: states.append(arc.state))
        rival.mesh.subscribe(
            rival.mesh.keys.grants,
            Grants,
            lambda _, grants: holders.extend(holder.arc for holder in grants.rcs.get(RC, [])),
        )
        fleet.network.link(fleet.leader(), fleet.devices).delay = 0.05
        for source, target in [(old, new), (new, old)] * 3:
            begin_move(source, target)
            await source.internals.hand_over_all(target.mesh.me)
            _, grant = await held(target, "tally", min_runtime=3600)
            assert (await target.command(RC, grant, ECHO)).result == 7
            source.internals.resume()
        await asyncio.sleep(10)
        assert (set(states), set(holders)) == ({"queued"}, {"tally"})


async def test_a_hand_over_that_dies_with_the_leader_once_it_is_answered_is_made_again() -> None:
    """A process that is killed takes along what it has sent and its links have not carried yet."""
    async with small_fleet("old", "new") as (fleet, (old, new)):
        grant, places = await runs_and_waits(old)
        leader, next_leader = fleet.leader(), await fleet.standby()
        begin_move(old, new)
        for other in (fleet.devices, next_leader, new.mesh):
            fleet.network.link(leader, other).loss = 1.0
        answers: list[str] = []
        fleet.network.link(leader, old.mesh).trace = lambda _source, _target, kind, _: answers.append(kind)
        moving = asyncio.create_task(old.internals.hand_over_all(new.mesh.me))
        await until(lambda: "reply" in answers)
        await fleet.lose_leader()
        await moving
        await both_go_on(new, grant, places)


async def test_what_a_new_leader_does_not_know_to_be_held_yet_is_handed_over_as_what_it_is() -> None:
    """Its client has answered that leader, and its RC, not in time, has not."""
    async with small_fleet("old", "new") as (fleet, (old, new)):
        grant, places = await runs_and_waits(old)
        next_leader = await fleet.standby()
        begin_move(old, new)
        await succeed(next_leader, fleet, old)
        states: dict[str, list[str]] = {"runs": [], "waits": []}
        new.internals.watch(lambda arc: states[arc.name].append(arc.state))
        await old.internals.hand_over_all(new.mesh.me)
        await both_go_on(new, grant, places)
        assert {name: {*told} for name, told in states.items()} == {"runs": {"running"}, "waits": {"queued"}}
        assert await fleet.holders() == ["runs"]


async def test_what_rcs_hold_for_the_new_client_is_handed_over_though_the_new_leader_does_not_see_that_one() -> None:
    """An RCM carried it out, and was heard by the RC alone."""
    async with small_fleet("old", "new") as (fleet, (old, new)):
        runs = await running(old)
        leader, next_leader = fleet.leader(), await fleet.standby()
        begin_move(old, new)
        for ends in ((new.mesh, next_leader), (next_leader, new.mesh)):
            fleet.network.cut(*ends)
        await asyncio.sleep(1.5)
        for other in (old.mesh, new.mesh, next_leader):
            fleet.network.link(leader, other).loss = 1.0
        moving = asyncio.create_task(old.internals.hand_over_all(new.mesh.me))
        await until(lambda: [held.holder.client for held in fleet.rcs[0].holds.held.values()] == ["h/new"])
        await succeed(next_leader, fleet, old)
        await moving
        assert runs.state == "moved"
        fleet.network.heal()
        assert await new.granted(await new.request("runs", {RC: {}}, min_runtime=3600)) is not None
        assert await fleet.holders() == ["runs"]


async def test_a_promise_that_is_made_as_a_hand_over_is_answered_counts() -> None:
    """Who stands for the lead has been told that the ARC is the old client's."""
    async with small_fleet("old", "new") as (fleet, (old, new)):
        runs = await running(old)
        begin_move(old, new)
        fleet.network.link(new.mesh, old.mesh).delay = 0.2
        moved: list[Term] = []
        old.internals.watch(lambda arc: moved.append(arc._last[0]) if arc.state == "moved" else None)
        moving = asyncio.create_task(old.internals.hand_over_all(new.mesh.me))
        await until(new.internals.open_requests)
        candidate, promised = fleet.mesh("h1", "node"), Term(2, "f" * 12)
        ask = candidate.keys.requests(old.mesh.me)
        reply = await candidate.ask_one(ask, RcAsk(promise=promised), ClientRequests, timeout=1)
        assert reply is not None
        assert reply.message is not None
        assert [request.id for request in reply.message.requests] == [runs.id]
        await moving
        assert moved[0] > promised


async def test_what_an_rcm_that_was_replaced_has_handed_over_is_awaited_once_more() -> None:
    """Its old client has promised the next one to have it, and hands it over there; the new one asks before that."""
    async with small_fleet("old", "new", "rival") as (fleet, (old, new, rival)):
        await running(rival)
        waits = await old.request("waits", {RC: {}}, min_runtime=3600)
        leader, next_leader = fleet.leader(), await fleet.standby()
        begin_move(old, new)
        for other in (leader, fleet.devices, new.mesh, rival.mesh):
            fleet.network.cut(other, next_leader)
            fleet.network.cut(next_leader, other)
        await until(lambda: old.internals.term.counter == 2)
        moving = asyncio.create_task(old.internals.hand_over_all(new.mesh.me))
        moved = await new.request("waits", {RC: {}}, min_runtime=3600)
        told: list[tuple[str, int]] = []
        new.internals.watch(lambda arc: told.append((arc.state, arc._last[0].counter)))
        granting = asyncio.create_task(new.granted(moved))
        fleet.network.link(old.mesh, next_leader).delay = 0.2
        fleet.network.heal()
        await moving
        await until(lambda: told[-1:] == [("queued", 2)])
        assert "ended" not in dict(told)
        assert (moved.id, moved._place) == (waits.id, waits._place)
        await rival.close()
        assert await granting is not None


async def test_what_is_awaited_once_more_is_handed_on() -> None:
    """The RCM of a later term has dropped the old client meanwhile."""
    async with small_fleet("one", "two") as (_, (one, two)):
        arc = await one.request("work", {"robot/z": {}}, min_runtime=3600)
        before = arc.id, arc._place
        # As if it had come in this term, and a later RCM knew it as another client's.
        arc._moved_in = arc._last[0]
        told = Notice(arc.id, arc.name, "h/one", "ended", Term(arc._last[0].counter + 1, "later"), 1)
        one._store.take(arc, replace(told, outcome="handed_over"))
        assert (arc.state, one.internals.open_requests()) == ("awaited", [])
        begin_move(one, two)
        moving = asyncio.create_task(one.internals.hand_over_all(two.mesh.me))
        moved = await two.request("work", {"robot/z": {}}, min_runtime=3600)
        await moving
        assert (moved.id, moved._place) == before


async def test_what_lost_its_rcm_as_it_is_handed_over_is_handed_over_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For the hold lease: that ends the hold, and its ARC is asked for again, by whoever has it."""
    # It would hear the RCM again in another session.
    monkeypatch.setattr(Suspicions, "suspect", lambda *_, **__: None)

    async with small_fleet("old", "new") as (fleet, (old, new)):
        arc = await running(old)
        begin_move(old, new)
        before, link = (arc.id, arc._place), fleet.network.link(fleet.leader(), old.mesh)
        link.loss = 1.0
        await until(lambda: arc.state == "asking")
        link.loss = 0.0
        await old.internals.hand_over_all(new.mesh.me)
        after = await new.request("runs", {RC: {}}, min_runtime=3600)
        assert (after.id, after._place) == before


async def test_what_the_new_client_does_not_hear_of_is_asked_for_as_what_it_was() -> None:
    """Neither a notice nor the question of the old client reaches it: the RCM's word has to do."""
    async with small_fleet("old", "new") as (fleet, (old, new)):
        grant, places = await runs_and_waits(old)
        begin_move(old, new)
        fleet.network.disturb({"notice": Disturbance(lost=1.0), "requests": Disturbance(lost=1.0)})
        await old.internals.hand_over_all(new.mesh.me)
        await both_go_on(new, grant, places)
        assert await fleet.holders() == ["runs"]


async def test_what_was_given_up_while_its_hand_over_was_undecided_is_not_taken_back() -> None:
    async with small_fleet("old", "new") as (fleet, (old, new)):
        runs = await running(old)
        begin_move(old, new)
        fleet.network.disturb({"notice": Disturbance(lost=1.0)})
        ending = asyncio.create_task(old.end(runs))
        with pytest.raises(RequestRefused, match="no leader reported within 10 s whether h/new took over; try again"):
            await old.internals.hand_over_all(new.mesh.me)
        fleet.network.kill(new.mesh)
        old.internals.take_back()
        await ending
        await asyncio.sleep(1)
        assert (await fleet.holders(), old.internals.open_requests()) == ([], [])
