"""What the placer asks of nodes, and how their answers become events of its core."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any, Final, TypeVar

import msgspec

from zscout.config import Fleet
from zscout.mesh import Mesh, Reply
from zscout.messages import (
    MAX_TAIL,
    ComponentList,
    ComponentView,
    ListComponents,
    MoveComponent,
    Moved,
    StartComponent,
    StopComponent,
)
from zscout.placing.events import (
    Event,
    HostTold,
    Look,
    Move,
    MoveAnswered,
    Start,
    StartAnswered,
    Stop,
    StopAnswered,
)
from zscout.scheduling.model import SECOND
from zscout.services.placements import seen, spec_told

log = logging.getLogger("zscout.placer")

R = TypeVar("R")

LIST_TIMEOUT: Final = 1.0
ANSWER_SLACK: Final = 2.0
"""Seconds beyond what a node may take for a start, a stop or a move."""
GRACE: Final = 5.0
"""Seconds that a component gets to end by itself."""
PATIENCE: Final = 5.0
"""Seconds that a component gets to come to a safe point."""
HOPELESS: Final = frozenset({"unknown_kind", "not_allowed", "bad_request"})
"""Refusals of a node that another try there would not change."""


class Errands:
    """Questions to nodes that are out. `feed` takes what comes of them."""

    def __init__(self, mesh: Mesh, fleet: Fleet, feed: Callable[[Event], object]) -> None:
        self.mesh, self.fleet, self._feed = mesh, fleet, feed
        self._tasks: set[asyncio.Task[None]] = set()

    def stop(self) -> None:
        for task in list(self._tasks):
            task.cancel()

    def run(self, errand: Start | Stop | Move | Look) -> None:
        match errand:
            case Start():
                self.spawn(self._start(errand))
            case Stop():
                self.spawn(self._stop(errand))
            case Move():
                self.spawn(self._move(errand))
            case Look():
                self.spawn(self._look(errand))

    async def everything(self, host: str) -> bool:
        """Asks a host for all its components. False: no answer."""
        reply = await self._ask(host, ListComponents(), ComponentList, LIST_TIMEOUT)
        if reply is None or reply.message is None:
            return False
        self._feed(HostTold(host, tuple(map(seen, reply.message.components))))
        return True

    async def _start(self, start: Start) -> None:
        message = StartComponent(start.component, start.incarnation, spec_told(start.spec), start.standby)
        timeout = self.fleet.rules.start_timeout / SECOND + ANSWER_SLACK
        reply = await self._ask(start.host, message, ComponentView, timeout)

        def answered(result: Any, reason: str = "", **more: Any) -> None:
            self._feed(StartAnswered(start.component, start.incarnation, start.host, result, reason, **more))

        if reply is None:
            answered("unknown", f"{start.host} did not answer")
        elif reply.message is None:
            code = reply.problem.code if reply.problem is not None else "unknown"
            words = reply.problem.message if reply.problem is not None else ""
            answered("refused", words[:MAX_TAIL], again=code not in HOPELESS)
        elif reply.message.phase in ("running", "standby"):
            answered("ok", movable=reply.message.movable)
        elif reply.message.phase == "ended":
            answered("failed", reply.message.reason, tail=reply.message.tail[:MAX_TAIL])
        else:
            answered("unknown", f"it is still {reply.message.phase}")

    async def _stop(self, stop: Stop) -> None:
        message = StopComponent(stop.component, stop.incarnation, GRACE)
        reply = await self._ask(stop.host, message, ComponentView, GRACE + ANSWER_SLACK)
        gone = reply is not None and reply.problem is not None and reply.problem.code == "unknown_component"
        ended = reply is not None and reply.message is not None and reply.message.phase == "ended"
        self._feed(StopAnswered(stop.component, stop.incarnation, stop.host, done=ended or gone))

    async def _move(self, move: Move) -> None:
        message = MoveComponent(move.component, move.incarnation, move.to, move.to_incarnation, PATIENCE)
        timeout = PATIENCE + self.fleet.rules.start_timeout / SECOND + ANSWER_SLACK
        reply = await self._ask(move.host, message, Moved, timeout)

        def answered(result: Any, reason: str = "", dead: float = 0.0) -> None:
            ns = round(dead * SECOND)
            self._feed(MoveAnswered(move.component, move.incarnation, move.host, result, reason, ns))

        if reply is None:
            answered("unknown", f"{move.host} did not answer")
        elif reply.message is None:
            answered("refused", reply.problem.message if reply.problem is not None else "")
        else:
            answered("moved", dead=reply.message.dead)

    async def _look(self, look: Look) -> None:
        reply = await self._ask(look.host, ListComponents(look.component), ComponentList, LIST_TIMEOUT)
        if reply is not None and reply.message is not None:
            told = tuple(map(seen, reply.message.components))
            self._feed(HostTold(look.host, told, only=look.component))

    async def _ask(
        self, host: str, message: msgspec.Struct, kind: type[R], timeout: float
    ) -> Reply[R] | None:
        return await self.mesh.ask_one(self.mesh.keys.component(host), message, kind, timeout=timeout)

    def spawn(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("a question to a node failed", exc_info=error)
