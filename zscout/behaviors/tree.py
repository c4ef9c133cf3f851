"""Trees of behaviors: their names, status and memory, which survives a move.

    class Greet(Behavior):
        async def run(self, context):
            self.report("greeting", "the robot")
            await context.safe_point()

    root = Greet("hall")
    root.add(Greet("door"))           # its path is hall/door
    await root.perform(context)

Each behavior decides when to perform its children. The status that a behavior reports is published under its path, so
that people see the tree; the memory of each is checkpointed with the whole tree.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from msgspec.structs import replace

from zscout.behaviors.client.client import Client
from zscout.keyexpr import check_name
from zscout.messages import MAX_BOXES, MAX_DETAIL, BehaviorSaid, Box
from zscout.types import SECOND, Ns

MAX_DEPTH: Final = 8
MAX_CHILDREN: Final = 64
MAX_RATE: Final = 20
"""Most publications of a client per second; alerts and ends are always published."""
REPUBLISH_EVERY: Final = 5.0
"""Seconds after which the status of every behavior that has not ended is published again."""
MAX_PATH: Final = 200
MAX_WORD: Final = 64


@dataclass(frozen=True, slots=True)
class BehaviorContext:
    client: Client
    safe_point: Callable[[], Awaitable[None]]
    """Await it wherever the state of the whole tree is consistent: the tree may then move to another host."""
    publish: Callable[[BehaviorSaid], None]
    speed: float = 1.0
    """Seconds of the robots' world per real second: 1, except in a simulation."""
    name: str = ""
    """Name of the component that runs the tree, if any."""


class Behavior:
    """A node of the tree. Subclasses define `run`, and `memory` and `recall` for state that survives a move."""

    def __init__(self, name: str) -> None:
        """Raises BadName if `name` can't be part of a path."""
        self.name = check_name(name, "behavior")
        self.parent: Behavior | None = None
        self.above = ""
        """For a root: path of its parent in another process."""
        self.children: list[Behavior] = []
        self.doing = ""
        self.detail = ""
        self._publish_status: Callable[[BehaviorSaid], None] | None = None

    def add(self, child: Behavior) -> None:
        """Add a child. Raises ValueError for a duplicate name, or a tree too large."""
        if any(other.name == child.name for other in self.children):
            raise ValueError(f"{self.path} already has a behavior {child.name}")
        if len(self.children) >= MAX_CHILDREN or self.depth >= MAX_DEPTH:
            raise ValueError(f"{self.path} may have at most {MAX_CHILDREN} behaviors, {MAX_DEPTH} levels deep")
        child.parent = self
        self.children.append(child)

    @property
    def depth(self) -> int:
        return 1 if self.parent is None else 1 + self.parent.depth

    @property
    def path(self) -> str:
        above = self.above if self.parent is None else self.parent.path
        return f"{above}/{self.name}" if above else self.name

    async def run(self, context: BehaviorContext) -> None:
        """Do the work until cancelled; any error fails the behavior."""
        raise NotImplementedError(f"{type(self).__name__} has no run(); write one")

    async def perform(self, context: BehaviorContext) -> None:
        """Run the behavior and publish its status. Call this, not `run`, for children and the root."""
        self._publish_status = context.publish
        try:
            await self.run(context)
        finally:
            self.report("")

    def report(
        self,
        doing: str,
        detail: str = "",
        *,
        robot: str = "",
        camera: str = "",
        alert: bool = False,
        boxes: Sequence[Box] = (),
    ) -> None:
        """Publish a new status. A repeated status is left out, unless it has an alert or a camera."""
        if (doing, detail) == (self.doing, self.detail) and not alert and not camera:
            return
        self.doing, self.detail = doing, detail
        if self._publish_status is not None:
            self._publish_status(BehaviorSaid(self.path, doing, detail, robot, camera, alert, list(boxes)))

    def memory(self) -> dict[str, Any]:
        """Return this behavior's state for JSON, without its children's."""
        return {}

    def recall(self, memory: dict[str, Any]) -> None:
        """Restore the state that `memory` returned. Raises ValueError if it is invalid."""

    def checkpoint(self) -> dict[str, Any]:
        return {"own": self.memory(), "children": {child.name: child.checkpoint() for child in self.children}}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the state that `checkpoint` returned; state of missing children is ignored."""
        self.recall(state.get("own", {}))
        known = state.get("children", {})
        for child in self.children:
            if child.name in known:
                child.restore(known[child.name])


class CarriedClock:
    """Seconds that a behavior has lived, carried along in moves, as the clocks of hosts differ."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._read_at: Ns | None = None

    def read(self, at: Ns, speed: float = 1.0) -> float:
        """Return the seconds lived until `at` on this host's clock; since the last reading, times `speed`."""
        if self._read_at is not None:
            self.seconds += (at - self._read_at) / SECOND * speed
        self._read_at = at
        return self.seconds


class StatusPublisher:
    """Publishes the status of a client's behaviors, at most MAX_RATE per second. Call it with each status."""

    def __init__(self, client: Client) -> None:
        keys, me, self._now = client.mesh.keys, client.mesh.me, client.mesh.now
        self._publisher = client.mesh.publisher(keys.behavior(me), BehaviorSaid)
        self._published: deque[Ns] = deque(maxlen=MAX_RATE)
        self._current: dict[str, BehaviorSaid] = {}

    def __call__(self, status: BehaviorSaid) -> None:
        status = replace(
            status,
            path=status.path[:MAX_PATH],
            doing=status.doing[:MAX_WORD],
            detail=status.detail[:MAX_DETAIL],
            robot=status.robot[:MAX_WORD],
            camera=status.camera[:MAX_WORD],
            boxes=status.boxes[:MAX_BOXES],
        )
        if status.doing:
            self._current[status.path] = replace(status, alert=False, boxes=[], camera="")
        else:
            self._current.pop(status.path, None)
        now = self._now()
        crowded = len(self._published) == MAX_RATE and now - self._published[0] < SECOND
        # A status withheld now is published by `keep_publishing`, unless a newer one replaces it.
        if not crowded or not status.doing or status.alert:
            self._published.append(now)
            self._publisher.put(status)

    async def keep_publishing(self) -> None:
        """Publish the status of each behavior regularly, for new subscribers."""
        while True:
            await asyncio.sleep(REPUBLISH_EVERY)
            for status in list(self._current.values()):
                self._publisher.put(status)

    def close(self) -> None:
        self._publisher.close()
