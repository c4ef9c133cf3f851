"""Which components a net has placed and stops, whatever becomes of the placer's answers."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

from tests.behaviors.sensor_net.test_warming_up import RobotFleet, robot_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.client import Client
from zscout.behaviors.sensor_net.net import SensorNet
from zscout.behaviors.sensor_net.place_sensor_net import PlaceSensorNet
from zscout.behaviors.tree import BehaviorContext
from zscout.mesh import IncomingQuery
from zscout.messages import ComponentSpec, EndComponent, PlaceComponent, Placement, PlacerOperation

SPEC = ComponentSpec("place_robot")


class Placer:
    """Says what it has placed. While it is `silent` it does as it is asked and does not answer."""

    def __init__(self, fleet: RobotFleet) -> None:
        self.silent = False
        self.placed: list[str] = []
        self._unanswered: list[IncomingQuery[PlacerOperation]] = []
        mesh = fleet.mesh("placer", "node")
        for key in mesh.keys.served_placer():
            mesh.serve(key, PlacerOperation, self._on_query)

    def _on_query(self, query: IncomingQuery[PlacerOperation]) -> None:
        asked = query.message
        if isinstance(asked, PlaceComponent):
            if asked.component not in self.placed:
                self.placed.append(asked.component)
            state = "running"
        else:
            assert isinstance(asked, EndComponent)
            if not self.silent and asked.component in self.placed:
                self.placed.remove(asked.component)
            state = "ended"
        if self.silent:
            self._unanswered.append(query)
        else:
            query.answer(Placement(asked.component, SPEC, state, 1))  # type: ignore[arg-type]


@asynccontextmanager
async def placing(*clients: str) -> AsyncIterator[tuple[Placer, list[Client]]]:
    async with robot_fleet(*clients, "asks") as (fleet, made):
        # The real one that its leader brings would answer for this one.
        fleet.network.kill(fleet.leader())
        yield Placer(fleet), made


class Net:
    """A net over one robot, as a program runs it."""

    def __init__(self, client: Client, state: dict[str, Any] | None = None) -> None:
        self.behavior = PlaceSensorNet("net", SensorNet(["robot/z"]), lambda _robot, _path: SPEC)
        if state is not None:
            self.behavior.restore(state)

        async def safe_point() -> None:
            pass

        context = BehaviorContext(client, safe_point, lambda _said: None, name="net")
        self.task = asyncio.create_task(self.behavior.perform(context))

    async def stop(self) -> None:
        self.task.cancel()
        with suppress(asyncio.CancelledError):
            await self.task


async def test_a_net_that_moves_as_it_has_a_component_placed_knows_it_and_stops_it() -> None:
    async with placing("old", "new") as (placer, (old, new, _asks)):
        placer.silent = True
        before = Net(old)
        await until(lambda: placer.placed)
        state = before.behavior.checkpoint()
        placer.silent = False
        after = Net(new, state)
        await until(lambda: after.behavior._there)
        assert placer.placed == ["net-z"]
        await after.stop()
        assert placer.placed == []
        await before.stop()


async def test_what_was_asked_for_as_the_net_moved_and_never_arrived_is_asked_for_again() -> None:
    async with placing("old", "new") as (placer, (old, new, _asks)):
        before = Net(old)
        await until(lambda: before.behavior._there)
        state = before.behavior.checkpoint()
        placer.placed.clear()
        after = Net(new, state)
        await until(lambda: placer.placed == ["net-z"])
        await after.stop()
        await before.stop()


async def test_a_component_is_stopped_until_the_placer_says_so() -> None:
    async with placing("one") as (placer, (client, _asks)):
        net = Net(client)
        await until(lambda: net.behavior._there)
        placer.silent = True
        net.behavior.net.report(net.behavior._now(), "robot/z", "lost")
        await asyncio.sleep(40)
        assert placer.placed == ["net-z"]
        placer.silent = False
        await asyncio.sleep(10)
        assert placer.placed == []
        await net.stop()
