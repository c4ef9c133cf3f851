"""Members of a fleet with certificates that lie about terms: somebody leads, and an honest client is served beside."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.hang import HANG
from tests.live.closed import ROLES, ClosedLab
from tests.live.lab import PatientClient
from zscout.behaviors.client.arc import hold
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import IncomingQuery, Refused, ZenohMesh
from zscout.messages import Ask, ClientRequests, Notice, OpenRequest, RcAsk, RcState
from zscout.types import Place, Term

pytestmark = [pytest.mark.live, pytest.mark.slow]


@asynccontextmanager
async def beside(
    folder: Path, name: str, client: str, **how: Any
) -> AsyncIterator[tuple[ClosedLab, PatientClient, ZenohMesh]]:
    """A fleet of one node that leads, an honest client, and the session of a member that lies."""
    async with ClosedLab(folder, **how) as lab:
        lab.node("anvil", "robot/a")
        bob = await lab.person("bob")
        await lab.ready(bob, "robot/a")
        mesh = await ZenohMesh.open(lab.fleet_of(name), Sender(name, client))
        try:
            yield lab, bob, mesh
        finally:
            await mesh.close()


async def serve(bob: PatientClient, rc: str = "robot/a") -> None:
    async with asyncio.timeout(HANG), hold(bob, "survey", {rc: {}}):
        pass


def far(query: IncomingQuery[RcAsk]) -> Term:
    """Above what is asked for."""
    promise = query.message.promise
    return Term((promise.counter if promise is not None else 0) + 2, "eve")


def bad(term: Term) -> Ask:
    needs: dict[str, Any] = {"robot/a": {}}
    return Ask("lie", "lie", needs, 0, 1, term=term)  # type: ignore[arg-type]


def refuse(query: IncomingQuery[RcAsk], requests: list[OpenRequest]) -> None:
    if query.message.ordinary:
        query.answer(ClientRequests("eve/liar", requests, far(query)))
    else:
        raise Refused("old_term", "no", far(query))


@pytest.mark.parametrize("lists", [False, True], ids=["refuses promises", "lists places of future terms"])
async def test_a_client_that_refuses_each_promise_keeps_nobody_from_leading(tmp_path: Path, lists: bool) -> None:
    async with beside(tmp_path, "eve", "liar") as (lab, bob, eve):
        asked = asyncio.Event()

        def answer(query: IncomingQuery[RcAsk]) -> None:
            asked.set()
            place = Place(far(query), 1)
            listed = OpenRequest("lie", "lie", {"robot/a": {}}, 0, 1, place=place, seal="0" * 32)  # type: ignore[arg-type]
            refuse(query, [listed] if lists else [])

        declared = [
            eve.serve(eve.keys.requests(eve.me), RcAsk, answer),
            eve.alive(Token("eve", Role.CLIENT, "liar", "1")),
        ]
        lab.nodes.pop("anvil").kill()
        lab.node("anvil", "robot/a")
        await asked.wait()
        await lab.ready(bob, "robot/a")
        await serve(bob)
        del declared


async def test_a_client_that_asks_in_a_future_term_deposes_nobody(tmp_path: Path) -> None:
    async with beside(tmp_path, "eve", "liar") as (lab, bob, eve):
        before = await lab.ready(bob, "robot/a")
        declared = [
            eve.serve(eve.keys.requests(eve.me), RcAsk, lambda query: refuse(query, [])),
            eve.alive(Token("eve", Role.CLIENT, "liar", "1")),
        ]
        for _ in range(3):
            reply = await eve.ask_one(eve.keys.schedule(eve.me), bad(Term(2**50, "eve")), Notice, timeout=5)
            assert reply is not None
            assert reply.problem is not None
            assert reply.problem.code == "old_term"
            await serve(bob)
        assert (await lab.ready(bob, "robot/a")).term == before.term
        del declared


async def test_a_node_whose_rc_claims_terms_moves_the_fleet_once(tmp_path: Path) -> None:
    """What it claims next is not believed for a while, and its RC counts as absent."""
    async with beside(tmp_path, "cart", "liar") as (lab, bob, cart):
        before = await lab.ready(bob, "robot/a")
        claimed, counter = 0, 2**40

        def state() -> RcState:
            return RcState("radio/r", "cart", "1", False, Term(counter, "cart"), leader=True)

        declared = [
            cart.serve(cart.keys.rc_state("radio/r"), RcAsk, lambda query: query.answer(state())),
            cart.alive(Token("cart", Role.RC, "radio/r", "1")),
        ]
        publisher = cart.publisher(cart.keys.rc_state("radio/r"), RcState)

        async def claim() -> None:
            nonlocal counter, claimed
            while True:
                counter, claimed = counter + 2, claimed + 1
                publisher.put(state())
                await asyncio.sleep(0.02)

        claiming = asyncio.create_task(claim())
        await lab.state(bob, lambda state: state.term.counter > 2**40)
        after = await lab.ready(bob, "robot/a")
        for _ in range(5):
            so_far = claimed
            while claimed < so_far + 5:  # noqa: ASYNC110 - it claims beside this
                await asyncio.sleep(0.02)
            await serve(bob)
        assert before.term < after.term == (await lab.ready(bob, "robot/a")).term
        claiming.cancel()
        del declared


async def test_a_node_with_many_made_up_rcs_that_see_a_leader_keeps_nobody_from_leading(tmp_path: Path) -> None:
    """Its host alone says so: the one candidate that is left waits for a while, and leads."""
    # The liar answers from this process: a machine that is busy gives it the time to.
    roles = f'{ROLES}bench = ["gripper/*"]\n[timing]\nrebuild = 1.5\n'
    async with beside(tmp_path, "cart", "liar", roles=roles, lease=1.0) as (lab, bob, cart):
        lab.node("bench", "gripper/b")
        before = await lab.ready(bob, "robot/a", "gripper/b")

        def answer(rc: str, query: IncomingQuery[RcAsk]) -> None:
            query.answer(RcState(rc, "cart", "1", False, query.message.promise or before.term, leader=True))

        names = [f"radio/r{number}" for number in range(50)]
        declared = [
            (
                cart.serve(cart.keys.rc_state(rc), RcAsk, partial(answer, rc)),
                cart.alive(Token("cart", Role.RC, rc, "1")),
            )
            for rc in names
        ]
        await lab.ready(bob, *names)
        await lab.candidates(bob, "anvil", "bench")
        lab.nodes["anvil"].kill()
        await lab.state(bob, lambda state: state.term > before.term)
        await serve(bob, "gripper/b")
        assert "only cart shows one" in lab.log("bench")
        del declared
