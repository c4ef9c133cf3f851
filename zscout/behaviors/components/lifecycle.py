"""The life of one component in its process: made, standing by, running, held, moved, ended."""

from __future__ import annotations

import asyncio
import traceback
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import closing
from typing import Any, Final

from msgspec.structs import replace

from zscout import messages
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.identity import bounded
from zscout.behaviors.components import channel
from zscout.behaviors.components.channel import ComponentJob, EndReport, Order, OrderAnswer, PhaseReport
from zscout.behaviors.components.component import (
    BAD_PARAMS,
    BadKind,
    Component,
    ComponentContext,
    SafePointGate,
    is_movable,
    load_kind,
)
from zscout.behaviors.components.migration import NotMoved, OutgoingMove, state_of
from zscout.behaviors.components.processes import limit_allocations
from zscout.keyexpr import BadName, Role, Token, incarnation_of, matcher, new_instance
from zscout.mesh import Declaration, MeshError
from zscout.mesh.supervision import Supervisor, done_within
from zscout.messages import MAX_ERROR, MoveComponent, Problem, RestoreComponent, Who

STAND_BY: Final = 30.0
"""Seconds that one stands by without being restored or activated, and then again until it is activated."""
LINKED: Final = 1.0
"""Seconds in which one that stands by may find the RCM: without a link to it, it can't be handed anything."""
REACHED: Final = 3.0
"""Seconds in which it may find the RCs that it is to hold: without a link to them it would lose the holds."""
CLOSE: Final = 4.0
"""Seconds for giving back what it holds."""
SUPERSEDED: Final = 0.5
"""Seconds that a superseded one has to clean up."""


class BadParams(BadKind):
    """What a component was given is no good."""


