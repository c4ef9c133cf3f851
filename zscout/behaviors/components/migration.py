"""The moving component's side of a move: it hands its state and its holds to its successor, which is on standby.

Until the RCM has the hand-over (without ARCs: until the successor runs) the move can be called off, and the component
continues here unchanged. After that it stays paused until it learns that the successor runs, or is gone.
"""

from __future__ import annotations

import asyncio
from typing import Final, TypeVar

from zscout import messages
from zscout.behaviors.client.client import Client, RequestRefused
from zscout.behaviors.components.component import Component, SafePointGate
from zscout.keyexpr import Role, Sender
from zscout.mesh.exchange import naming_versions
from zscout.mesh.supervision import done_within
from zscout.messages import MAX_CHECKPOINT, MAX_ERROR, MAX_MOVE, ComponentView, MoveComponent, OpenRequest, Problem
from zscout.types import SECOND, Ns

R = TypeVar("R")
Operation = messages.RestoreComponent | messages.ActivateComponent | messages.StopComponent | messages.ListComponents

RESTORE_TIMEOUT: Final = 10.0
QUERY_TIMEOUT: Final = 2.0
LOOK_TIMEOUT: Final = 0.5
GONE_AFTER: Final = 2 * SECOND
"""Nanoseconds without a sign of the other node after which it counts as gone."""
PAUSES: Final = (0.02, 1.0)
"""Seconds between two queries to the other node: first and longest."""


