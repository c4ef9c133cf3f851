"""One that stands by for a move, on a mesh in memory: what has it run."""

from __future__ import annotations

import asyncio

import pytest

from tests.behaviors.client.small_fleet import FLEET, held, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.client import Client
from zscout.behaviors.components.channel import (
    ComponentJob,
    ComponentReport,
    EndReport,
    Order,
    OrderAnswer,
    PhaseReport,
)
from zscout.behaviors.components.lifecycle import ComponentLifecycle
from zscout.keyexpr import Role, Sender, Token
from zscout.messages import ComponentSpec, RestoreComponent, StartComponent

COUNTER = "zscout.behaviors.components.shipped:Counter"


@pytest.mark.parametrize("late", [False, True])
async def test_what_is_handed_to_it_has_it_run_only_once_its_predecessor_is_not_seen(late: bool) -> None:
    """That one may have gone on: what was handed over to one behind a partition was taken back. `late`: as that is
    over, the link to it comes back after those to the others."""
    reports: list[ComponentReport] = []

    def report(one: ComponentReport) -> asyncio.Future[None]:
        reports.append(one)
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        done.set_result(None)
        return done

    async with small_fleet("c.1") as (fleet, (old,)):

        async def connect(name: str, **_: object) -> Client:
            client = Client.on(fleet.mesh("g", name), FLEET)
            fleet.clients.append(client)
            return client

        def phases() -> list[str]:
            return [one.phase for one in reports if isinstance(one, PhaseReport)]

        arc, _ = await held(old, "work", min_runtime=3600)
        predecessor = Token("h", Role.COMPONENT, "c", "1-older")
        token = None if late else old.mesh.alive(predecessor)
        start = StartComponent("c", 2, ComponentSpec("counter"), standby=True)
        standby = ComponentLifecycle(ComponentJob(start, COUNTER, "g", FLEET, "tag"), report, connect)
        story = asyncio.create_task(standby.run())
        await until(lambda: phases() == ["standby"])
        old.internals.pause()
        standby.order(Order(1, RestoreComponent("c", 2, b'{"count": 7}', old.internals.open_requests())))
        await until(lambda: OrderAnswer(1) in reports)
        await old.internals.hand_over_all(Sender("g", "c.2"))
        if token is None:
            await asyncio.sleep(0.9 * FLEET.mesh.lease)
            token = old.mesh.alive(predecessor)
        await asyncio.sleep(2)
        assert (arc.state, phases()) == ("moved", ["standby"])
        token.close()
        await until(lambda: phases() == ["standby", "running"])
        standby.end(EndReport("stopped"))
        await story
