"""Place Sensor Net as components: `place_robot` for one robot, `place_sensor_net` for many."""

from __future__ import annotations

import asyncio
import json
from typing import Any, Final

from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.net import Net
from zscout.behaviors.sensor_net.place_robot import PlaceRobot, Slots
from zscout.behaviors.sensor_net.place_sensor_net import PlaceSensorNet
from zscout.behaviors.tree import Behavior, Scene
from zscout.behaviors.voice import Voice
from zscout.components.component import Component, Stage
from zscout.components.shipped import check_known, figure
from zscout.keyexpr import BadName, check_need, check_rc
from zscout.messages import ComponentSpec

MAX_ROBOTS: Final = 64
MAX_SPEED: Final = 100.0
MAX_RATE: Final = 50.0
MAX_SLOT: Final = 3_600.0
_NEEDS: Final = ("radio", "video", "framegrabber")
_SHARED: Final[tuple[str, ...]] = (
    *_NEEDS,
    "command_rate",
    "hide_priority",
    "watch_priority",
    "hide_slot",
    "watch_slot",
    "speed",
)


class TreeComponent(Component):
    """A component that plays a tree of behaviors, `root`, and keeps its memories."""

    root: Behavior
    speed: float

    async def run(self, stage: Stage) -> None:
        voice = Voice(stage.client)
        telling = asyncio.create_task(voice.keep_telling())
        try:
            await self.root.play(Scene(stage.client, stage.safe_point, voice, speed=self.speed))
        finally:
            telling.cancel()
            voice.close()

    def checkpoint(self) -> bytes:
        return json.dumps(self.root.checkpoint()).encode()

    def restore(self, state: bytes) -> None:
        self.root.restore(json.loads(state))


class PlaceRobotComponent(TreeComponent):
    """Hides one robot in the dark and has it watch for motion.

    Parameters: `robot`, as robot/scout33; `radio`, `video`, `framegrabber`, RCs or patterns (any of the
    kind); `command_rate`, commands in a second (5); `hide_priority` (2) and `watch_priority` (1) of its ARCs,
    `hide_slot` (30) and `watch_slot` (20), seconds that it keeps what it holds before another of its rank may
    have it; `speed`, how many seconds of the robots' world pass in one of ours (1); `above`, the path of the
    behavior that it belongs to."""

    def __init__(self, params: dict[str, Any]) -> None:
        check_known(params, "robot", "above", *_SHARED)
        robot = _rc(params, "robot")
        self.speed = figure(params, "speed", 1.0, low=0.01, high=MAX_SPEED)
        self.root = PlaceRobot(robot.partition("/")[2], _needs(params, robot), _slots(params))
        above = params.get("above", "")
        if not isinstance(above, str) or len(above) > 100:
            raise ValueError(f"above is {above!r:.60}; write the path of a behavior")
        self.root.above = above


class PlaceSensorNetComponent(TreeComponent):
    """Has robots hide and watch, each by a component `place_robot` of its own.

    Parameters: `robots`, a list of them; `wanted`, how many are to be placed (all), the others stand in for
    those that are lost; and those of `place_robot`."""

    def __init__(self, params: dict[str, Any]) -> None:
        check_known(params, "robots", "wanted", "name", *_SHARED)
        robots = params.get("robots")
        if not isinstance(robots, list) or not 1 <= len(robots) <= MAX_ROBOTS:
            raise ValueError(f"robots is {robots!r:.60}; write a list of 1 to {MAX_ROBOTS}, as robot/scout33")
        for robot in robots:
            _rc({"robots": robot}, "robots")
        wanted = params.get("wanted")
        if wanted is not None and (isinstance(wanted, bool) or not isinstance(wanted, int)):
            raise ValueError(f"wanted is {wanted!r:.60}; write a whole number")
        self.speed = figure(params, "speed", 1.0, low=0.01, high=MAX_SPEED)
        # Wrong ones are told here and now, not by each robot's component.
        _needs(params, robots[0])
        _slots(params)
        self._shared: dict[str, Any] = {name: params[name] for name in _SHARED if name in params}
        name = str(params.get("name", "place_sensor_net"))
        self.root = PlaceSensorNet(name, Net(robots, wanted), self._spec_for)

    def _spec_for(self, robot: str, path: str) -> ComponentSpec:
        return ComponentSpec(
            kind="place_robot",
            params={**self._shared, "robot": robot, "above": path},
            restart="always",
        )


def _needs(params: dict[str, Any], robot: str) -> RobotNeeds:
    return RobotNeeds(
        robot,
        **{name: _need(params, name) for name in _NEEDS},
        command_rate=figure(params, "command_rate", 5.0, low=0.5, high=MAX_RATE),
    )


def _slots(params: dict[str, Any]) -> Slots:
    return Slots(
        hide_priority=int(figure(params, "hide_priority", 2, low=-1000, high=1000)),
        watch_priority=int(figure(params, "watch_priority", 1, low=-1000, high=1000)),
        hide=figure(params, "hide_slot", 30.0, low=1.0, high=MAX_SLOT),
        watch=figure(params, "watch_slot", 20.0, low=1.0, high=MAX_SLOT),
    )


def _need(params: dict[str, Any], kind: str) -> str:
    need = params.get(kind, f"{kind}/*")
    try:
        return check_need(need if isinstance(need, str) else repr(need))
    except BadName as error:
        raise ValueError(f"{kind}: {error}") from None


def _rc(params: dict[str, Any], name: str) -> str:
    rc = params.get(name)
    try:
        return check_rc(rc if isinstance(rc, str) else repr(rc))
    except BadName as error:
        raise ValueError(f"{name}: {error}") from None
