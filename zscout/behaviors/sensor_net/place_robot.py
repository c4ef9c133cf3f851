"""One robot of a sensor net: it hides in the dark, turns to the light and watches for motion.

Sensing and acting go through ARCs only. To hide, and to watch, it holds robot, radio, video channel and
framegrabber for a slot, and keeps them while nobody of its rank waits: with more robots than framegrabbers
they take turns. Hiding ranks above watching. What the robot is to do with its wheels is decided by `Hider`,
whether something moves by `MotionDetector`; both are pure, and live on while the robot is not held.
"""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from zscout import clock
from zscout.behaviors.arc import Held, Revoked, holds
from zscout.behaviors.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.sensor_net.alerts import Alerts
from zscout.behaviors.sensor_net.blindness import Blindness
from zscout.behaviors.sensor_net.held_robot import HeldRobot, RobotNeeds
from zscout.behaviors.sensor_net.sight import Look, Sight
from zscout.behaviors.tree import Behavior, Scene
from zscout.hiding.hider import Hider
from zscout.messages import Box
from zscout.scheduling.model import SECOND
from zscout.vision.garble import garbled
from zscout.vision.motion import MotionDetector

PATIENCE: Final = 10.0
"""Seconds from the beginning of a hold, or from the last picture, until the robot counts as not seen."""
LOOK: Final = 0.5
"""Seconds that one look waits for a picture."""
AGAIN: Final = 1.0
"""Seconds before it asks again after a refusal."""
GIVEN_UP: Final = 60.0
"""Seconds before a robot that was given up is tried again: its battery may have been changed."""


IDLE: Final = 0.1
"""Seconds from one safe point to the next while it waits."""


class Blind(Exception):
    """The robot that is held is not seen."""


@dataclass(frozen=True, slots=True)
class Slots:
    """How its ARCs are asked for: priorities, and seconds of the minimum runtimes."""

    hide_priority: int = 2
    watch_priority: int = 1
    hide: float = 30.0
    watch: float = 20.0


class PlaceRobot(Behavior):
    """Hides one robot and has it watch, for as long as it is let."""

    def __init__(self, name: str, needs: RobotNeeds, slots: Slots | None = None) -> None:
        super().__init__(name)
        self.needs, self.slots = needs, slots or Slots()
        self.hider = Hider()
        self.alerts = Alerts()
        self.blindness = Blindness(PATIENCE)
        self.add(Hide("hide", self))
        self.add(Watch("watch", self))
        self._clock = 0.0
        """Seconds of this behavior's own time, carried from host to host."""
        self._clock_at = 0
        self._holding = False
        self._interrupted = True
        """Whether somebody else may have had the robot since it was held last."""

    async def run(self, scene: Scene) -> None:
        self._clock_at = clock.now()
        idle = asyncio.create_task(self._idle(scene))
        try:
            await self._take_turns(scene)
        finally:
            idle.cancel()

    async def _take_turns(self, scene: Scene) -> None:
        hide, watch = self.children
        while True:
            task = watch if self.hider.state == "hidden" else hide
            try:
                await task.play(scene)
            except Blind as blind:
                self.say("lost" if self.blindness.dead else "wait", str(blind), robot=self.needs.robot)
                await asyncio.sleep((GIVEN_UP if self.blindness.dead else AGAIN) / scene.speed)
            except (Revoked, CommandRefused, RequestRefused) as error:
                self.say("wait", str(error), robot=self.needs.robot)
                await asyncio.sleep(AGAIN)

    async def _idle(self, scene: Scene) -> None:
        """While the robot is not held nothing changes here, however long that takes: a time to be moved."""
        while True:
            if not self._holding:
                await scene.safe_point()
            await asyncio.sleep(IDLE)

    def now(self, scene: Scene) -> float:
        """Seconds of the robot's world, as far as this behavior has lived in it."""
        at = clock.now()
        self._clock += (at - self._clock_at) / SECOND * scene.speed
        self._clock_at = at
        return self._clock

    async def hold(self, scene: Scene, task: RobotTask, name: str, priority: int, slot: float) -> None:
        """Asks for all that `task` needs and plays it under the hold, anew when that was taken away, until it
        is over or has had its slot. Raises Blind, and what a request raises."""
        video = self.blindness.choose(self.now(scene), await channels_of(scene.client))
        task.say("wait", "for its turn", robot=self.needs.robot)
        async for attempt in holds(
            scene.client,
            f"{self.name}-{name}",
            self.needs.needs(video=video),
            priority=priority,
            min_runtime=round(slot / scene.speed, 3),
            keep=True,
        ):
            async with attempt as held:
                await self._with(scene, task, held, video)

    async def _with(self, scene: Scene, task: RobotTask, held: Held, video: str | None) -> None:
        # Whoever waited for the hold may be about to be moved: nothing changes before that is over.
        await scene.safe_point()
        self._holding = True
        robot = HeldRobot(held, self.needs, video=video)
        now = self.now(scene)
        if self._interrupted:
            self._interrupted = False
            self.hider.resumed(now)
            self.blindness.begin(now)
        try:
            with Sight(scene.client, robot.framegrabber, held.grant) as sight:
                await robot.camera(True)
                while await self._look(scene, task, robot, await sight.look(LOOK / scene.speed)):
                    await scene.safe_point()
        except BaseException:
            self._stopped(scene)
            task.say("wait", "the hold is over", robot=self.needs.robot)
            raise
        self._stopped(scene)

    def _stopped(self, scene: Scene) -> None:
        self._holding = False
        self._interrupted = True
        self.hider.interrupted(self.now(scene))
        self.alerts.rest()

    async def _look(self, scene: Scene, task: RobotTask, robot: HeldRobot, look: Look | None) -> bool:
        """Does what one picture asks for, or none; whether the task goes on."""
        now = self.now(scene)
        picture = look.picture if look is not None else None
        good = picture is not None and not garbled(picture)
        if self.blindness.see(now, good, robot.video):
            raise Blind(f"no picture on {robot.video} for {PATIENCE:g} s")
        act = self.hider.see(now, picture)
        await robot.drive(act.left, act.right, act.lasts)
        return task.see(now, look if good else None, robot, act.doing, act.why)

    def memory(self) -> dict[str, Any]:
        return {
            "hider": base64.b64encode(self.hider.checkpoint()).decode(),
            "alerts": self.alerts.memory(),
            "blindness": self.blindness.memory(),
            "clock": self._clock,
            "interrupted": self._interrupted,
        }

    def recall(self, memory: dict[str, Any]) -> None:
        self.hider = Hider.restore(base64.b64decode(memory["hider"]))
        self.alerts.recall(memory["alerts"])
        self.blindness.recall(memory["blindness"])
        self._clock = float(memory["clock"])
        self._interrupted = bool(memory["interrupted"])


