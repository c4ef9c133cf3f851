"""One robot of a sensor net: it hides in the dark, turns to the light and watches for motion.

Sensing and acting use ARCs only. To hide, and to watch, it holds robot, radio, video channel and framegrabber for a
slot, and keeps them until another request of its rank waits: with more robots than framegrabbers they take turns.
Hiding ranks above watching. Just before its turn to watch, a robot's camera warms up if a channel is free: a third ARC,
below all others, without a framegrabber. `Scout` decides what to do with the pictures."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing, suppress
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np

from zscout.behaviors.client.arc import Held, Revoked, hold, holds
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.client.request import OpenArc
from zscout.behaviors.perception.lens import COLUMNS, ROWS, grey_picture
from zscout.behaviors.sensor_net.held_robot import HeldRobot, RobotNeeds
from zscout.behaviors.sensor_net.scout import NO_PICTURE_TIMEOUT, Scout, Task
from zscout.behaviors.tree import Behavior, BehaviorContext, CarriedClock
from zscout.keyexpr import MAX_NAME, matcher
from zscout.mesh import FrameWatch
from zscout.mesh.supervision import Supervisor, done_within, supervised
from zscout.types import SECOND

LOOK: Final = 0.5  # seconds to wait for a picture
RETRY_AFTER: Final = 1.0  # seconds before a retry after a refusal
GIVEN_UP: Final = 60.0  # seconds before a robot that was given up is tried again: its battery may have been changed
WARM_AHEAD: Final = 4.0  # seconds of warm-up before the expected turn: it takes two, and turns may begin early
WARM_SLACK: Final = 4.0  # further seconds until the turn at which the camera is switched off again
SOONER: Final = 0.9  # share of its slot requested by a robot that recently saw motion
BRIEF: Final = 0.1  # seconds of minimum runtime of the warm-up: others may take the channel
IDLE: Final = 0.1  # seconds between safe points while waiting


class CameraBlind(Exception): ...


@dataclass(frozen=True, slots=True)
class Slots:
    """Minimum runtimes are in seconds."""

    hide_priority: int = 2
    watch_priority: int = 1
    hide: float = 60.0
    watch: float = 30.0

    def of(self, task: Task, *, sooner: bool = False) -> tuple[int, float]:
        """Priority and minimum runtime (s) of a task's ARC. `sooner`: a little shorter, to be granted first."""
        if task == "hide":
            return self.hide_priority, self.hide
        return self.watch_priority, self.watch * (SOONER if sooner else 1)

    @property
    def warm_priority(self) -> int:
        """Below all other ARCs of its own robots."""
        return min(self.watch_priority, self.hide_priority) - 1


class PlaceRobot(Behavior):
    def __init__(self, name: str, needs: RobotNeeds, slots: Slots | None = None) -> None:
        super().__init__(name)
        self.needs, self.slots = needs, slots or Slots()
        self.scout = Scout()
        self._tasks = {"hide": RobotTask("hide", self), "watch": RobotTask("watch", self)}
        for task in self._tasks.values():
            self.add(task)
        self._clock = CarriedClock()
        self.holding = ""  # id of the ARC that holds its robot, or empty
        self.video: str | None = None  # the channel that its present ARC requests by name
        self.came: tuple[str, str | None] | None = None  # both from before a move, until requested

    async def run(self, context: BehaviorContext) -> None:
        self.now(context)
        async with supervised(self.path) as supervisor:
            supervisor.spawn(self._offer_safe_points(context))
            while True:
                try:
                    await self._tasks[self.scout.task].perform(context)
                except CameraBlind as blind:
                    lost = self.scout.blindness.dead
                    self.report("lost" if lost else "wait", str(blind), robot=self.needs.robot)
                    await asyncio.sleep((GIVEN_UP if lost else RETRY_AFTER) / context.speed)
                except (Revoked, CommandRefused, RequestRefused) as error:
                    self.report("wait", str(error), robot=self.needs.robot)
                    await asyncio.sleep(RETRY_AFTER)
                finally:
                    self.video = None

    async def _offer_safe_points(self, context: BehaviorContext) -> None:
        """Offer safe points for moves while it waits for a hold: nothing changes then."""
        while True:
            if not self.holding:
                await context.safe_point()
            await asyncio.sleep(IDLE)

    def now(self, context: BehaviorContext) -> float:
        return self._clock.read(context.client.mesh.now(), context.speed)

    def memory(self) -> dict[str, Any]:
        asked = {"holding": self.holding, "video": self.video}
        return {"scout": self.scout.memory(), "clock": self._clock.seconds, "asked": asked}

    def recall(self, memory: dict[str, Any]) -> None:
        self.scout.recall(memory["scout"])
        self._clock.seconds = float(memory["clock"])
        if (asked := memory.get("asked")) is not None:
            self.came = str(asked["holding"]), asked["video"] and str(asked["video"])


