"""Place Sensor Net: robots hide and watch, each by a component of its own, wherever there is room.

The root of the tree. It requests one `place_robot` per robot from the component placer, follows their status, and lets
`SensorNet` decide which start and which replace a lost one."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Iterable
from typing import Any, Final

from zscout.behaviors.client.client import RequestRefused
from zscout.behaviors.client.placer_client import PlacerClient, PlacerSilent
from zscout.behaviors.sensor_net.net import Effect, SensorNet, StopRobot
from zscout.behaviors.tree import Behavior, BehaviorContext, CarriedClock
from zscout.drivers.own import RcDirectory
from zscout.mesh import Mesh
from zscout.mesh.supervision import Supervisor, done_within, supervised
from zscout.messages import MAX_COMPONENT_NAME, BehaviorSaid, ComponentSpec, Placement, Placements

PERIOD: Final = 0.5  # seconds between two checks
STOPPING: Final = 3.0  # seconds for stopping its components at the end


class PlaceSensorNet(Behavior):
    def __init__(self, name: str, net: SensorNet, spec_for: Callable[[str, str], ComponentSpec]) -> None:
        """`spec_for(robot, path)`; raises the errors of `Behavior`."""
        super().__init__(name)
        self.net = net
        self._spec_for = spec_for
        self._components: dict[str, str] = {}  # robots by component name, which is unique as it contains the net's
        self._placed: set[str] = set()  # components that this net had placed: it stops no others
        self._there: set[str] = set()  # components confirmed by the placer to this process
        self._busy: set[str] = set()  # components with a placer request under way
        self._clock = CarriedClock()
        self._supervisor: Supervisor
        self._mesh: Mesh

    async def run(self, context: BehaviorContext) -> None:
        mesh = self._mesh = context.client.mesh
        directory = RcDirectory(mesh)
        self._now()
        self._components = {component_of(context.name or self.name, robot): robot for robot in self.net.members}
        declared = [
            directory.watch(),
            mesh.subscribe(mesh.keys.behavior_any, BehaviorSaid, self._on_status),
            mesh.subscribe(mesh.keys.placements, Placements, lambda _, news: self._on_placements(news.components)),
        ]
        try:
            async with supervised(self.path) as self._supervisor:
                while True:
                    there = [robot for robot in self.net.members if directory.hosts(robot)]
                    self._apply(self.net.there(self._now(), there))
                    self._see_to_components()
                    self._report_progress()
                    await context.safe_point()
                    await asyncio.sleep(PERIOD)
        finally:
            for declaration in declared:
                declaration.close()
            await done_within(STOPPING, asyncio.gather(*map(self._stop, [*self._placed])))

    def _report_progress(self) -> None:
        net = self.net
        words = f"{net.hidden} of {net.wanted} hidden, {net.watching} watching, {net.alerts} alerts"
        if lost := [member.robot for member in net.members.values() if member.standing == "lost"]:
            words += f", lost: {', '.join(lost)}"
        self.report("place" if net.hidden < net.wanted else "guard", words)

    def _on_status(self, key: str, status: BehaviorSaid) -> None:
        sender = self._mesh.keys.sender_of(key)
        robot = self._components.get(sender.client.rpartition(".")[0])
        # Only a robot's own component reports its status.
        if robot is not None and status.robot == robot:
            self._apply(self.net.report(self._now(), robot, status.doing, alert=status.alert))

    def _on_placements(self, placements: Iterable[Placement]) -> None:
        for placement in placements:
            robot = self._components.get(placement.component)
            ended = placement.component in self._there and placement.state in ("given_up", "ended")
            if robot is not None and ended:
                self._apply(self.net.failed(self._now(), robot, placement.reason or "it was stopped"))

    def _apply(self, effects: Iterable[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, StopRobot):
                self.report(self.doing, f"{effect.robot} is lost: {effect.why}")

    def _see_to_components(self) -> None:
        """Place components of active robots, again after a move; stop all others until the placer confirms."""
        for component, robot in self._components.items():
            active = self.net.members[robot].standing == "active"
            done = component in self._there if active else component not in self._placed
            if done or component in self._busy:
                continue
            self._busy.add(component)
            self._placed.add(component)
            self._supervisor.spawn(self._start(component, robot) if active else self._stop(component))

    async def _start(self, component: str, robot: str) -> None:
        try:
            placed = await PlacerClient(self._mesh).place(component, self._spec_for(robot, self.path))
        except RequestRefused as refused:
            if not isinstance(refused, PlacerSilent):
                self._placed.discard(component)
            self._apply(self.net.failed(self._now(), robot, str(refused)))
        else:
            self._there.add(component)
            self._on_placements([placed])
        finally:
            self._busy.discard(component)

    async def _stop(self, component: str) -> None:
        try:
            await PlacerClient(self._mesh).stop(component)
        except RequestRefused as refused:
            if not isinstance(refused, PlacerSilent):
                self._placed.discard(component)
        else:
            self._placed.discard(component)
        finally:
            self._there.discard(component)
            self._busy.discard(component)

    def _now(self) -> float:
        return self._clock.read(self._mesh.now())

    def memory(self) -> dict[str, Any]:
        return {"net": self.net.memory(), "clock": self._clock.seconds, "placed": sorted(self._placed)}

    def recall(self, memory: dict[str, Any]) -> None:
        self.net.recall(memory["net"])
        self._clock.seconds = float(memory["clock"])
        self._placed = {str(component) for component in memory["placed"]}


def component_of(net: str, robot: str) -> str:
    """The component that places one robot of the net with component name `net`."""
    name = f"{net}-{robot.partition('/')[2]}"
    if len(name) <= MAX_COMPONENT_NAME:
        return name
    # Cut names could collide.
    mark = hashlib.sha256(name.encode()).hexdigest()[:8]
    return f"{name[: MAX_COMPONENT_NAME - len(mark) - 1]}-{mark}"