class RobotTask(Behavior):
    """What is done with a robot while it is held."""

    def __init__(self, name: str, of: PlaceRobot) -> None:
        super().__init__(name)
        self.of = of

    def see(self, now: float, look: Look | None, robot: HeldRobot, doing: str, why: str) -> bool:
        """Takes a good picture, or None; whether there is more to do."""
        raise NotImplementedError


class Hide(RobotTask):
    """Until the robot stands in the dark and faces the light."""

    async def run(self, scene: Scene) -> None:
        slots = self.of.slots
        await self.of.hold(scene, self, self.name, slots.hide_priority, slots.hide)

    def see(self, now: float, look: Look | None, robot: HeldRobot, doing: str, why: str) -> bool:
        self.say(doing, why, robot=robot.robot)
        return self.of.hider.state != "hidden"


class Watch(RobotTask):
    """For as long as it is let, or until the robot is not hidden any more."""

    async def run(self, scene: Scene) -> None:
        slots = self.of.slots
        # Each time anew: what the picture was before says nothing about how it is now.
        self.detector = MotionDetector()
        await self.of.hold(scene, self, self.name, slots.watch_priority, slots.watch)

    def see(self, now: float, look: Look | None, robot: HeldRobot, doing: str, why: str) -> bool:
        alerts = self.of.alerts
        if look is None:
            self.say("blind", "no good picture", robot=robot.robot)
            return True
        if self.of.hider.state != "hidden":
            return False
        seen = self.detector.see(now, look.picture)
        edge = alerts.see(now, seen.moving)
        if edge == "start":
            self.say(
                "alert",
                f"motion ({alerts.count})",
                robot=robot.robot,
                camera=robot.framegrabber,
                alert=True,
                boxes=_in_frame(look, seen.boxes),
            )
        elif alerts.moving and seen.boxes:
            boxes = _in_frame(look, seen.boxes)
            self.say("alert", self.detail, robot=robot.robot, camera=robot.framegrabber, boxes=boxes)
        elif not alerts.moving:
            camera = robot.framegrabber if edge == "end" else ""
            self.say("watch", f"{alerts.count} alerts", robot=robot.robot, camera=camera)
        return True


def _in_frame(look: Look, boxes: Sequence[Box]) -> list[Box]:
    """Boxes of the picture, in pixels of the frame."""
    across, down = look.scale
    return [(round(x * across), round(y * down), round(w * across), round(h * down)) for x, y, w, h in boxes]


async def channels_of(client: Client) -> list[str]:
    """The video channels of the fleet that are there, by name; none where no RCM answers."""
    state = await client.state()
    if state is None:
        return []
    return sorted(rc.rc for rc in state.rcs if rc.present and rc.rc.startswith("video/"))
