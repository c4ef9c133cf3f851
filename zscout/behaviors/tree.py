"""Behaviors that form a tree: what they are called, what they tell, and what they remember.

    class Greet(Behavior):
        async def run(self, scene):
            self.say("greeting", "the robot")
            await scene.safe_point()

    root = Greet("hall")
    root.add(Greet("door"))           # its path is hall/door
    await root.run(scene)

A behavior runs its children as it likes: one after the other, or side by side with `side_by_side`, where one
that fails does not stop the others. What any of them says goes out under its path, so that people see the
tree; what each of them remembers is checkpointed with the whole tree.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from zscout.behaviors.client import Client
from zscout.keyexpr import check_name
from zscout.messages import Box

MAX_DEPTH: Final = 8
MAX_CHILDREN: Final = 64


@dataclass(frozen=True, slots=True)
class Saying:
    """What a behavior said; `doing` is empty when it has ended."""

    path: str
    doing: str
    detail: str = ""
    robot: str = ""
    camera: str = ""
    alert: bool = False
    boxes: tuple[Box, ...] = ()


class Scene:
    """What a tree of behaviors runs on."""

    def __init__(
        self,
        client: Client,
        safe_point: Callable[[], Awaitable[None]],
        voice: Callable[[Saying], None],
        *,
        speed: float = 1.0,
        name: str = "",
    ) -> None:
        self.client = client
        self.safe_point = safe_point
        """Await it wherever the state of the whole tree is sound: the tree may be moved to another host."""
        self.voice = voice
        self.name = name
        """Of the component that the tree runs as, if it is one."""
        self.speed = speed
        """How many seconds of the robots' world pass in one of ours: 1, but for a simulated one."""


class Behavior:
    """A node of the tree. Subclasses write `run`, and with `memory` and `recall` what outlives a move."""

    def __init__(self, name: str) -> None:
        """Raises BadName for what can't stand in a path."""
        self.name = check_name(name, "behavior")
        self.parent: Behavior | None = None
        self.above = ""
        """Of a root: the path of its parent, which lives in another process."""
        self.children: list[Behavior] = []
        self.doing = ""
        self.detail = ""
        self._voice: Callable[[Saying], None] | None = None

    def add(self, child: Behavior) -> None:
        """Puts `child` under this one. Raises ValueError for a name that is there, or a tree too large."""
        if any(other.name == child.name for other in self.children):
            raise ValueError(f"{self.path} has a behavior {child.name} already")
        if len(self.children) >= MAX_CHILDREN or self.depth >= MAX_DEPTH:
            raise ValueError(f"{self.path} may have {MAX_CHILDREN} behaviors, {MAX_DEPTH} deep")
        child.parent = self
        self.children.append(child)

    @property
    def depth(self) -> int:
        return 1 if self.parent is None else 1 + self.parent.depth

    @property
    def path(self) -> str:
        above = self.above if self.parent is None else self.parent.path
        return f"{above}/{self.name}" if above else self.name

    def walk(self) -> Iterator[Behavior]:
        """This behavior and all below it."""
        yield self
        for child in self.children:
            yield from child.walk()

    async def run(self, scene: Scene) -> None:
        """Does its work. To raise is to fail; cancelled when it is to end."""
        raise NotImplementedError(f"{type(self).__name__} has no run(); write one")

    async def play(self, scene: Scene) -> None:
        """`run`, with its voice: call this for a child, and for the root."""
        self._voice = scene.voice
        try:
            await self.run(scene)
        finally:
            self.say("")

    async def side_by_side(self, scene: Scene, children: Iterable[Behavior]) -> list[BaseException]:
        """Plays `children` at once and returns the failures; one that fails leaves the others running."""
        results = await asyncio.gather(*(child.play(scene) for child in children), return_exceptions=True)
        return [result for result in results if isinstance(result, BaseException)]

    def say(
        self,
        doing: str,
        detail: str = "",
        *,
        robot: str = "",
        camera: str = "",
        alert: bool = False,
        boxes: Sequence[Box] = (),
    ) -> None:
        """Tells what it does from now on. The same said again is told once, but for alerts and boxes."""
        if (doing, detail) == (self.doing, self.detail) and not alert and not camera:
            return
        self.doing, self.detail = doing, detail
        if self._voice is not None:
            self._voice(Saying(self.path, doing, detail, robot, camera, alert, tuple(boxes)))

    # What outlives a move

    def memory(self) -> dict[str, Any]:
        """What this one remembers, as JSON can carry it; without its children's."""
        return {}

    def recall(self, memory: dict[str, Any]) -> None:
        """Takes in what `memory` gave. Raises ValueError for what it can't use."""

    def checkpoint(self) -> dict[str, Any]:
        """The memories of the whole tree."""
        return {"own": self.memory(), "children": {child.name: child.checkpoint() for child in self.children}}

    def restore(self, state: dict[str, Any]) -> None:
        """Takes in what `checkpoint` gave. Children that are not there are passed over."""
        self.recall(state.get("own", {}))
        known = state.get("children", {})
        for child in self.children:
            if child.name in known:
                child.restore(known[child.name])
