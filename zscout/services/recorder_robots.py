"""Robots as the recorder hears of them: pictures, behaviors, and who is where in a simulated building."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any, Final

from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Declared, Mesh
from zscout.messages import MAX_PLAN, BehaviorSaid, BuildingPlan, BuildingPoses, PlanAsk
from zscout.services.robot_story import RobotStory
from zscout.services.timeline import Timeline

log = logging.getLogger(__name__)

CAMERAS: Final = "framegrabber/"
"""RCs of this kind have pictures."""
MAX_CAMERAS: Final = 32
"""Whose pictures are asked for at one time."""
NO_PICTURE: Final = 3.0
"""Seconds without a picture after which it is said."""
TICK: Final = 0.25
PLAN_TIMEOUT: Final = 2.0
DEPTH: Final = 1_024
"""Publications of one kind that may wait here."""
MAX_SAID: Final = 8_192
MAX_POSES: Final = 65_536
"""Bytes."""


class RobotFollower:
    """Hears what a mesh tells of robots. `now` is the timeline's time; of each camera at most `frames`
    pictures a second are shown, and with 0 none are asked for: who looks at none costs the framegrabber none.
    """

    def __init__(self, mesh: Mesh, timeline: Timeline, now: Callable[[], float], frames: float) -> None:
        self.mesh, self.frames, self._now = mesh, frames, now
        self.story = RobotStory(timeline)
        self._cameras: dict[str, asyncio.Task[None]] = {}
        self._asking: asyncio.Task[None] | None = None

    def subscribe(self) -> list[Declared]:
        keys, subscribe = self.mesh.keys, self.mesh.subscribe
        return [
            subscribe(keys.behavior_any, BehaviorSaid, self._on_said, depth=DEPTH, limit=MAX_SAID),
            subscribe(keys.building_poses_any, BuildingPoses, self._on_poses, depth=DEPTH, limit=MAX_POSES),
        ]

    async def run(self) -> None:
        """Does what time brings, until it is cancelled."""
        try:
            while True:
                await asyncio.sleep(TICK)
                self.story.tick(self._now())
        finally:
            tasks = [*self._cameras.values(), *([self._asking] if self._asking is not None else [])]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def token(self, token: Token, alive: bool) -> None:
        """Something came to the mesh, or is gone from it, under all its instances."""
        if token.role == Role.CLIENT and not alive:
            self.story.left(self._now(), Sender(token.host, token.name))
        if token.role != Role.RC or not token.name.startswith(CAMERAS) or not self.frames:
            return
        if not alive:
            task = self._cameras.pop(token.name, None)
            if task is not None:
                task.cancel()
                self.story.no_frame(self._now(), token.name)
        elif token.name not in self._cameras and len(self._cameras) < MAX_CAMERAS:
            self._cameras[token.name] = _task(self._look(token.name))

    async def _look(self, camera: str) -> None:
        """Shows a camera's pictures: the newest there is, whenever the next one is due."""
        with self.mesh.frames(self.mesh.keys.frame(camera)) as watch:
            while True:
                frame = await watch.next(NO_PICTURE)
                if frame is None:
                    self.story.no_frame(self._now(), camera)
                    continue
                self.story.frame(self._now(), camera, frame.head, frame.jpeg)
                await asyncio.sleep(1 / self.frames)

    def _on_said(self, key: str, said: BehaviorSaid) -> None:
        self.story.said(self._now(), self.mesh.keys.sender_of(key), said)

    def _on_poses(self, key: str, poses: BuildingPoses) -> None:
        at = self._now()
        self.story.poses(at, self.mesh.keys.sender_of(key), poses)
        if self._asking is None or self._asking.done():
            sender = self.story.wants_plan(at)
            if sender is not None:
                self._asking = _task(self._ask(sender))

    async def _ask(self, sender: Sender) -> None:
        key = self.mesh.keys.building_plan(sender)
        replies = await self.mesh.ask(
            key, PlanAsk(), BuildingPlan, timeout=PLAN_TIMEOUT, enough=lambda _: True, limit=MAX_PLAN
        )
        for reply in replies:
            if reply.message is not None:
                self.story.plan(self._now(), sender, reply.message)


def _task(work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """In the background; what it fails of is logged, and costs no other anything."""

    async def guarded() -> None:
        try:
            await work
        except Exception:
            log.exception("what robots show is not recorded any more")

    return asyncio.get_running_loop().create_task(guarded())
