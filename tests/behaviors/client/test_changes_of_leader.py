"""What a client asked for and holds while leaders go and come, or two answer."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from msgspec.structs import replace

from tests.behaviors.client.small_fleet import ECHO, FLEET, RC, SmallFleet, held, small_fleet, transport_of
from tests.mesh.kit import until
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.config.access import AccessPolicy, Roles
from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Declaration, IncomingQuery
from zscout.messages import Ask, Notice
from zscout.rcm import admission
from zscout.services.rcm.candidate import Candidate
from zscout.testing.link import Disturbance
from zscout.types import SECOND, Place, Term


async def test_a_queued_request_that_the_next_leader_refuses_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        fleet.candidate("h1")
        await one.granted(await one.request("first", {RC: {}}, priority=5, min_runtime=600))
        waits = await two.request("second", {RC: {}}, priority=5, min_runtime=600)
        monkeypatch.setattr(admission, "MAX_PRIORITY", 4)
        await fleet.lose_leader()
        # The new leader does not hear of it while it takes the lead.
        link = fleet.network.link(two.mesh, fleet.candidates["h1"].mesh)
        link.loss = 1.0
        await until(lambda: one.leader == "h1")
        await asyncio.sleep(1)
        link.loss = 0.0
        await until(lambda: waits.state == "ended", within=20)
        assert waits.outcome == "lost"
        assert waits.reason == "the leader refuses it: priority must lie between -4 and 4"
        assert await two.granted(waits) is None
        assert two.internals.open_requests() == []


async def test_holds_and_places_outlive_a_change_of_leader() -> None:
    async with small_fleet("one", "two", "three") as (fleet, (one, two, three)):
        fleet.candidate("h1")
        async with hold(one, "first", {RC: {}}, min_runtime=60) as held:
            waits = [await client.request("next", {RC: {}}, min_runtime=60) for client in (two, three)]
            places, term = [arc._place for arc in waits], one.internals.term
            await fleet.lose_leader()
            await until(lambda: one.leader == "h1" and all(c.internals.term > term for c in (one, two, three)))
            assert held.active
            assert (await held.command(RC, ECHO)).result == 7
            # Each asks again, and keeps its place.
            await asyncio.sleep(7)
            assert [(arc.state, arc._place) for arc in waits] == [("queued", place) for place in places]
        assert await two.granted(waits[0]) is not None


@pytest.mark.parametrize("missing", [Role.SESSION, "requests"], ids=["it answers", "its session is seen"])
async def test_who_shows_a_new_leader_that_it_lives_is_not_dropped_though_its_token_is_missing(missing: str) -> None:
    """As where links came back without all declarations while another led, and nobody noticed."""
    async with small_fleet("watch", "one") as (fleet, (watch, one)):
        next_leader = fleet.candidate("h1").mesh
        before, client = transport_of(next_leader), transport_of(one.mesh)
        await asyncio.sleep(0.1)
        link = fleet.network.link(one.mesh, next_leader)
        hidden = f"/{Role.CLIENT}/one/", f"/{missing}"
        link.hidden = {one for one in client.declarations() if any(part in str(one) for part in hidden)}
        before.disconnected(client)
        for token in client.declared:
            if token not in link.hidden:
                before.on_token(client, token, True)
        async with hold(one, "first", {RC: {}}, min_runtime=600) as held:
            outcomes: list[str | None] = []
            one.internals.watch(lambda arc: outcomes.append(arc.outcome))
            await fleet.lose_leader()
            await until(lambda: watch.leader == "h1")
            await until(lambda: transport_of(next_leader) is not before, within=10)
            await asyncio.sleep(10)
            assert held.active
            assert "client_lost" not in outcomes


async def test_without_an_rcm_a_hold_ends_after_its_lease_and_is_asked_again() -> None:
    async with small_fleet("one") as (fleet, (one,)):
        arc, _ = await held(one, "first")
        await fleet.candidates.pop("h0").stop()
        await until(lambda: arc.state == "asking", within=FLEET.timing.hold_lease / SECOND + 1)
        assert arc._ending is not None
        assert arc._ending.outcome == "lost"
        fleet.candidate("h1")
        assert await one.granted(arc) is not None


async def test_an_rcm_far_above_is_followed_once_no_other_is_heard() -> None:
    """As where the fleet had to go above a forged term while this client was cut off."""
    async with small_fleet("one") as (fleet, (one,)):
        await until(lambda: one.internals.term.counter)
        await fleet.candidates.pop("h0").stop()
        candidate = fleet.candidates["h1"] = Candidate(fleet.mesh("h1", "node"), FLEET)
        candidate.terms.highest = far = Term(10**9, "far")
        candidate.start()
        await until(lambda: one.internals.term > far, within=FLEET.timing.hold_lease / SECOND + 3)
        await held(one, "first")


@asynccontextmanager
async def granted_unheard() -> AsyncIterator[tuple[SmallFleet, Client, OpenArc, list[Declaration]]]:
    """A client that is told of its grant only when it asks, and another RCM, of an older term, whose token it sees."""
    async with small_fleet("one", "two") as (fleet, (one, two)):
        mesh, old = fleet.mesh("old", "node"), Term(0, "old")

        def answer(asked: IncomingQuery[Ask]) -> None:
            asked.answer(Notice(asked.message.id, "second", "h/two", "queued", term=old, step=1, place=Place(old, 1)))

        declared = [mesh.serve(mesh.keys.schedule_any, Ask, answer), mesh.alive(Token("old", Role.RCM, "node", "old"))]
        first = await one.request("first", {RC: {}}, min_runtime=600, keep=True)
        waits = await two.request("second", {RC: {}}, min_runtime=600)
        await asyncio.sleep(0.5)
        fleet.network.disturb({"notice": Disturbance(lost=1.0)})
        await one.end(first)
        assert (await fleet.holders(), waits.state) == (["second"], "queued")
        yield fleet, two, waits, declared


async def test_when_one_of_two_rcms_goes_the_other_is_asked_at_once() -> None:
    """Its answer may have come second, and nobody read it."""
    async with granted_unheard() as (_, _, waits, old):
        for one in old:
            one.close()
        await until(lambda: waits.state == "running", within=0.1)


async def test_what_changes_while_all_is_asked_for_again_has_it_asked_once_more() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        first = await one.request("first", {RC: {}}, min_runtime=600, keep=True)
        waits = await two.request("second", {RC: {}}, min_runtime=600)
        await asyncio.sleep(0.5)
        fleet.network.disturb({"notice": Disturbance(lost=1.0)})
        fleet.network.link(fleet.leader(), two.mesh).delay = 0.5
        token = fleet.mesh("other", "node").alive(Token("other", Role.RCM, "node", "other"))
        await asyncio.sleep(0.1)  # the question is answered, and the answer on its way
        await one.end(first)
        token.close()
        await until(lambda: waits.state == "running", within=1.5)


async def test_the_answer_of_an_rcm_that_has_been_replaced_is_none() -> None:
    async with granted_unheard() as (fleet, two, waits, _):
        answers = fleet.network.link(fleet.leader(), two.mesh)
        answers.loss = 1.0
        fleet.mesh("third", "node").alive(Token("third", Role.RCM, "node", "third"))
        await asyncio.sleep(0.5)
        answers.loss = 0.0
        await until(lambda: waits.state == "running", within=1.3)


class ClosedFleet(SmallFleet):
    """As with certificates."""

    def __init__(self, fleet: Fleet = FLEET) -> None:
        super().__init__(fleet)
        self.network.closed = True


CLOSED = replace(FLEET, access=AccessPolicy(roles=Roles(client=("h",))))


async def test_with_certificates_a_client_goes_back_after_a_hold_lease_to_the_leader_that_it_sees() -> None:
    """What it heard of a higher term is nothing to that fleet, and its word moves nothing. What it gets of the leader
    that it goes back to lasts (seed 961816)."""
    seldom = replace(CLOSED, timing=replace(CLOSED.timing, heartbeat=SECOND))
    async with small_fleet("one", config=seldom, kind=ClosedFleet) as (fleet, (one,)):
        await until(lambda: one.internals.term.counter)
        arc, _ = await held(one, "first")
        one.internals.rcm.accept(Term(9, "gone"))
        began, lease = asyncio.get_running_loop().time(), FLEET.timing.hold_lease / SECOND
        await until(lambda: one.internals.term.counter == 1, within=2 * lease + 1)
        assert asyncio.get_running_loop().time() - began >= lease - 1
        grant = await one.granted(arc)
        await asyncio.sleep(lease)
        assert grant
        assert arc.grant == grant
        assert fleet.candidates["h0"].terms_led == 1


async def test_with_certificates_a_promise_to_a_candidate_that_died_costs_no_hold() -> None:
    async with small_fleet("one", config=CLOSED, kind=ClosedFleet) as (fleet, (one,)):
        arc, grant = await held(one, "first")
        fleet.candidate("h1")
        await asyncio.sleep(1)
        one.internals.rcm.accept(Term(9, "gone"), promise=True)
        await fleet.lose_leader()
        await until(lambda: one.leader == "h1")
        await until(lambda: one.internals.term.counter == 2, within=0.5)
        await asyncio.sleep(5)
        assert (arc.grant, await fleet.holders()) == (grant, ["first"])
