"""The source's side of a move, on a mesh in memory."""

from __future__ import annotations

import asyncio

import pytest
from msgspec.structs import replace

from tests.behaviors.client.small_fleet import held, small_fleet
from zscout.behaviors.client.client import Client
from zscout.behaviors.components.component import SafePointGate
from zscout.behaviors.components.migration import RESTORE_TIMEOUT, NotMoved, OutgoingMove
from zscout.behaviors.components.shipped import Counter
from zscout.config.fleet import default_fleet
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import IncomingQuery
from zscout.messages import (
    ComponentList,
    ComponentOperation,
    ComponentSpec,
    ComponentView,
    ListComponents,
    MoveComponent,
    Phase,
    StopComponent,
)
from zscout.testing.memory import MemoryNetwork
from zscout.types import SECOND

STANDS_BY = ComponentView("c", 2, "b", ComponentSpec("counter"), "standby")


async def carried_out(client: Client) -> None:
    """The move of "c" to b, which comes to safe points."""
    gate = SafePointGate()
    moving = asyncio.ensure_future(OutgoingMove(client, Counter({}), gate, MoveComponent("c", 1, "b", 2)).carry_out())
    while not moving.done():
        await gate.enter()
        await asyncio.sleep(0.01)
    await moving


async def test_a_node_that_is_not_linked_yet_is_asked_again() -> None:
    network = MemoryNetwork()
    client = Client(network.open("f", Sender("a", "c.1")), default_fleet())
    node = network.open("f", Sender("b", "node"))
    move = OutgoingMove(client, Counter({}), SafePointGate(), MoveComponent("c", 1, "b", 2))
    began = client.mesh.now()
    with pytest.raises(NotMoved, match="b did not answer"):
        await move._send_state(b"", [])
    assert (client.mesh.now() - began) / SECOND == pytest.approx(RESTORE_TIMEOUT, abs=1.1)

    def serve() -> None:
        node.serve(node.keys.component("b", node.me), ComponentOperation, lambda query: query.answer(STANDS_BY))

    asyncio.get_running_loop().call_later(1, serve)
    await move._send_state(b"", [])


async def test_where_the_rcm_refuses_the_hand_over_the_other_one_is_stopped() -> None:
    """An RCM that was replaced may have carried it out: both would act."""
    async with small_fleet("c.1") as (fleet, (client,)):
        arc, grant = await held(client, "work", min_runtime=3600)
        node = fleet.mesh("b", "node")
        ordered: list[str] = []

        def answer(query: IncomingQuery[ComponentOperation]) -> None:
            order = query.message
            ordered.append(type(order).__name__)
            listed = isinstance(order, ListComponents)
            phase: Phase = "ended" if isinstance(order, StopComponent) else "standby"
            view = replace(STANDS_BY, phase=phase, ended="stopped" if phase == "ended" else None)
            query.answer(ComponentList("b", [view]) if listed else view)

        node.serve(node.keys.component("b", node.me), ComponentOperation, answer)
        token = node.alive(Token("b", Role.NODE, "node", "i"))
        with pytest.raises(NotMoved, match="refused the hand-over"):
            await carried_out(client)
        assert ordered[-1] == "StopComponent"
        assert (client.internals.paused, arc.state, arc.grant) == (False, "running", grant)
        token.close()


async def test_a_node_that_was_there_and_is_gone_is_not_waited_for() -> None:
    network = MemoryNetwork()
    client = Client(network.open("f", Sender("a", "c.1")), default_fleet())
    node = network.open("f", Sender("b", "node"))
    token = node.alive(Token("b", Role.NODE, "node", "i"))
    dies: list[asyncio.Task[None]] = []
    key = node.keys.component("b", node.me)
    node.serve(key, ComponentOperation, lambda _: dies.append(asyncio.ensure_future(node.close())))
    await asyncio.sleep(1)
    began = client.mesh.now()
    with pytest.raises(NotMoved, match="b did not answer"):
        await carried_out(client)
    assert dies
    assert (client.mesh.now() - began) / SECOND < 4
    token.close()


@pytest.mark.parametrize("lease", [1.0, 3.0])
async def test_a_successor_counts_as_gone_once_it_was_not_seen_for_longer_than_it_waits_itself(lease: float) -> None:
    """Behind a partition it runs a lease after it lost sight of this one, which is to go on after it."""
    network, fleet = MemoryNetwork(), default_fleet()
    client = Client(network.open("f", Sender("a", "c.1")), replace(fleet, mesh=replace(fleet.mesh, lease=lease)))
    token = network.open("f", Sender("b", "node")).alive(Token("b", Role.NODE, "node", "i"))
    move = OutgoingMove(client, Counter({}), SafePointGate(), MoveComponent("c", 1, "b", 2))
    confirming = asyncio.ensure_future(move._activate_successor())
    await asyncio.sleep(1)
    token.close()
    last_seen = client.mesh.now()
    assert not await confirming
    assert 2 * lease <= (client.mesh.now() - last_seen) / SECOND < 4 * lease
