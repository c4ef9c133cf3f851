"""Life cycle of one component within its process: made, on standby, running, paused, moved, ended."""

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

STANDBY_TIMEOUT: Final = 30.0
"""Seconds on standby until it must be restored or activated; once restored, it has as long again to be activated."""
RCM_LINK_TIMEOUT: Final = 1.0
"""Seconds on standby to find the RCM: without a link to the RCM it can't receive a hold."""
RC_LINK_TIMEOUT: Final = 3.0
"""Seconds to find the RCs of the holds that it receives: without a link to them it would lose those holds."""
CLOSE_TIMEOUT: Final = 4.0
"""Seconds to give back its holds."""
SUPERSEDED_CLEANUP: Final = 0.5
"""Seconds that a superseded component has to clean up."""


class BadParams(BadKind):
    """A component's parameters are invalid."""


class ComponentLifecycle:
    """`report` sends a report to the node; its future is done once it is sent. Tests replace `connect`."""

    def __init__(
        self,
        job: ComponentJob,
        report: Callable[[channel.ComponentReport], asyncio.Future[None]],
        connect: Callable[..., Coroutine[Any, Any, Client]] = Client.connect,
    ) -> None:
        self._job, self._report, self._connect = job, report, connect
        self._main_task: asyncio.Task[EndReport] | None = None
        self._requested_end: EndReport | None = None
        """How it ends, once an end has been requested."""
        self._client: Client | None = None
        self._component: Component | None = None
        self._gate = SafePointGate()
        self._gate_lock = asyncio.Lock()
        self._move: OutgoingMove | None = None
        self._running = False
        self._instance = f"{job.start.incarnation}-{new_instance()}"
        self._restored = asyncio.Event()
        self._activated = asyncio.Event()
        self._received_alone = asyncio.Event()
        """It has received an ARC and no older incarnation is on the mesh, which could still activate it."""
        self._older_instances: set[str] = set()
        """Instances of older incarnations on the mesh."""
        self._no_older_instance = asyncio.Event()
        """Set while `_older_instances` is empty."""
        self._no_older_instance.set()
        self._older_instance_seen = asyncio.Event()
        """Set while `_older_instances` is not empty."""
        self._left_mesh = asyncio.Event()
        """Another incarnation runs: this one has ended, even if its run() has not returned."""
        self._departure_report: EndReport | None = None
        """The report of that end."""
        self._supervisor = Supervisor(
            f"component {job.client}", lambda error: self.end(EndReport("failed", _error_line(error)))
        )

    async def run(self) -> EndReport:
        """Run the component to its end; return once all its holds are given back or handed over."""
        main_task = self._main_task = asyncio.create_task(self._run_component())
        if self._requested_end is not None:
            main_task.cancel()
        left = asyncio.create_task(self._left_mesh.wait())
        await asyncio.wait({main_task, left}, return_when=asyncio.FIRST_COMPLETED)
        if left.done():
            # run() is not unwound: that would give back holds that another incarnation has now.
            end_report = self._departure_report or EndReport("moved")
            if self._client is not None:
                await self._client.internals.leave()
            return end_report
        left.cancel()
        try:
            end_report = main_task.result()
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - the author's code
            if self._requested_end is None or not isinstance(error, asyncio.CancelledError):
                traceback.print_exception(error)
            end_report = self._requested_end or EndReport("failed", _error_line(error))
        await self._supervisor.close()
        if self._client is not None:
            await done_within(
                SUPERSEDED_CLEANUP if end_report.how == "superseded" else CLOSE_TIMEOUT, self._client.close()
            )
        return end_report

    def order(self, order: Order) -> None:
        match order.operation:
            case messages.StopComponent():
                self.end(EndReport("stopped"))
            case messages.ActivateComponent():
                self._activated.set()
            case messages.CheckpointComponent():
                self._supervisor.spawn(self._answer_or_decline(order.number, self._take_checkpoint))
            case MoveComponent() as move:
                self._supervisor.spawn(self._answer_or_decline(order.number, self._move_away, move))
            case RestoreComponent() as restore:
                self._supervisor.spawn(self._answer_or_decline(order.number, self._restore, restore))

    def end(self, end_report: EndReport) -> None:
        """End the component; the first end is reported. A move that is not committed is called off; after a committed
        one the component continues in its new process."""
        if self._requested_end is not None:
            return
        self._requested_end = end_report
        if self._move is not None:
            self._move.called_off = "the component is being stopped"
        if self._main_task is not None and (self._move is None or not self._move.began):
            self._main_task.cancel()

    async def _run_component(self) -> EndReport:
        job = self._job
        connecting = asyncio.create_task(self._connect(job.client, fleet=job.fleet, host=job.host))
        # The client joins the mesh in a thread; meanwhile the kind is imported.
        await asyncio.sleep(0)
        try:
            try:
                kind = self._load()
            finally:
                client = self._client = await connecting
                client.who = replace(client.who or Who(), command=bounded(f"component {job.start.component}"))
                # It may have been started before the devices of its fleet.
                client.waits_for_devices = True
            made = self._component = self._make(kind)
        except (BadKind, MeshError) as error:
            return EndReport("failed", str(error), bad_params=isinstance(error, BadParams))
        movable = is_movable(made)
        with closing(client.mesh.watch(client.mesh.keys.alive_any(Role.COMPONENT), self._on_component)):
            if job.start.standby:
                await _wait_for_names(client, Role.RCM, [lambda _: True], RCM_LINK_TIMEOUT)
                await self._report(PhaseReport("standby", movable))
                # Once restored, it has as long again to be activated or to receive an ARC.
                called = self._activated, self._received_alone
                self._supervisor.spawn(self._await_handover(client))
                if not await _wait_for_any(STANDBY_TIMEOUT, *called, self._restored) or not await _wait_for_any(
                    STANDBY_TIMEOUT, *called
                ):
                    return EndReport("stopped", f"on standby for {STANDBY_TIMEOUT:g} s, and no component moved here")
            return await self._perform(client, made, movable)

    def _load(self) -> type[Component]:
        try:
            return load_kind(self._job.start.spec.kind, self._job.where)
        except BadKind:
            raise
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            raise BadKind(f"its kind can't be imported: {_error_line(error)}") from None

    def _make(self, kind: type[Component]) -> Component:
        limit_allocations(self._job.memory)
        try:
            return kind(self._job.start.spec.params)
        except ValueError as error:
            raise BadParams(f"bad parameters: {_error_line(error, named=False)}") from None
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            raise BadKind(f"its constructor failed: {_error_line(error)}") from None

    async def _perform(self, client: Client, component: Component, movable: bool) -> EndReport:
        start, host = self._job.start, self._job.host
        token: Declaration = client.mesh.alive(Token(host, Role.COMPONENT, start.component, self._instance))
        self._running = True
        try:
            # Don't await it: the component starts without delay.
            self._report(PhaseReport("running", movable))
            await component.run(ComponentContext(client, start.component, start.incarnation, self._gate))
        except asyncio.CancelledError:
            if self._requested_end is None:
                raise
        except SystemExit as left:
            if left.code == BAD_PARAMS:
                words = f"exited with code {BAD_PARAMS}: invalid parameters; see its output"
                return self._requested_end or EndReport("failed", words, bad_params=True)
            if left.code:
                return self._requested_end or EndReport("failed", f"exited with {left.code!r}")
        except Exception as error:
            if self._requested_end is None:
                raise
            traceback.print_exception(error)
        finally:
            self._running = False
            token.close()
        return self._requested_end or EndReport("completed")

    async def _answer_or_decline(self, number: int, carry_out: Callable[..., Awaitable[None]], *what: Any) -> None:
        try:
            await carry_out(number, *what)
        except NotMoved as refused:
            await self._report(OrderAnswer(number, problem=Problem(refused.code, str(refused))))

    def _movable(self, *, standby: bool = False) -> tuple[Component, Client]:
        """Raises NotMoved if it is not running (on standby, if `standby`), or has no checkpoint() and restore()."""
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
        async with self._gate_lock:
            if not await self._gate.hold(channel.PATIENCE):
                raise NotMoved("not_safe", f"it reached no safe point within {channel.PATIENCE:g} s")
            try:
                state = state_of(component)
            finally:
                self._gate.release()
        await self._report(OrderAnswer(number, state))

    async def _move_away(self, number: int, move: MoveComponent) -> None:
        component, client = self._movable()
        async with self._gate_lock:
            self._move = OutgoingMove(client, component, self._gate, move)
            try:
                dead = await self._move.carry_out()
            except BaseException as error:
                self._move = None
                if self._left_mesh.is_set() and isinstance(error, Exception):
                    return  # another incarnation runs: this process has left the mesh
                if self._requested_end is not None and self._main_task is not None:
                    self._main_task.cancel()
                if isinstance(error, NotMoved) or not isinstance(error, Exception):
                    raise
                traceback.print_exc()
                raise NotMoved("move_failed", _error_line(error)) from None
            self._departure_report = EndReport("moved")
            await self._report(OrderAnswer(number, dead=dead))
            self._left_mesh.set()

    async def _restore(self, number: int, handed: RestoreComponent) -> None:
        component, client = self._movable(standby=True)
        held = [need for request in handed.requests if request.grant is not None for need in request.needs]
        if not await _wait_for_names(client, Role.RC, [matcher(need) for need in held], RC_LINK_TIMEOUT):
            words = f"{self._job.host} has no link to all of {', '.join(held)}"
            raise NotMoved("start_failed", words)
        try:
            component.restore(handed.state)
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            words = f"restore() failed: {_error_line(error)}"
            self.end(EndReport("failed", words))
            raise NotMoved("start_failed", words) from None
        try:
            client.internals.expect(handed.requests)
        except (BadName, ValueError) as error:
            raise NotMoved("bad_request", _error_line(error, named=False)) from None
        self._restored.set()
        await self._report(OrderAnswer(number))

    async def _await_handover(self, client: Client) -> None:
        await client.internals.expected_came.wait()
        await self._no_older_instance.wait()
        # After a partition, the link to the older incarnation may return a little later than the link to the RCM.
        while await done_within(client.fleet.mesh.lease, self._older_instance_seen.wait()):
            await self._no_older_instance.wait()
        self._received_alone.set()

    def _on_component(self, token: Token, alive: bool) -> None:
        if token.name != self._job.start.component:
            return
        try:
            incarnation = incarnation_of(token.instance)
        except BadName:
            return
        if incarnation < self._job.start.incarnation:
            (self._older_instances.add if alive else self._older_instances.discard)(token.instance)
            (self._no_older_instance.clear if self._older_instances else self._no_older_instance.set)()
            (self._older_instance_seen.set if self._older_instances else self._older_instance_seen.clear)()
        if not alive:
            return
        if self._move is not None and incarnation == self._move.incarnation:
            self._move.successor_runs.set()
        # Two placers on different sides of a partition may have assigned the same number.
        elif (incarnation, token.host, token.instance) > (self._job.start.incarnation, self._job.host, self._instance):
            end_report = EndReport("superseded", f"incarnation {incarnation} runs on {token.host}")
            self._departure_report = self._departure_report or end_report
            self.end(end_report)
            asyncio.get_running_loop().call_later(SUPERSEDED_CLEANUP, self._left_mesh.set)


async def _wait_for_names(client: Client, role: str, names: list[Callable[[str], bool]], timeout: float) -> bool:
    """Wait until each of `names` accepts some token's name of this role; return False after `timeout` seconds."""
    missing, found = list(names), asyncio.Event()

    def on_token(token: Token, alive: bool) -> None:
        missing[:] = [name for name in missing if not (alive and name(token.name))]
        if not missing:
            found.set()

    with closing(client.mesh.watch(client.mesh.keys.alive_any(role), on_token)):
        return not missing or await done_within(timeout, found.wait())


async def _wait_for_any(timeout: float, *events: asyncio.Event) -> bool:
    """Return False after `timeout` seconds."""
    waits = [asyncio.ensure_future(event.wait()) for event in events]
    try:
        done, _ = await asyncio.wait(waits, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
    return bool(done)


def _error_line(error: BaseException, *, named: bool = True) -> str:
    text = " ".join(str(error).split())[:MAX_ERROR]
    name = type(error).__name__
    return f"{name}: {text}" if text and named else text or name
