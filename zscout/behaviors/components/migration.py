"""The source's side of a move: it hands over what it holds to an incarnation of itself that stands by.

Up to the hand-over at the RCM (or, without ARCs, up to the word that the other one runs) it can go on as if
nothing had been asked. From then on it stays paused until the other one is known to run, or to be gone.
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
ASK_TIMEOUT: Final = 2.0
LOOK_TIMEOUT: Final = 0.5
GONE: Final = 2 * SECOND
"""Since the other node was last seen, until it counts as gone."""
PAUSES: Final = (0.02, 1.0)
"""Seconds between two askings of the other node: at first, and at most."""


class NotMoved(Exception):
    """It goes on here. `code` is the protocol's."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message[:MAX_ERROR])
        self.code = code


def state_of(component: Component) -> bytes:
    """The checkpoint of a component that is held at a safe point. Raises NotMoved."""
    try:
        state = component.checkpoint()
    except Exception as error:
        raise NotMoved("move_failed", f"checkpoint() failed: {error!r}") from error
    if not isinstance(state, bytes):
        raise NotMoved("move_failed", f"checkpoint() gave {type(state).__name__}; return bytes")
    if len(state) > MAX_CHECKPOINT:
        raise NotMoved("too_large", f"checkpoint() gave {len(state)} bytes; at most {MAX_CHECKPOINT} can be moved")
    return state


class OutgoingMove:
    def __init__(self, client: Client, component: Component, gate: SafePointGate, order: MoveComponent) -> None:
        self._client, self._component, self._gate = client, component, gate
        self._name, self.to, self.incarnation = order.component, order.to, order.to_incarnation
        self._patience = order.patience
        self.successor_runs = asyncio.Event()
        """To be set when the token of the other incarnation is seen: it runs, whatever else is known."""
        self.began = False
        """Whether the component is held for it."""
        self._seen: Ns | None = None
        """When the other process, or its node, was last seen."""
        self.called_off = ""
        """Why it must not be, as long as it is not committed."""

    async def carry_out(self) -> float:
        """Returns how long (s) the component did not run, once the other one does: this process is to end
        then, and to give up nothing. Raises NotMoved where it goes on here."""
        await self._lives()
        if not await self._gate.hold(self._patience):
            raise NotMoved("not_safe", f"it reached no safe point within {self._patience:g} s")
        began, self.began = self._client.mesh.now(), True
        self._client.internals.pause()
        try:
            await self._hand_over()
        except BaseException:
            # What was not handed over goes on; what was taken back is asked anew already.
            self._client.internals.resume()
            self._gate.release()
            raise
        return (self._client.mesh.now() - began) / SECOND

    async def _hand_over(self) -> None:
        state, requests = state_of(self._component), self._client.internals.open_requests()
        await self._give(state, requests)
        if not self._gate.holds:
            raise NotMoved("move_failed", "it left its safe point: a hold of it ended just then")
        if self.called_off:
            raise NotMoved("move_failed", self.called_off)
        if not requests:
            if not await self._confirmed():
                raise NotMoved("move_failed", f"incarnation {self.incarnation} on {self.to} ended")
            return
        words = f"incarnation {self.incarnation} on {self.to} ended; its ARCs are asked anew here"
        try:
            await self._client.internals.hand_over_all(Sender(self.to, f"{self._name}.{self.incarnation}"))
        except RequestRefused as refused:
            if refused.code != "unknown":
                words = f"the RCM refused the hand-over: {refused}"
            # One that it replaced may have carried it out.
            going_on = await self._stop_there()
        else:
            going_on = await self._confirmed()
        if not going_on:
            self._client.internals.take_back()
            raise NotMoved("move_failed", words)

    async def _give(self, state: bytes, requests: list[OpenRequest]) -> None:
        order = messages.RestoreComponent(self._name, self.incarnation, state, requests)
        if len(messages.encode(order)) > MAX_MOVE:
            raise NotMoved("too_large", f"state and {len(requests)} requests are more than {MAX_MOVE} bytes")
        deadline = self._client.mesh.now() + round(RESTORE_TIMEOUT * SECOND)
        pause, longest = PAUSES
        left = RESTORE_TIMEOUT
        while (reply := await self._ask(order, ComponentView, left)) is None:
            # No answer comes at once where there is no link yet to a node that has just come; one that has been gone
            # for a while does not come back.
            await self._lives()
            now = self._client.mesh.now()
            if self._seen is not None and now - self._seen > GONE:
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

    async def _confirmed(self) -> bool:
        """Has the other one run, and waits for as long as that is not known. False: it is gone."""
        return await self._until_known(messages.ActivateComponent(self._name, self.incarnation))

    async def _stop_there(self) -> bool:
        """It is unknown whether an RCM carried out the hand-over: whoever runs by now has the ARCs. False: the
        other one did not, and will not."""
        reply = await self._ask(messages.ListComponents(self._name), messages.ComponentList, ASK_TIMEOUT)
        if isinstance(reply, messages.ComponentList) and any(
            view.incarnation == self.incarnation and view.phase == "running" for view in reply.components
        ):
            return await self._confirmed()
        return await self._until_known(messages.StopComponent(self._name, self.incarnation, grace=0.0))

    async def _until_known(self, operation: messages.ActivateComponent | messages.StopComponent) -> bool:
        (pause, longest), began = PAUSES, self._client.mesh.now()
        # Cut off, the other one runs a lease after it lost sight of this one: it is to be the first of the two.
        gone = max(GONE, round(2 * self._client.fleet.mesh.lease * SECOND))
        while not self.successor_runs.is_set():
            match await self._ask(operation, ComponentView, ASK_TIMEOUT):
                case ComponentView(phase="running"):
                    return True
                case ComponentView(phase="ended", ended=how):
                    # Who completed had run: what it did must not be done again.
                    return how in ("completed", "moved", "superseded")
                case Problem(code="unknown_component"):
                    return False
                case Problem(code="old_incarnation"):
                    return True  # one that is higher still was started there: this one is over in any case
                case None if not await self._lives() and self._client.mesh.now() - max(self._seen or 0, began) > gone:
                    return False
            if not await done_within(pause, self.successor_runs.wait()):
                pause = min(longest, 2 * pause)
        return True

    async def _lives(self) -> bool:
        """Whether the other process may still be there. It outlives its node by moments: once its client's
        token has gone, nothing of it will be heard any more."""
        mesh = self._client.mesh
        looks = (mesh.living(mesh.keys.alive_any(role), timeout=LOOK_TIMEOUT) for role in (Role.NODE, Role.CLIENT))
        nodes, clients = await asyncio.gather(*looks)
        its = self.to, f"{self._name}.{self.incarnation}"
        lives = any(node.host == self.to for node in nodes) or any((one.host, one.name) == its for one in clients)
        if lives:
            self._seen = mesh.now()
        return lives

    async def _ask(self, operation: Operation, kind: type[R], timeout: float) -> R | Problem | None:
        mesh = self._client.mesh
        answered = await mesh.ask_one(mesh.keys.component(self.to, mesh.me), operation, kind, timeout=timeout)
        reply = naming_versions(answered, f"the node at {self.to}")
        return None if reply is None else reply.message or reply.problem
