"""What the mesh publishes of robots, for the recorder: pictures, behaviors, and who is where in a
building."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Declaration, Mesh, Supervisor
from zscout.messages import MAX_PLAN, BehaviorSaid, BuildingPlan, BuildingPoses, PlanAsk
from zscout.services.recorder.robot_tracker import RobotTracker
from zscout.services.recorder.timeline import Timeline

CAMERAS: Final = "framegrabber/"
"""RCs of this kind have pictures."""
MAX_CAMERAS: Final = 32
"""Whose pictures are subscribed to at one time."""
NO_PICTURE: Final = 3.0
"""Seconds without a picture after which that is shown."""
TICK: Final = 0.25
PLAN_TIMEOUT: Final = 2.0
DEPTH: Final = 1_024
"""Publications of one kind that may wait here."""
MAX_REPORT: Final = 8_192
MAX_POSES: Final = 65_536
"""Bytes."""


class RobotFollower:
    """Subscribes to all that is published of robots. `now` is the timeline's time; of each camera at most
    `frames` pictures a second are shown, and with 0 none are subscribed to: then the framegrabber sends none.
    """

    def __init__(
        self, mesh: Mesh, timeline: Timeline, now: Callable[[], float], frames: float, supervisor: Supervisor
    ) -> None:
        self.mesh, self.frames, self._now = mesh, frames, now
        self._supervisor = supervisor
        self.tracker = RobotTracker(timeline)
        self._cameras: dict[str, asyncio.Task[None]] = {}
        self._asking: asyncio.Task[None] | None = None

    def subscribe(self) -> list[Declaration]:
        keys, subscribe, guard = self.mesh.keys, self.mesh.subscribe, self._supervisor.guard
        behavior, poses = guard(self._on_behavior), guard(self._on_poses)
        return [
            subscribe(keys.behavior_any, BehaviorSaid, behavior, depth=DEPTH, limit=MAX_REPORT),
            subscribe(keys.building_poses_any, BuildingPoses, poses, depth=DEPTH, limit=MAX_POSES),
        ]

    async def tick(self) -> None:
        """Does what time brings, until it is cancelled."""
        while True:
            await asyncio.sleep(TICK)
            self.tracker.tick(self._now())

    def token(self, token: Token, alive: bool) -> None:
        """Something came to the mesh, or is gone from it, under all its instances."""
        if token.role == Role.CLIENT and not alive:
            self.tracker.left(self._now(), Sender(token.host, token.name))
        if token.role != Role.RC or not token.name.startswith(CAMERAS) or not self.frames:
            return
        if not alive:
            task = self._cameras.pop(token.name, None)
            if task is not None:
                task.cancel()
                self.tracker.no_frame(self._now(), token.name)
        elif token.name not in self._cameras and len(self._cameras) < MAX_CAMERAS:
            self._cameras[token.name] = self._supervisor.spawn(self._look(token.name))

    async def _look(self, camera: str) -> None:
        """Shows a camera's pictures: the newest there is, whenever the next one is due."""
        with self.mesh.frames(self.mesh.keys.frame(camera)) as watch:
            while True:
                frame = await watch.next(NO_PICTURE)
                if frame is None:
                    self.tracker.no_frame(self._now(), camera)
                    continue
                self.tracker.frame(self._now(), camera, frame.head, frame.jpeg)
                await asyncio.sleep(1 / self.frames)

    def _on_behavior(self, key: str, report: BehaviorSaid) -> None:
        self.tracker.behavior(self._now(), self.mesh.keys.sender_of(key), report)

    def _on_poses(self, key: str, poses: BuildingPoses) -> None:
        at = self._now()
        self.tracker.poses(at, self.mesh.keys.sender_of(key), poses)
        if self._asking is None or self._asking.done():
            sender = self.tracker.wants_plan(at)
            if sender is not None:
                self._asking = self._supervisor.spawn(self._ask(sender))

    async def _ask(self, sender: Sender) -> None:
        key = self.mesh.keys.building_plan(sender)
        replies = await self.mesh.ask(
            key, PlanAsk(), BuildingPlan, timeout=PLAN_TIMEOUT, enough=lambda _: True, limit=MAX_PLAN
        )
        for reply in replies:
            if reply.message is not None:
                self.tracker.plan(self._now(), sender, reply.message)