class RobotTask(Behavior):
    def __init__(self, task: Task, place: PlaceRobot) -> None:
        super().__init__(task)
        self.task, self.place = task, place

    async def run(self, context: BehaviorContext) -> None:
        """Work under the hold, again after each revocation. Raises CameraBlind, and request errors."""
        place, scout = self.place, self.place.scout
        priority, slot = place.slots.of(self.task, sooner=scout.saw_somebody)
        came, place.came = place.came, None
        # A hold that was handed over is found by its needs.
        video = place.video = (came and came[1]) or await self._channel(context)
        self.report("wait", "for its turn", robot=place.needs.robot)
        needs = place.needs.needs(video=video)
        seconds = round(slot / context.speed, 3)
        warm = _arc_name(place.name, "warm") if self.task == "watch" else ""
        async for attempt in holds(
            context.client,
            _arc_name(place.name, self.task),
            needs,
            priority=priority,
            min_runtime=seconds,
            keep=True,
            estimate=bool(warm),
            continues=warm,
        ):
            turn = await attempt.asked()
            goes_on, came = came is not None and turn.id == came[0] and turn.grant is not None, None
            async with self._warming(context, warm, turn) as warming, attempt as held:
                # A warm-up now would start after the hold.
                warming.cancel()
                channel = held.rc(video or place.needs.video)
                # If a move is due, it must come before any change.
                await context.safe_point()
                await self._use(context, held, video, goes_on=goes_on)
            if held.completed:
                break
            if scout.task != self.task:
                # Revoked in the very step that was its last.
                await context.client.end(turn)
                break
            if scout.no_signal and attempt.arc is not None and attempt.arc.open:
                # Revoked because the receiver is dead: the same needs would bring it back.
                await context.client.end(attempt.arc)
                scout.no_signal = False
                raise CameraBlind(f"{channel} receives no picture")

    async def _channel(self, context: BehaviorContext) -> str | None:
        """A channel to request by name, to avoid others."""
        place, state = self.place, await context.client.state()
        may = matcher(place.needs.video)
        channels = [rc.rc for rc in state.rcs if rc.present and may(rc.rc)] if state is not None else []
        return place.scout.blindness.choose(place.now(context), channels)

    @asynccontextmanager
    async def _warming(self, context: BehaviorContext, name: str, turn: OpenArc) -> AsyncIterator[Supervisor]:
        """While `turn` waits, warm its camera up under an ARC of this `name`, if any, until cancelled."""
        async with supervised(self.path) as supervisor:
            if name:
                supervisor.spawn(self._warm_up(context, name, turn))
            yield supervisor

    async def _warm_up(self, context: BehaviorContext, name: str, turn: OpenArc) -> None:
        client, place = context.client, self.place
        needs = {need: params for need, params in turn.needs.items() if need != place.needs.framegrabber}
        priority = place.slots.warm_priority
        ahead, slack = WARM_AHEAD / context.speed, WARM_SLACK / context.speed
        while turn.open and turn.grant is None:
            left = _left(client, turn, slack) - ahead
            if left > 0:
                await done_within(left if math.isfinite(left) else None, client.changed(turn))
                continue
            with suppress(Revoked, RequestRefused, CommandRefused):
                async with hold(client, name, needs, priority=priority, min_runtime=BRIEF) as held:
                    await held.command(place.needs.robot, {"name": "camera", "on": True})
                    if await _begins(client, turn, ahead + slack, slack):
                        # The turn continues this hold, which ends by that.
                        await held.over()
                    # A hold handed over may come back: then give it back.
                    await held.resumed()
            await asyncio.sleep(RETRY_AFTER)

    async def _use(self, context: BehaviorContext, held: Held, video: str | None, *, goes_on: bool) -> None:
        place, scout = self.place, self.place.scout
        robot = HeldRobot(held, place.needs, video=video)
        place.holding = held.arc.id
        scout.held(place.now(context), goes_on=goes_on)
        mesh = context.client.mesh
        try:
            with closing(mesh.frames(mesh.keys.frame(robot.framegrabber))) as watch:
                await robot.camera(True)
                while await self._look(context, robot, watch):
                    await context.safe_point()
                    await robot.camera(True, remind=scout.blindness.remind(place.now(context)))
        finally:
            scout.released(place.now(context))
            place.holding = ""
            self.report("wait", "the hold is over", robot=place.needs.robot)

    async def _look(self, context: BehaviorContext, robot: HeldRobot, watch: FrameWatch) -> bool:
        """Wait for a picture, if any, and act on it; return True if the task continues."""
        frame = await watch.next(LOOK / context.speed)
        # A frame taken under another grant shows another robot.
        picture = grey_picture(frame.jpeg) if frame and frame.head.grant == robot.held.grant else None
        across = down = 1.0
        if picture is not None and picture.shape != (ROWS, COLUMNS):
            across, down = picture.shape[1] / COLUMNS, picture.shape[0] / ROWS
            picture = np.asarray(cv2.resize(picture, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA), np.uint8)
        if frame and picture is not None:
            self.place.scout.limit(frame.head.motion)
        self.place.scout.frozen = frame.head.frozen if frame and picture is not None else 0.0
        step = self.place.scout.see(self.place.now(context), picture, robot.video)
        if step.blind:
            raise CameraBlind(f"no picture on {robot.video} for {NO_PICTURE_TIMEOUT:g} s")
        await robot.drive(step.left, step.right, step.lasts)
        camera = robot.framegrabber if step.boxes or step.quiet else ""
        boxes = [(round(x * across), round(y * down), round(w * across), round(h * down)) for x, y, w, h in step.boxes]
        self.report(step.doing, step.detail, robot=robot.robot, camera=camera, alert=step.alert, boxes=boxes)
        return not step.over


def _arc_name(robot: str, task: str) -> str:
    """Robot names may be as long as ARC names; cut ones need not differ."""
    return f"{robot[: MAX_NAME - 1 - len(task)]}-{task}"


def _left(client: Client, turn: OpenArc, slack: float) -> float:
    """Seconds until the last estimated start; infinite without one, or if it is overdue by more than `slack`: estimates
    are never withdrawn."""
    if turn.start is None:
        return math.inf
    left = (turn.start - client.mesh.now()) / SECOND
    return left if left > -slack else math.inf


async def _begins(client: Client, turn: OpenArc, within: float, slack: float) -> bool:
    """Wait while the turn is expected within `within` seconds; return True if it begins."""
    while turn.open and turn.grant is None:
        left = _left(client, turn, slack)
        if left > within:
            return False
        await done_within(left + slack, client.changed(turn))
    return turn.open
