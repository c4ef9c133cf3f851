"""Place Sensor Net: has robots hide and watch, each by a component of its own, wherever there is room.

The root of the tree. It asks the component placer for one `place_robot` per robot, follows their status, and
lets `SensorNet` decide who begins and who stands in for one that is lost.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, Final

from zscout.behaviors.client.client import RequestRefused
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.sensor_net.net import Effect, SensorNet, StartRobot
from zscout.behaviors.tree import Behavior, BehaviorContext, CarriedClock
from zscout.keyexpr import Role, Token
from zscout.mesh.supervision import Supervisor, supervised
from zscout.messages import MAX_COMPONENT_NAME, BehaviorSaid, ComponentSpec, Placement, Placements

PERIOD: Final = 0.5
"""Seconds between two checks of what is due."""
STOPPING: Final = 3.0
"""Seconds within which its components are stopped when it ends."""


class PlaceSensorNet(Behavior):
    """The net over `net`'s robots; `spec_for` gives the component that places one of them."""

    def __init__(self, name: str, net: SensorNet, spec_for: Callable[[str, str], ComponentSpec]) -> None:
        """`spec_for(robot, path)`; raises what `Behavior` raises."""
        super().__init__(name)
        self.net = net
        self._spec_for = spec_for
        self._there: dict[str, set[Token]] = {}
        self._components: dict[str, str] = {}
        """Robots by the names of their components: named after the net's own, which is the only one."""
        self._placed: set[str] = set()
        """Of these components, those that this net has had placed: what others placed is not its to stop."""
        self._clock = CarriedClock()
        self._supervisor: Supervisor

    async def run(self, context: BehaviorContext) -> None:
        client, keys = context.client, context.client.mesh.keys
        self._now(context)
        self._components = {
            component_of(context.name or self.name, robot): robot for robot in self.net.members
        }
        declared = [
            client.mesh.watch(keys.alive_any(Role.RC), self._on_token),
            client.mesh.subscribe(
                keys.behavior_any, BehaviorSaid, lambda key, status: self._on_status(context, key, status)
            ),
            client.mesh.subscribe(
                keys.placements,
                Placements,
                lambda _, placements: self._on_placements(context, placements.components),
            ),
        ]
        try:
            async with supervised(self.path) as self._supervisor:
                while True:
                    self._apply(context, self.net.there(self._now(context), self._there))
                    self._report_progress()
                    await context.safe_point()
                    await asyncio.sleep(PERIOD)
        finally:
            for one in declared:
                one.close()
            await self._end_all(context)

    def _report_progress(self) -> None:
        net = self.net
        lost = [member.robot for member in net.members.values() if member.standing == "lost"]
        words = f"{net.hidden} of {net.wanted} hidden, {net.watching} watching, {net.alerts} alerts"
        self.report("place" if net.hidden < net.wanted else "guard", words + _named(", lost: ", lost))

    # Events

    def _on_token(self, token: Token, alive: bool) -> None:
        if token.name in self.net.members:
            tokens = self._there.setdefault(token.name, set())
            (tokens.add if alive else tokens.discard)(token)
            if not tokens:
                del self._there[token.name]

    def _on_status(self, context: BehaviorContext, key: str, status: BehaviorSaid) -> None:
        sender = context.client.mesh.keys.sender_of(key)
        robot = self._components.get(sender.client.rpartition(".")[0])
        # Only the component that was placed for a robot reports of it.
        if robot is None or status.robot != robot:
            return
        self._apply(context, self.net.report(self._now(context), robot, status.doing, alert=status.alert))

    def _on_placements(self, context: BehaviorContext, placements: Iterable[Placement]) -> None:
        for placement in placements:
            robot = self._components.get(placement.component)
            if robot is None or placement.component not in self._placed:
                continue
            if placement.state in ("given_up", "ended"):
                why = placement.reason or "it was stopped"
                self._apply(context, self.net.failed(self._now(context), robot, why))

    # Effects

    def _apply(self, context: BehaviorContext, effects: Iterable[Effect]) -> None:
        for effect in effects:
            component = next(name for name, robot in self._components.items() if robot == effect.robot)
            if isinstance(effect, StartRobot):
                self._supervisor.spawn(self._start(context, component, effect.robot))
            else:
                self.report(self.doing, f"{effect.robot} is lost: {effect.why}")
                self._supervisor.spawn(self._stop(context, component))

    async def _start(self, context: BehaviorContext, component: str, robot: str) -> None:
        try:
            placer = PlacerClient(context.client.mesh)
            placed = await placer.place(component, self._spec_for(robot, self.path))
        except RequestRefused as refused:
            self._apply(context, self.net.failed(self._now(context), robot, str(refused)))
        else:
            self._placed.add(component)
            self._on_placements(context, [placed])

    async def _stop(self, context: BehaviorContext, component: str) -> None:
        if component not in self._placed:
            return
        self._placed.discard(component)
        with suppress(RequestRefused):
            await PlacerClient(context.client.mesh).stop(component)

    async def _end_all(self, context: BehaviorContext) -> None:
        active = [name for name, robot in self._components.items() if self._is_active(robot)]
        with suppress(TimeoutError):
            async with asyncio.timeout(STOPPING):
                await asyncio.gather(*(self._stop(context, name) for name in active))

    def _is_active(self, robot: str) -> bool:
        return self.net.members[robot].standing == "active"

    def _now(self, context: BehaviorContext) -> float:
        return self._clock.read(context.client.mesh.now())

    # What outlives a move

    def memory(self) -> dict[str, Any]:
        return {"net": self.net.memory(), "clock": self._clock.seconds, "placed": sorted(self._placed)}

    def recall(self, memory: dict[str, Any]) -> None:
        self.net.recall(memory["net"])
        self._clock.seconds = float(memory["clock"])
        self._placed = {str(component) for component in memory["placed"]}


def component_of(net: str, robot: str) -> str:
    """The name of the component that places one robot of the net that runs as component `net`."""
    name = f"{net}-{robot.partition('/')[2]}"
    if len(name) <= MAX_COMPONENT_NAME:
        return name
    # Cut names could be alike.
    mark = hashlib.sha256(name.encode()).hexdigest()[:8]
    return f"{name[: MAX_COMPONENT_NAME - len(mark) - 1]}-{mark}"


def _named(before: str, names: list[str]) -> str:
    return before + ", ".join(names) if names else ""
