"""Place Sensor Net as components: `place_robot` for one robot, `place_sensor_net` for many."""

from __future__ import annotations

import json
import re
from contextlib import closing, suppress
from typing import Annotated, Any, Final

from msgspec import Meta, Struct

from zscout.behaviors.components.component import Component, ComponentContext
from zscout.behaviors.components.shipped import PARAMS, read_params
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.net import SensorNet
from zscout.behaviors.sensor_net.place_robot import PlaceRobot, Slots
from zscout.behaviors.sensor_net.place_sensor_net import PlaceSensorNet
from zscout.behaviors.tree import Behavior, BehaviorContext, StatusPublisher
from zscout.config.strict import check_name, check_rc_name, check_unique, key, quoted
from zscout.keyexpr import BadName, check_need
from zscout.mesh.supervision import supervised
from zscout.messages import BehaviorSaid, ComponentSpec

MAX_ROBOTS: Final = 64
MAX_PATH: Final = 100

Priority = Annotated[int, key("Priority of an ARC.", -1000, 1000)]
Slot = Annotated[float, key("Seconds that a hold is kept before another of its rank may have it.", 1, 3600)]


class SharedParams(Struct, kw_only=True):
    """Parameters of both kinds. `radio`, `video`, `framegrabber`: names or patterns of RCs, by default any of the kind.
    `speed`: seconds of the robots' simulated world per real second."""

    radio: str = "radio/*"
    video: str = "video/*"
    framegrabber: str = "framegrabber/*"
    command_rate: Annotated[float, key("Commands per second.", 0.5, 50)] = 5.0
    hide_priority: Priority = 2
    watch_priority: Priority = 1
    hide_slot: Slot = 60.0
    watch_slot: Slot = 30.0
    speed: Annotated[float, key("Simulated seconds per real second.", 0.01, 100)] = 1.0

    def needs(self, robot: str) -> RobotNeeds:
        """Raises BadInput."""
        check_rc_name(robot, PARAMS / "robot", "robot")
        for name, need in (("radio", self.radio), ("video", self.video), ("framegrabber", self.framegrabber)):
            kind = "" if name == "framegrabber" else f"{name}/"  # a camera may have a name of any kind
            with suppress(BadName):
                if check_need(need).startswith(kind):
                    continue
            raise (PARAMS / name).bad(f"{quoted(need)} is not a {name}", f'name one, or a pattern, as in "{name}/*"')
        needs = RobotNeeds(robot, self.radio, self.video, self.framegrabber, self.command_rate)
        if fault := needs.shared_camera():
            raise (PARAMS / "framegrabber").bad(fault, "name another device")
        return needs


class RobotParams(SharedParams):
    """Parameters of `place_robot`. `above`: path of its parent behavior."""

    robot: Annotated[str, key("The robot to place.", remedy="add one, as in robot/scout33")]
    above: Annotated[str, Meta(max_length=MAX_PATH)] = ""

    def __post_init__(self) -> None:
        self.needs(self.robot)


class NetParams(SharedParams):
    """`wanted`: how many robots to place, by default all; the others replace lost ones. `name`: of its behavior and
    prefix of its components' names, so each net needs its own."""

    robots: Annotated[
        tuple[str, ...], key("The robots to place.", most=MAX_ROBOTS, remedy='add a list, as in ["robot/scout33"]')
    ]
    wanted: int | None = None
    name: str = "place_sensor_net"

    def __post_init__(self) -> None:
        for number, robot in enumerate(self.robots):
            check_rc_name(robot, (PARAMS / "robots").item(number), "robot")
        check_unique(self.robots, PARAMS / "robots")
        if not self.robots:
            raise (PARAMS / "robots").bad("is empty", 'name one, as in ["robot/scout33"]')
        if self.wanted is not None and not 1 <= self.wanted <= len(self.robots):
            remedy = f"write a whole number from 1 to {len(self.robots)}"
            raise (PARAMS / "wanted").bad(f"is {self.wanted}", remedy)
        check_name(self.name, PARAMS / "name")
        # Report invalid needs at once, rather than from each robot's component.
        self.needs(self.robots[0])


class TreeComponent(Component):
    """Performs and checkpoints the tree `root`, publishes its status, prints changes and alerts for its logs."""

    root: Behavior
    speed: float

    async def run(self, context: ComponentContext) -> None:
        printer, client = StatusPrinter(), context.client

        def publish(status: BehaviorSaid) -> None:
            publisher(status)
            printer(status)

        tree = BehaviorContext(client, context.safe_point, publish, speed=self.speed, name=context.component)
        with closing(StatusPublisher(client)) as publisher:
            async with supervised(context.component) as supervisor:
                supervisor.spawn(publisher.keep_publishing())
                await self.root.perform(tree)

    def checkpoint(self) -> bytes:
        return json.dumps(self.root.checkpoint()).encode()

    def restore(self, state: bytes) -> None:
        self.root.restore(json.loads(state))


class StatusPrinter:
    """Prints each change of a behavior's status, and each alert; changes of numbers in a robot's status don't count."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[str, str]] = {}

    def __call__(self, status: BehaviorSaid) -> None:
        # "dark place 1.3 m ahead" is no news after "dark place 1.4 m ahead".
        detail = re.sub(r"[0-9.]+", "", status.detail) if status.robot else status.detail
        news, before = (status.doing, detail), self._last.get(status.path, ("", ""))
        self._last[status.path] = news
        if status.doing and (status.alert or news != before):
            words = "ALERT" if status.alert else status.doing
            print(f"{status.path} {words}" + (f": {status.detail}" if status.detail else ""))  # noqa: T201


class PlaceRobotComponent(TreeComponent):
    """Hides one robot in the dark, where it watches for motion."""

    def __init__(self, params: dict[str, Any]) -> None:
        wanted = read_params(params, RobotParams)
        self.speed = wanted.speed
        slots = Slots(wanted.hide_priority, wanted.watch_priority, wanted.hide_slot, wanted.watch_slot)
        self.root = PlaceRobot(wanted.robot.partition("/")[2], wanted.needs(wanted.robot), slots)
        self.root.above = wanted.above


class PlaceSensorNetComponent(TreeComponent):
    """Makes robots hide and watch, each by a `place_robot` component of its own."""

    def __init__(self, params: dict[str, Any]) -> None:
        net = read_params(params, NetParams)
        self.speed = net.speed
        self._shared: dict[str, Any] = {name: params[name] for name in SharedParams.__struct_fields__ if name in params}
        robots = SensorNet(list(net.robots), net.wanted or len(net.robots))
        self.root = PlaceSensorNet(net.name, robots, self._spec_for)

    def _spec_for(self, robot: str, path: str) -> ComponentSpec:
        params = {**self._shared, "robot": robot, "above": path}
        return ComponentSpec(kind="place_robot", params=params, restart="always")
