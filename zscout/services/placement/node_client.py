"""The placer's commands to nodes; the results are events of the core."""

from __future__ import annotations

from functools import partial
from typing import Final, TypeVar

import msgspec

from zscout import messages
from zscout.config.node import MAX_KINDS
from zscout.mesh import Mesh, Reply
from zscout.mesh.exchange import naming_versions
from zscout.placement import events
from zscout.types import SECOND, HostName, Ns

R = TypeVar("R")

LIST_TIMEOUT: Final = 1.0
ANSWER_SLACK: Final = 2.0  # seconds beyond a node's time for a start, stop or move
HOPELESS: Final = frozenset({"unknown_kind", "not_allowed", "bad_request"})
"""Refusals that a retry on the same node would not change."""


class NodeClient:
    def __init__(self, mesh: Mesh, start_timeout: Ns) -> None:
        self.mesh, self._start_timeout = mesh, start_timeout / SECOND + ANSWER_SLACK

    async def carry_out(self, command: events.HostCommand) -> events.PlacerEvent | None:
        """Carry out a command; return its result, None for a list without an answer."""
        match command.operation:
            case messages.StartComponent() as start:
                return await self._start(command.host, start)
            case messages.StopComponent() as stop:
                return await self._stop(command.host, stop)
            case messages.MoveComponent() as move:
                return await self._move(command.host, move)
            case messages.ListComponents() as listing:
                reply = await self._ask(command.host, listing, messages.ComponentList, LIST_TIMEOUT)
                if reply is None or reply.message is None:
                    return None
                listed = reply.message.kinds
                # A truncated list does not show which kinds are missing.
                kinds = None if listed is None or len(listed) >= MAX_KINDS else frozenset(listed)
                return events.ComponentsListed(command.host, reply.message.components, listing.component, kinds)

    async def _start(self, host: HostName, start: messages.StartComponent) -> events.StartAnswered:
        answered = partial(events.StartAnswered, start.component, start.incarnation, host)
        reply = await self._ask(host, start, messages.ComponentView, self._start_timeout)
        if reply is None:
            return answered("unknown", f"{host} did not answer")
        view = reply.message
        if view is None:
            code, words = (reply.problem.code, reply.problem.message) if reply.problem else ("unknown", "")
            return answered("refused", words[: messages.MAX_TAIL], again=code not in HOPELESS)
        if view.phase in ("running", "standby"):
            return answered("ok", movable=view.movable)
        if view.phase == "ended":
            return answered("failed", view.reason, view.tail[: messages.MAX_TAIL], bad_params=view.bad_params)
        return answered("unknown", f"it is still {view.phase}")

    async def _stop(self, host: HostName, stop: messages.StopComponent) -> events.StopAnswered:
        reply = await self._ask(host, stop, messages.ComponentView, stop.grace + ANSWER_SLACK)
        gone = reply is not None and reply.problem is not None and reply.problem.code == "unknown_component"
        ended = reply is not None and reply.message is not None and reply.message.phase == "ended"
        return events.StopAnswered(stop.component, stop.incarnation or 0, host, done=ended or gone)

    async def _move(self, host: HostName, move: messages.MoveComponent) -> events.MoveAnswered:
        answered = partial(events.MoveAnswered, move.component, move.incarnation, host)
        reply = await self._ask(host, move, messages.Moved, move.patience + self._start_timeout)
        if reply is None:
            return answered("unknown", f"{host} did not answer")
        if reply.message is None:
            return answered("refused", reply.problem.message if reply.problem is not None else "")
        return answered("moved", dead=reply.message.dead)

    async def _ask(self, host: HostName, message: msgspec.Struct, kind: type[R], timeout: float) -> Reply[R] | None:
        key = self.mesh.keys.component(host, self.mesh.me)
        return naming_versions(await self.mesh.ask_one(key, message, kind, timeout=timeout), f"the node at {host}")
