"""The placer's commands to nodes. What comes of each is an event of the core."""

from __future__ import annotations

from typing import Final, TypeVar

import msgspec

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
from zscout.placement.events import (
    ComponentsListed,
    HostCommand,
    MoveAnswered,
    MoveCommand,
    PlacerEvent,
    ProbeCommand,
    StartAnswered,
    StartCommand,
    StopAnswered,
    StopCommand,
)
from zscout.services.placement.convert import listed_of, message_of
from zscout.types import SECOND, ComponentId, HostName, Ns

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


class NodeClient:
    def __init__(self, mesh: Mesh, start_timeout: Ns) -> None:
        self.mesh, self._start_timeout = mesh, start_timeout / SECOND + ANSWER_SLACK

    async def carry_out(self, command: HostCommand) -> PlacerEvent | None:
        """None: a probe that was not answered."""
        match command:
            case StartCommand():
                return await self._start(command)
            case StopCommand():
                return await self._stop(command)
            case MoveCommand():
                return await self._move(command)
            case ProbeCommand(host, component):
                return await self.list_components(host, component)

    async def list_components(
        self, host: HostName, only: ComponentId | None = None
    ) -> ComponentsListed | None:
        """None: no answer."""
        reply = await self._ask(host, ListComponents(only), ComponentList, LIST_TIMEOUT)
        if reply is None or reply.message is None:
            return None
        return ComponentsListed(host, tuple(map(listed_of, reply.message.components)), only)

    async def _start(self, start: StartCommand) -> StartAnswered:
        component, incarnation, host = start.component, start.incarnation, start.host
        message = StartComponent(component, incarnation, message_of(start.spec), start.standby)
        reply = await self._ask(host, message, ComponentView, self._start_timeout)
        if reply is None:
            return StartAnswered(component, incarnation, host, "unknown", f"{host} did not answer")
        view = reply.message
        if view is None:
            code, words = (reply.problem.code, reply.problem.message) if reply.problem else ("unknown", "")
            again = code not in HOPELESS
            return StartAnswered(component, incarnation, host, "refused", words[:MAX_TAIL], again=again)
        if view.phase in ("running", "standby"):
            return StartAnswered(component, incarnation, host, "ok", movable=view.movable)
        if view.phase == "ended":
            return StartAnswered(component, incarnation, host, "failed", view.reason, view.tail[:MAX_TAIL])
        return StartAnswered(component, incarnation, host, "unknown", f"it is still {view.phase}")

    async def _stop(self, stop: StopCommand) -> StopAnswered:
        message = StopComponent(stop.component, stop.incarnation, GRACE)
        reply = await self._ask(stop.host, message, ComponentView, GRACE + ANSWER_SLACK)
        gone = reply is not None and reply.problem is not None and reply.problem.code == "unknown_component"
        ended = reply is not None and reply.message is not None and reply.message.phase == "ended"
        return StopAnswered(stop.component, stop.incarnation, stop.host, done=ended or gone)

    async def _move(self, move: MoveCommand) -> MoveAnswered:
        component, incarnation, host = move.component, move.incarnation, move.host
        message = MoveComponent(component, incarnation, move.to, move.to_incarnation, PATIENCE)
        reply = await self._ask(host, message, Moved, PATIENCE + self._start_timeout)
        if reply is None:
            return MoveAnswered(component, incarnation, host, "unknown", f"{host} did not answer")
        if reply.message is None:
            words = reply.problem.message if reply.problem is not None else ""
            return MoveAnswered(component, incarnation, host, "refused", words)
        dead = round(reply.message.dead * SECOND)
        return MoveAnswered(component, incarnation, host, "moved", dead=dead)

    async def _ask(
        self, host: HostName, message: msgspec.Struct, kind: type[R], timeout: float
    ) -> Reply[R] | None:
        return await self.mesh.ask_one(self.mesh.keys.component(host), message, kind, timeout=timeout)
