"""Place Sensor Net as components: `place_robot` for one robot, `place_sensor_net` for many."""

from __future__ import annotations

import json
import re
from typing import Any, Final

from zscout.behaviors.components.component import Component, ComponentContext
from zscout.behaviors.components.shipped import check_known, figure
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.net import SensorNet
from zscout.behaviors.sensor_net.place_robot import PlaceRobot, Slots
from zscout.behaviors.sensor_net.place_sensor_net import PlaceSensorNet
from zscout.behaviors.tree import Behavior, BehaviorContext, StatusPublisher
from zscout.keyexpr import BadName, check_name, check_need, check_rc
from zscout.mesh.supervision import supervised
from zscout.messages import BehaviorSaid, ComponentSpec

MAX_ROBOTS: Final = 64
MAX_SPEED: Final = 100.0
MAX_RATE: Final = 50.0
MAX_SLOT: Final = 3_600.0
MAX_PATH: Final = 100
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
    """A component that performs a tree of behaviors, `root`, and checkpoints it. Their status is published;
    each new one and each alert is printed, for `zscout logs`."""

    root: Behavior
    speed: float

    async def run(self, context: ComponentContext) -> None:
        publisher = StatusPublisher(context.client)
        printer = StatusPrinter()

        def publish(status: BehaviorSaid) -> None:
            publisher(status)
            printer(status)

        tree = BehaviorContext(
            context.client, context.safe_point, publish, speed=self.speed, name=context.component
        )
        try:
            async with supervised(context.component) as supervisor:
                supervisor.spawn(publisher.keep_publishing())
                await self.root.perform(tree)
        finally:
            publisher.close()

    def checkpoint(self) -> bytes:
        return json.dumps(self.root.checkpoint()).encode()

    def restore(self, state: bytes) -> None:
        self.root.restore(json.loads(state))


class StatusPrinter:
    """Prints the status of behaviors, without what changes with every picture of a robot."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[str, str]] = {}

    def __call__(self, status: BehaviorSaid) -> None:
        # "dark place 1.3 m ahead" is no news after "dark place 1.4 m ahead".
        detail = re.sub(r"[0-9.]+", "", status.detail) if status.robot else status.detail
        news = status.doing, detail
        if news == self._last.get(status.path, ("", "")) and not status.alert:
            return
        self._last[status.path] = news
        if status.doing:
            words = "ALERT" if status.alert else status.doing
            print(f"{status.path} {words}" + (f": {status.detail}" if status.detail else ""))  # noqa: T201


class PlaceRobotComponent(TreeComponent):
    """Hides one robot in the dark and has it watch for motion.

    Parameters: `robot`, as robot/scout33; `radio`, `video`, `framegrabber`, RCs or patterns (any of the
    kind); `command_rate`, commands in a second (5); `hide_priority` (2) and `watch_priority` (1) of its ARCs,
    `hide_slot` (30) and `watch_slot` (20), seconds that it keeps what it holds before another of its rank may
    have it; `speed`, how many seconds of the robots' world pass in one of ours (1); `above`, the path of the
    behavior that it belongs to."""

    def __init__(self, params: dict[str, Any]) -> None:
        check_known(params, "robot", "above", *_SHARED)
        robot = _robot(params)
        self.speed = figure(params, "speed", 1.0, low=0.01, high=MAX_SPEED)
        self.root = PlaceRobot(robot.partition("/")[2], _needs(params, robot), _slots(params))
        above = params.get("above", "")
        if not isinstance(above, str) or len(above) > MAX_PATH:
            raise ValueError(
                f"above is {above!r:.60}; write the path of a behavior, {MAX_PATH} letters at most"
            )
        self.root.above = above


class PlaceSensorNetComponent(TreeComponent):
    """Has robots hide and watch, each by a component `place_robot` of its own.

    Parameters: `robots`, a list of them; `wanted`, how many are to be placed (all), the others stand in for
    those that are lost; `name`, of its behavior and before the names of its components (place_sensor_net): a
    second net needs another one; and those of `place_robot`, but for `robot` and `above`."""

    def __init__(self, params: dict[str, Any]) -> None:
        check_known(params, "robots", "wanted", "name", *_SHARED)
        robots = _robots(params)
        wanted = _whole(params, "wanted", len(robots), low=1, high=len(robots))
        self.speed = figure(params, "speed", 1.0, low=0.01, high=MAX_SPEED)
        # Wrong ones are told here and now, not by each robot's component.
        _needs(params, robots[0])
        _slots(params)
        self._shared: dict[str, Any] = {name: params[name] for name in _SHARED if name in params}
        name = params.get("name", "place_sensor_net")
        check_name(name if isinstance(name, str) else repr(name), "name")
        self.root = PlaceSensorNet(name, SensorNet(robots, wanted), self._spec_for)

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
        hide_priority=_whole(params, "hide_priority", 2, low=-1000, high=1000),
        watch_priority=_whole(params, "watch_priority", 1, low=-1000, high=1000),
        hide=figure(params, "hide_slot", 30.0, low=1.0, high=MAX_SLOT),
        watch=figure(params, "watch_slot", 20.0, low=1.0, high=MAX_SLOT),
    )


def _whole(params: dict[str, Any], name: str, default: int, *, low: int, high: int) -> int:
    value = params.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{name} is {value!r:.60}; write a whole number from {low} to {high}")
    return value


def _robots(params: dict[str, Any]) -> list[str]:
    robots = params.get("robots")
    if not isinstance(robots, list) or not 1 <= len(robots) <= MAX_ROBOTS:
        found = f"is {robots!r:.60}" if "robots" in params else "is missing"
        raise ValueError(f'robots {found}; write a list of 1 to {MAX_ROBOTS}, as in ["robot/scout33"]')
    for number, robot in enumerate(robots):
        _check_robot(robot, f"robots[{number}]")
        if robot in robots[:number]:
            raise ValueError(f"robots: {robot} is named twice; name each robot once")
    return robots


def _robot(params: dict[str, Any]) -> str:
    if "robot" not in params:
        raise ValueError("robot is missing; write one, as in robot/scout33")
    robot = params["robot"]
    _check_robot(robot, "robot")
    return str(robot)


def _check_robot(robot: Any, what: str) -> None:
    if not isinstance(robot, str) or not robot.startswith("robot/"):
        raise ValueError(f"{what} is {robot!r:.60}; write a robot, as in robot/scout33")
    try:
        check_rc(robot)
    except BadName as error:
        raise ValueError(f"{what}: {error}") from None


def _need(params: dict[str, Any], kind: str) -> str:
    need = params.get(kind, f"{kind}/*")
    if not isinstance(need, str) or not need.startswith(f"{kind}/"):
        raise ValueError(f"{kind} is {need!r:.60}; write {kind}/NAME or a pattern, as in {kind}/*")
    try:
        return check_need(need)
    except BadName as error:
        raise ValueError(f"{kind}: {error}") from None
