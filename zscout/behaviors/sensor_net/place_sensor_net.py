"""Place Sensor Net: has robots hide and watch, each by a component of its own, wherever there is room.

The root of the tree. It asks the component placer for one `place_robot` per robot, hears what they say, and
lets `Net` decide who begins and who stands in for one that is lost.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Coroutine, Iterable
from contextlib import suppress
from typing import Any, Final

from zscout import clock
from zscout.behaviors import placing
from zscout.behaviors.client import RequestRefused
from zscout.behaviors.sensor_net.net import Effect, Net, Start
from zscout.behaviors.tree import Behavior, Scene
from zscout.keyexpr import Role, Token
from zscout.messages import MAX_COMPONENT_NAME, BehaviorSaid, ComponentSpec, Placement, Placements
from zscout.scheduling.model import SECOND

PERIOD: Final = 0.5
"""Seconds between two looks at what is due."""
STOPPING: Final = 3.0
"""Seconds within which its components are told to stop when it ends."""


class PlaceSensorNet(Behavior):
    """The net over `net`'s robots; `spec_for` gives the component that places one of them."""

    def __init__(self, name: str, net: Net, spec_for: Callable[[str, str], ComponentSpec]) -> None:
        """`spec_for(robot, path)`; raises what `Behavior` raises."""
        super().__init__(name)
        self.net = net
        self._spec_for = spec_for
        self._there: dict[str, set[Token]] = {}
        self._components: dict[str, str] = {}
        """Robots by the names of their components: named after the net's own, which is the only one."""
        self._placed: set[str] = set()
        """Of these components, those that this net has had placed: what others placed is not its to stop."""
        self._clock = 0.0
        self._clock_at = 0
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self, scene: Scene) -> None:
        client, keys = scene.client, scene.client.mesh.keys
        self._clock_at = clock.now()
        self._components = {component_of(scene.name or self.name, robot): robot for robot in self.net.members}
        declared = [
            client.mesh.watch(keys.alive_any(Role.RC), self._on_token),
            client.mesh.subscribe(
                keys.behavior_any, BehaviorSaid, lambda key, said: self._on_said(scene, key, said)
            ),
            client.mesh.subscribe(
                keys.placements, Placements, lambda _, told: self._on_placements(scene, told.components)
            ),
        ]
        try:
            while True:
                self._apply(scene, self.net.there(self._now(scene), self._there))
                self._tell()
                await scene.safe_point()
                await asyncio.sleep(PERIOD)
        finally:
            for one in declared:
                one.close()
            await self._end_all(scene)

    def _tell(self) -> None:
        net = self.net
        lost = [member.robot for member in net.members.values() if member.standing == "lost"]
        words = f"{net.hidden} of {net.wanted} hidden, {net.watching} watching, {net.alerts} alerts"
        self.say("place" if net.hidden < net.wanted else "guard", words + _named(", lost: ", lost))

    # What is heard

    def _on_token(self, token: Token, alive: bool) -> None:
        if token.name in self.net.members:
            tokens = self._there.setdefault(token.name, set())
            (tokens.add if alive else tokens.discard)(token)
            if not tokens:
                del self._there[token.name]

    def _on_said(self, scene: Scene, key: str, said: BehaviorSaid) -> None:
        sender = scene.client.mesh.keys.sender_of(key)
        robot = self._components.get(sender.client.rpartition(".")[0])
        # Only the component that was placed for a robot speaks for it.
        if robot is None or said.robot != robot:
            return
        self._apply(scene, self.net.told(self._now(scene), robot, said.doing, alert=said.alert))

    def _on_placements(self, scene: Scene, placements: Iterable[Placement]) -> None:
        for placement in placements:
            robot = self._components.get(placement.component)
            if robot is None or placement.component not in self._placed:
                continue
            if placement.state in ("given_up", "ended"):
                why = placement.reason or "it was stopped"
                self._apply(scene, self.net.failed(self._now(scene), robot, why))

    # What is done

    def _apply(self, scene: Scene, effects: Iterable[Effect]) -> None:
        for effect in effects:
            component = next(name for name, robot in self._components.items() if robot == effect.robot)
            if isinstance(effect, Start):
                self._spawn(self._start(scene, component, effect.robot))
            else:
                self.say(self.doing, f"{effect.robot} is lost: {effect.why}")
                self._spawn(self._stop(scene, component))

    async def _start(self, scene: Scene, component: str, robot: str) -> None:
        try:
            placed = await placing.place(scene.client, component, self._spec_for(robot, self.path))
        except RequestRefused as refused:
            self._apply(scene, self.net.failed(self._now(scene), robot, str(refused)))
        else:
            self._placed.add(component)
            self._on_placements(scene, [placed])

    async def _stop(self, scene: Scene, component: str) -> None:
        if component not in self._placed:
            return
        self._placed.discard(component)
        with suppress(RequestRefused):
            await placing.stop(scene.client, component)

    async def _end_all(self, scene: Scene) -> None:
        for task in list(self._tasks):
            task.cancel()
        active = [name for name, robot in self._components.items() if self._is_active(robot)]
        with suppress(TimeoutError):
            async with asyncio.timeout(STOPPING):
                await asyncio.gather(*(self._stop(scene, name) for name in active))

    def _is_active(self, robot: str) -> bool:
        return self.net.members[robot].standing == "active"

    def _now(self, scene: Scene) -> float:
        at = clock.now()
        self._clock += (at - self._clock_at) / SECOND
        self._clock_at = at
        return self._clock

    def _spawn(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # What outlives a move

    def memory(self) -> dict[str, Any]:
        return {"net": self.net.memory(), "clock": self._clock, "placed": sorted(self._placed)}

    def recall(self, memory: dict[str, Any]) -> None:
        self.net.recall(memory["net"])
        self._clock = float(memory["clock"])
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