class NotMoved(Exception):
    """The move failed, and the component continues here. `code` is the protocol's."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message[:MAX_ERROR])
        self.code = code


def state_of(component: Component) -> bytes:
    """Return the checkpoint of a component that waits at a safe point. Raises NotMoved."""
    try:
        state = component.checkpoint()
    except Exception as error:
        raise NotMoved("move_failed", f"checkpoint() failed: {error!r}") from error
    if not isinstance(state, bytes):
        raise NotMoved("move_failed", f"checkpoint() returned {type(state).__name__}; return bytes")
    if len(state) > MAX_CHECKPOINT:
        raise NotMoved("too_large", f"checkpoint() returned {len(state)} bytes; the limit is {MAX_CHECKPOINT}")
    return state


class OutgoingMove:
    def __init__(self, client: Client, component: Component, gate: SafePointGate, order: MoveComponent) -> None:
        self._client, self._component, self._gate = client, component, gate
        self._name, self.to, self.incarnation = order.component, order.to, order.to_incarnation
        self._patience = order.patience
        self.successor_runs = asyncio.Event()
        """Set by the lifecycle once the successor's token is on the mesh: it runs, even if its node answers
        otherwise."""
        self.began = False
        """True once the component is paused for this move."""
        self._seen: Ns | None = None
        """When the successor's process or its node was last seen."""
        self.called_off = ""
        """Set to a reason to call the move off, which works until it is committed."""

    async def carry_out(self) -> float:
        """Return, once the successor runs, for how many seconds the component was paused; this process must then end,
        with all holds left. Raises NotMoved if the component continues here."""
        await self._look_for_successor()
        if not await self._gate.hold(self._patience):
            raise NotMoved("not_safe", f"it reached no safe point within {self._patience:g} s")
        began, self.began = self._client.mesh.now(), True
        self._client.internals.pause()
        try:
            await self._hand_over()
        except BaseException:
            # Requests that were not handed over continue; those taken back are already submitted again.
            self._client.internals.resume()
            self._gate.release()
            raise
        return (self._client.mesh.now() - began) / SECOND

    async def _hand_over(self) -> None:
        state, requests = state_of(self._component), self._client.internals.open_requests()
        await self._send_state(state, requests)
        if not self._gate.holds:
            raise NotMoved("move_failed", "it left its safe point because one of its holds ended")
        if self.called_off:
            raise NotMoved("move_failed", self.called_off)
        if not requests:
            if not await self._activate_successor():
                raise NotMoved("move_failed", f"incarnation {self.incarnation} on {self.to} ended")
            return
        words = f"incarnation {self.incarnation} on {self.to} ended; its requests are submitted again here"
        try:
            await self._client.internals.hand_over_all(Sender(self.to, f"{self._name}.{self.incarnation}"))
        except RequestRefused as refused:
            if refused.code != "unknown":
                words = f"the RCM refused the hand-over: {refused}"
            # An earlier RCM may have carried it out.
            successor_runs = await self._stop_successor()
        else:
            successor_runs = await self._activate_successor()
        if not successor_runs:
            self._client.internals.take_back()
            raise NotMoved("move_failed", words)

    async def _send_state(self, state: bytes, requests: list[OpenRequest]) -> None:
        order = messages.RestoreComponent(self._name, self.incarnation, state, requests)
        if len(messages.encode(order)) > MAX_MOVE:
            raise NotMoved(
                "too_large", f"its state and {len(requests)} requests are larger than {MAX_MOVE} bytes; save less state"
            )
        deadline = self._client.mesh.now() + round(RESTORE_TIMEOUT * SECOND)
        pause, longest = PAUSES
        left = RESTORE_TIMEOUT
        while (reply := await self._ask(order, ComponentView, left)) is None:
            # Without a link the query returns at once. A node that has just joined may get its link soon; a node that
            # has been gone for a while does not return.
            await self._look_for_successor()
            now = self._client.mesh.now()
            if self._seen is not None and now - self._seen > GONE_AFTER:
                break
            left = (deadline - now) / SECOND - pause
            if left <= 0:
                break
            await asyncio.sleep(pause)
            pause = min(longest, 2 * pause)
        if isinstance(reply, Problem):
            raise NotMoved("move_failed", f"{self.to} refused: {reply.message}")
        if reply is None:
            raise NotMoved("move_failed", f"{self.to} did not answer")
        if reply.phase != "standby":
            raise NotMoved("move_failed", f"it is {reply.phase} on {self.to}; {reply.reason}")

    async def _activate_successor(self) -> bool:
        """Activate the successor. Return True once it runs, False once it is gone; wait while neither is known."""
        return await self._repeat_until_known(messages.ActivateComponent(self._name, self.incarnation))

    async def _stop_successor(self) -> bool:
        """Stop the successor, unless it runs and has the ARCs: the RCM's answer was lost. Return True if it has run,
        False if it never will."""
        reply = await self._ask(messages.ListComponents(self._name), messages.ComponentList, QUERY_TIMEOUT)
        if isinstance(reply, messages.ComponentList) and any(
            view.incarnation == self.incarnation and view.phase == "running" for view in reply.components
        ):
            return await self._activate_successor()
        return await self._repeat_until_known(messages.StopComponent(self._name, self.incarnation, grace=0.0))

    async def _repeat_until_known(self, operation: messages.ActivateComponent | messages.StopComponent) -> bool:
        (pause, longest), began = PAUSES, self._client.mesh.now()
        # A successor that is cut off starts one lease after it lost sight of this process. Give it the time to.
        gone = max(GONE_AFTER, round(2 * self._client.fleet.mesh.lease * SECOND))
        while not self.successor_runs.is_set():
            match await self._ask(operation, ComponentView, QUERY_TIMEOUT):
                case ComponentView(phase="running"):
                    return True
                case ComponentView(phase="ended", ended=how):
                    # A successor that completed had run: its work must not be repeated.
                    return how in ("completed", "moved", "superseded")
                case Problem(code="unknown_component"):
                    return False
                case Problem(code="old_incarnation"):
                    return True  # a later incarnation was started there: this one ends in any case
                case None if (
                    not await self._look_for_successor()
                    and self._client.mesh.now() - max(self._seen or 0, began) > gone
                ):
                    return False
            if not await done_within(pause, self.successor_runs.wait()):
                pause = min(longest, 2 * pause)
        return True

    async def _look_for_successor(self) -> bool:
        """Return True if the successor may live: its node or client has a token. It outlives its node by moments only,
        and sends nothing without its client's token."""
        mesh = self._client.mesh
        looks = (mesh.living(mesh.keys.alive_any(role), timeout=LOOK_TIMEOUT) for role in (Role.NODE, Role.CLIENT))
        nodes, clients = await asyncio.gather(*looks)
        its = self.to, f"{self._name}.{self.incarnation}"
        lives = any(node.host == self.to for node in nodes) or any(
            (client.host, client.name) == its for client in clients
        )
        if lives:
            self._seen = mesh.now()
        return lives

    async def _ask(self, operation: Operation, kind: type[R], timeout: float) -> R | Problem | None:
        mesh = self._client.mesh
        answered = await mesh.ask_one(mesh.keys.component(self.to, mesh.me), operation, kind, timeout=timeout)
        reply = naming_versions(answered, f"the node at {self.to}")
        return None if reply is None else reply.message or reply.problem