class ComponentLifecycle:
    """Runs the component of `job`. `report` sends one to the node, waited for or not; `connect` is `Client.connect`."""

    def __init__(
        self,
        job: ComponentJob,
        report: Callable[[channel.ComponentReport], asyncio.Future[None]],
        connect: Callable[..., Coroutine[Any, Any, Client]] = Client.connect,
    ) -> None:
        self._job, self._report, self._connect = job, report, connect
        self._story: asyncio.Task[EndReport] | None = None
        self._wanted: EndReport | None = None
        """How it is to end, once something wants it to."""
        self._client: Client | None = None
        self._component: Component | None = None
        self._gate = SafePointGate()
        self._holding = asyncio.Lock()
        self._move: OutgoingMove | None = None
        self._running = False
        self._instance = f"{job.start.incarnation}-{new_instance()}"
        self._restored = asyncio.Event()
        self._activated = asyncio.Event()
        self._handed = asyncio.Event()
        """It has been handed an ARC, and no older incarnation is seen: nobody will activate it."""
        self._older: set[str] = set()
        """Instances of older incarnations that are seen."""
        self._alone = asyncio.Event()
        """None is."""
        self._alone.set()
        self._accompanied = asyncio.Event()
        """One is."""
        self._left = asyncio.Event()
        """It is over here, whatever run() does: another one goes on."""
        self._away: EndReport | None = None
        """How, once that is so."""
        self._supervisor = Supervisor(
            f"component {job.client}", lambda error: self.end(EndReport("failed", _words(error)))
        )

    async def run(self) -> EndReport:
        """Returns how it ended, when all that it held has been given back, or handed over."""
        story = self._story = asyncio.create_task(self._run_story())
        if self._wanted is not None:
            story.cancel()
        left = asyncio.create_task(self._left.wait())
        await asyncio.wait({story, left}, return_when=asyncio.FIRST_COMPLETED)
        if left.done():
            # run() stays where it is: to unwind it would give up what another one holds now.
            ends = self._away or EndReport("moved")
            if self._client is not None:
                await self._client.internals.leave()
            return ends
        left.cancel()
        try:
            ends = story.result()
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - the author's code
            if self._wanted is None or not isinstance(error, asyncio.CancelledError):
                traceback.print_exception(error)
            ends = self._wanted or EndReport("failed", _words(error))
        await self._supervisor.close()
        if self._client is not None:
            await done_within(SUPERSEDED if ends.how == "superseded" else CLOSE, self._client.close())
        return ends

    def order(self, order: Order) -> None:
        match order.operation:
            case messages.StopComponent():
                self.end(EndReport("stopped"))
            case messages.ActivateComponent():
                self._activated.set()
            case messages.CheckpointComponent():
                self._supervisor.spawn(self._or_decline(order.number, self._take_checkpoint))
            case MoveComponent() as move:
                self._supervisor.spawn(self._or_decline(order.number, self._move_away, move))
            case RestoreComponent() as restore:
                self._supervisor.spawn(self._or_decline(order.number, self._take_in, restore))

    def end(self, ends: EndReport) -> None:
        """Has it end; of several ends the first is reported. A move that has begun is called off; if it is
        committed, another one goes on and this one is over anyhow."""
        if self._wanted is not None:
            return
        self._wanted = ends
        if self._move is not None:
            self._move.called_off = "it is to end"
        if self._story is not None and (self._move is None or not self._move.began):
            self._story.cancel()

    # What happens to it

    async def _run_story(self) -> EndReport:
        job = self._job
        connecting = asyncio.create_task(self._connect(job.client, fleet=job.fleet, host=job.host))
        # It joins the mesh in a thread: what follows is done meanwhile.
        await asyncio.sleep(0)
        try:
            try:
                kind = self._load()
            finally:
                client = self._client = await connecting
                client.who = replace(client.who or Who(), command=bounded(f"component {job.start.component}"))
                # Whoever started it may have started it before its devices.
                client.waits_for_devices = True
            made = self._component = self._make(kind)
        except (BadKind, MeshError) as error:
            return EndReport("failed", str(error), bad_params=isinstance(error, BadParams))
        movable = is_movable(made)
        with closing(client.mesh.watch(client.mesh.keys.alive_any(Role.COMPONENT), self._on_component)):
            if job.start.standby:
                await _finds(client, Role.RCM, [lambda _: True], LINKED)
                await self._report(PhaseReport("standby", movable))
                # Once restored it has as long again to be activated, or handed an ARC.
                called = self._activated, self._handed
                self._supervisor.spawn(self._see_handed(client))
                if not await _first(STAND_BY, *called, self._restored) or not await _first(STAND_BY, *called):
                    return EndReport("stopped", f"it stood by for {STAND_BY:g} s and nothing was handed to it")
            return await self._perform(client, made, movable)

    def _load(self) -> type[Component]:
        try:
            return load_kind(self._job.start.spec.kind, self._job.where)
        except BadKind:
            raise
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            raise BadKind(f"its kind can't be imported: {_words(error)}") from None

    def _make(self, kind: type[Component]) -> Component:
        limit_allocations(self._job.memory)
        try:
            return kind(self._job.start.spec.params)
        except ValueError as error:
            raise BadParams(f"bad parameters: {_words(error, named=False)}") from None
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            raise BadKind(f"it can't be made: {_words(error)}") from None

    async def _perform(self, client: Client, component: Component, movable: bool) -> EndReport:
        start, host = self._job.start, self._job.host
        token: Declaration = client.mesh.alive(Token(host, Role.COMPONENT, start.component, self._instance))
        self._running = True
        try:
            # Not waited for: nothing comes between this and its first step.
            self._report(PhaseReport("running", movable))
            await component.run(ComponentContext(client, start.component, start.incarnation, self._gate))
        except asyncio.CancelledError:
            if self._wanted is None:
                raise
        except SystemExit as left:
            if left.code == BAD_PARAMS:
                words = f"it left with code {BAD_PARAMS}: its parameters are no good; see its output"
                return self._wanted or EndReport("failed", words, bad_params=True)
            if left.code:
                return self._wanted or EndReport("failed", f"it left with {left.code!r}")
        except Exception as error:
            if self._wanted is None:
                raise
            traceback.print_exception(error)
        finally:
            self._running = False
            token.close()
        return self._wanted or EndReport("completed")

    # Orders that are answered

    async def _or_decline(self, number: int, carry_out: Callable[..., Awaitable[None]], *what: Any) -> None:
        try:
            await carry_out(number, *what)
        except NotMoved as refused:
            await self._report(OrderAnswer(number, problem=Problem(refused.code, str(refused))))

    def _movable(self, *, standby: bool = False) -> tuple[Component, Client]:
        """Raises NotMoved where it does not run, or stand by, or can't be moved at all."""
        component, client = self._component, self._client
        fits = self._job.start.standby and not self._running if standby else self._running
        if component is None or client is None or not fits:
            what = f"standing by on {self._job.host}" if standby else f"running on {self._job.host}"
            raise NotMoved("bad_request", f"{self._job.start.component} is not {what}; see zscout component list")
        if not is_movable(component):
            kept = self._job.start.component
            raise NotMoved("not_movable", f"{kept} can't be moved: its kind has no checkpoint() and restore()")
        return component, client

    async def _take_checkpoint(self, number: int) -> None:
        component, _ = self._movable()
        async with self._holding:
            if not await self._gate.hold(channel.PATIENCE):
                raise NotMoved("not_safe", f"it reached no safe point within {channel.PATIENCE:g} s")
            try:
                state = state_of(component)
            finally:
                self._gate.release()
        await self._report(OrderAnswer(number, state))

    async def _move_away(self, number: int, move: MoveComponent) -> None:
        component, client = self._movable()
        async with self._holding:
            self._move = OutgoingMove(client, component, self._gate, move)
            try:
                dead = await self._move.carry_out()
            except BaseException as error:
                self._move = None
                if self._left.is_set() and isinstance(error, Exception):
                    return  # another one goes on: this one has left the mesh
                if self._wanted is not None and self._story is not None:
                    self._story.cancel()
                if isinstance(error, NotMoved) or not isinstance(error, Exception):
                    raise
                traceback.print_exc()
                raise NotMoved("move_failed", _words(error)) from None
            self._away = EndReport("moved")
            await self._report(OrderAnswer(number, dead=dead))
            self._left.set()

    async def _take_in(self, number: int, handed: RestoreComponent) -> None:
        component, client = self._movable(standby=True)
        held = [need for request in handed.requests if request.grant is not None for need in request.needs]
        if not await _finds(client, Role.RC, [matcher(need) for need in held], REACHED):
            words = f"{self._job.host} does not reach {', '.join(held)}, or not all of them"
            raise NotMoved("start_failed", words)
        try:
            component.restore(handed.state)
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            words = f"restore() failed: {_words(error)}"
            self.end(EndReport("failed", words))
            raise NotMoved("start_failed", words) from None
        try:
            client.internals.expect(handed.requests)
        except (BadName, ValueError) as error:
            raise NotMoved("bad_request", _words(error, named=False)) from None
        self._restored.set()
        await self._report(OrderAnswer(number))

    async def _see_handed(self, client: Client) -> None:
        await client.internals.expected_came.wait()
        await self._alone.wait()
        # After a partition the link to the older one may come back a little later than that to the RCM.
        while await done_within(client.fleet.mesh.lease, self._accompanied.wait()):
            await self._alone.wait()
        self._handed.set()

    def _on_component(self, token: Token, alive: bool) -> None:
        if token.name != self._job.start.component:
            return
        try:
            incarnation = incarnation_of(token.instance)
        except BadName:
            return
        if incarnation < self._job.start.incarnation:
            (self._older.add if alive else self._older.discard)(token.instance)
            (self._alone.clear if self._older else self._alone.set)()
            (self._accompanied.set if self._older else self._accompanied.clear)()
        if not alive:
            return
        if self._move is not None and incarnation == self._move.incarnation:
            self._move.successor_runs.set()
        # Two placers that did not see each other may have given the same number.
        elif (incarnation, token.host, token.instance) > (self._job.start.incarnation, self._job.host, self._instance):
            ends = EndReport("superseded", f"incarnation {incarnation} runs on {token.host}")
            self._away = self._away or ends
            self.end(ends)
            asyncio.get_running_loop().call_later(SUPERSEDED, self._left.set)


async def _finds(client: Client, role: str, names: list[Callable[[str], bool]], timeout: float) -> bool:
    """Waits until for each of `names` a token of this role is seen, at most `timeout` seconds."""
    missing, found = list(names), asyncio.Event()

    def on_token(token: Token, alive: bool) -> None:
        missing[:] = [name for name in missing if not (alive and name(token.name))]
        if not missing:
            found.set()

    with closing(client.mesh.watch(client.mesh.keys.alive_any(role), on_token)):
        return not missing or await done_within(timeout, found.wait())


async def _first(timeout: float, *events: asyncio.Event) -> bool:
    """Waits until one of these is set; False if none is within `timeout` seconds."""
    waits = [asyncio.ensure_future(event.wait()) for event in events]
    try:
        done, _ = await asyncio.wait(waits, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
    return bool(done)


def _words(error: BaseException, *, named: bool = True) -> str:
    """An error in one line."""
    text = " ".join(str(error).split())[:MAX_ERROR]
    name = type(error).__name__
    return f"{name}: {text}" if text and named else text or name
