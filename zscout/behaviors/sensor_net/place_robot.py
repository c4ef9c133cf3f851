"""One robot of a sensor net: it hides in the dark, turns to the light and watches for motion.

Sensing and acting go through ARCs only. To hide, and to watch, it holds robot, radio, video channel and
framegrabber for a slot, and keeps them while nobody of its rank waits: with more robots than framegrabbers
they take turns. Hiding ranks above watching. What to do with what is seen is `Scout`'s to decide.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from zscout import clock
from zscout.behaviors.arc import Held, Revoked, holds
from zscout.behaviors.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.sensor_net.held_robot import HeldRobot, RobotNeeds
from zscout.behaviors.sensor_net.scout import PATIENCE, Scout, Task
from zscout.behaviors.sensor_net.sight import Look, Sight
from zscout.behaviors.tree import Behavior, Scene
from zscout.messages import Box
from zscout.scheduling.model import SECOND

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

    def of(self, task: Task) -> tuple[int, float]:
        """Priority and minimum runtime in seconds of a task's ARC."""
        return (self.watch_priority, self.watch) if task == "watch" else (self.hide_priority, self.hide)


class PlaceRobot(Behavior):
    """Hides one robot and has it watch, for as long as it is let."""

    def __init__(self, name: str, needs: RobotNeeds, slots: Slots | None = None) -> None:
        super().__init__(name)
        self.needs, self.slots = needs, slots or Slots()
        self.scout = Scout()
        self._tasks: dict[Task, RobotTask] = {
            "hide": RobotTask("hide", self),
            "watch": RobotTask("watch", self),
        }
        for task in self._tasks.values():
            self.add(task)
        self._clock = 0.0
        """Seconds of the robot's world that this behavior has lived; carried from host to host."""
        self._clock_at = 0
        self._holding = False

    async def run(self, scene: Scene) -> None:
        self._clock_at = clock.now()
        idle = asyncio.create_task(self._idle(scene))
        try:
            await self._take_turns(scene)
        finally:
            idle.cancel()

    async def _take_turns(self, scene: Scene) -> None:
        while True:
            try:
                await self._tasks[self.scout.task].play(scene)
            except Blind as blind:
                lost = self.scout.blindness.dead
                self.say("lost" if lost else "wait", str(blind), robot=self.needs.robot)
                await asyncio.sleep((GIVEN_UP if lost else AGAIN) / scene.speed)
            except (Revoked, CommandRefused, RequestRefused) as error:
                self.say("wait", str(error), robot=self.needs.robot)
                await asyncio.sleep(AGAIN)

    async def _idle(self, scene: Scene) -> None:
        """While the robot is not held nothing changes here, however long that takes: a time to be moved."""
        while True:
            if not self._holding:
                await scene.safe_point()
            await asyncio.sleep(IDLE)

    async def hold(self, scene: Scene, task: RobotTask) -> None:
        """Asks for all that `task` needs and plays it under the hold, anew when that was taken away, until it
        is over or has had its slot. Raises Blind, and what a request raises."""
        priority, slot = self.slots.of(task.task)
        video = self.scout.blindness.choose(self._now(scene), await channels_of(scene.client))
        task.say("wait", "for its turn", robot=self.needs.robot)
        async for attempt in holds(
            scene.client,
            f"{self.name}-{task.task}",
            self.needs.needs(video=video),
            priority=priority,
            min_runtime=round(slot / scene.speed, 3),
            keep=True,
        ):
            async with attempt as held:
                channel = held.rc(video or self.needs.video)
                # Whoever waited for the hold may be about to be moved: nothing changes before that is over.
                await scene.safe_point()
                await self._play(scene, task, held, video)
            if self.scout.silent and attempt.arc is not None and attempt.arc.open:
                # It was taken away because the receiver is dead: the same needs would be given the same one.
                await scene.client.end(attempt.arc)
                self.scout.silent = False
                raise Blind(f"{channel} shows nothing at all")

    async def _play(self, scene: Scene, task: RobotTask, held: Held, video: str | None) -> None:
        robot = HeldRobot(held, self.needs, video=video)
        self._holding = True
        self.scout.held(self._now(scene))
        try:
            with Sight(scene.client, robot.framegrabber, held.grant) as sight:
                await robot.camera(True)
                while await self._look(scene, task, robot, await sight.look(LOOK / scene.speed)):
                    await scene.safe_point()
                    await robot.camera(True, remind=self.scout.blindness.remind(self._now(scene)))
        finally:
            self.scout.released(self._now(scene))
            self._holding = False
            task.say("wait", "the hold is over", robot=self.needs.robot)

    async def _look(self, scene: Scene, task: RobotTask, robot: HeldRobot, look: Look | None) -> bool:
        """Does what one picture asks for, or none; whether the task goes on."""
        step = self.scout.see(self._now(scene), look.picture if look else None, robot.video)
        if step.blind:
            raise Blind(f"no picture on {robot.video} for {PATIENCE:g} s")
        await robot.drive(step.left, step.right, step.lasts)
        task.say(
            step.doing,
            step.detail,
            robot=robot.robot,
            camera=robot.framegrabber if step.boxes or step.quiet else "",
            alert=step.alert,
            boxes=_in_frame(look, step.boxes),
        )
        return not step.over

    def _now(self, scene: Scene) -> float:
        at = clock.now()
        self._clock += (at - self._clock_at) / SECOND * scene.speed
        self._clock_at = at
        return self._clock

    def memory(self) -> dict[str, Any]:
        return {"scout": self.scout.memory(), "clock": self._clock}

    def recall(self, memory: dict[str, Any]) -> None:
        self.scout.recall(memory["scout"])
        self._clock = float(memory["clock"])


class RobotTask(Behavior):
    """What is done with a robot under one kind of ARC."""

    def __init__(self, task: Task, of: PlaceRobot) -> None:
        super().__init__(task)
        self.task, self.of = task, of

    async def run(self, scene: Scene) -> None:
        await self.of.hold(scene, self)


def _in_frame(look: Look | None, boxes: Sequence[Box]) -> list[Box]:
    """Boxes of the picture, in pixels of the frame."""
    across, down = look.scale if look is not None else (1.0, 1.0)
    return [(round(x * across), round(y * down), round(w * across), round(h * down)) for x, y, w, h in boxes]


async def channels_of(client: Client) -> list[str]:
    """The video channels of the fleet that are there, by name; none where no RCM answers."""
    state = await client.state()
    if state is None:
        return []
    return sorted(rc.rc for rc in state.rcs if rc.present and rc.rc.startswith("video/"))
