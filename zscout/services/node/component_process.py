"""One component of a node: a child process, its orders, its messages, and its end."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import msgspec

from zscout import messages
from zscout.behaviors.components import channel
from zscout.behaviors.components.channel import EndReport, Order, OrderAnswer
from zscout.behaviors.components.component import BAD_PARAMS
from zscout.behaviors.components.processes import VARIABLE, kill_family
from zscout.config.fleet import Fleet
from zscout.keyexpr import new_instance
from zscout.mesh import Refused, Supervisor
from zscout.mesh.supervision import done_within
from zscout.messages import ComponentView, HowEnded, MoveComponent, Moved, Phase, RestoreComponent, StartComponent
from zscout.services.node.component_output import OutputReader, OutputRing
from zscout.services.node.limits import ComponentGroup, ControlGroups
from zscout.types import SECOND, Ns

log = logging.getLogger("zscout.components")

LINGER: Final = 2.0  # seconds that a process may run after its last message
SLACK: Final = 5.0  # seconds for an answer, beyond those for carrying out the order


class ComponentProcess:
    """One incarnation. `where`: the kind's `module:class`; `fleet`: how a child joins; `now`: the node's clock;
    `on_over` is called once, at its end."""

    def __init__(
        self,
        host: str,
        fleet: Fleet,
        now: Callable[[], Ns],
        limits: ControlGroups,
        start: StartComponent,
        where: str,
        on_over: Callable[[ComponentProcess], None],
    ) -> None:
        self._host, self._fleet, self._now, self._limits = host, fleet, now, limits
        self.start, self._where, self._on_over = start, where, on_over
        self.phase: Phase = "starting"
        self.ended: HowEnded | None = None
        self.reason = ""
        self.bad_params = False
        self.movable = False
        self.moved: Moved | None = None
        self.output = OutputRing()
        self.settled = asyncio.Event()  # set on standby, running, or ended
        self.running = asyncio.Event()  # set when running, or ended
        self.over = asyncio.Event()
        self._began = now()
        self._lasted: Ns | None = None
        self._tag = f"{start.component}.{start.incarnation}-{new_instance()}"
        self._child: subprocess.Popen[bytes] | None = None
        self._orders: asyncio.Queue[bytes] | None = None  # messages to its process, while connected
        self._group = ComponentGroup(0, 0)
        self._verdict: EndReport | None = None  # the outcome, if this node decides it
        self._end_report: EndReport | None = None
        self._gone = False  # its process ended, cleanup continues
        self._waiting: dict[int, asyncio.Future[OrderAnswer]] = {}
        self._numbers = itertools.count(1)
        self._moving: tuple[MoveComponent, asyncio.Task[Moved]] | None = None

    @property
    def pid(self) -> int | None:
        """The process id, until the process was waited for."""
        return self._child.pid if self._child is not None and self._child.returncode is None else None

    @property
    def leaving(self) -> bool:
        """Return True if it will end soon, by itself or by order."""
        return self.phase == "stopping" or self.moved is not None or self._gone or self._end_report is not None

    def begin(self, supervisor: Supervisor) -> None:
        """Start it under its host's `supervisor`. A failure ends this component alone, as `failed`."""
        self._supervisor = supervisor
        supervisor.spawn(self._live())

    def view(self) -> ComponentView:
        lasted = self._lasted if self._lasted is not None else self._now() - self._began
        return ComponentView(
            component=self.start.component,
            incarnation=self.start.incarnation,
            host=self._host,
            spec=self.start.spec,
            phase=self.phase,
            movable=self.movable,
            uptime=lasted / SECOND,
            pid=self.pid,
            ended=self.ended,
            reason=self.reason if self.ended is not None else self._group.missing,
            tail=self.output.tail() if self.ended == "failed" else "",
            bad_params=self.bad_params,
        )

    # Orders. Each raises Refused.

    async def stop(self, grace: float) -> ComponentView:
        """Return at its end: by itself within `grace` seconds, or killed."""
        if self.phase != "ended":
            self.phase = "stopping"
            self._send(Order(0, messages.StopComponent(self.start.component)))
        if not await done_within(grace, self.over.wait()):
            self._kill(EndReport("stopped", f"it was killed: it had not ended {grace:g} s after it was asked to"))
        await self.over.wait()
        return self.view()

    async def checkpoint(self) -> messages.Checkpoint:
        self._check_runs()
        start, patience = self.start, channel.PATIENCE + SLACK
        answer = await self._ask(messages.CheckpointComponent(start.component), patience)
        return messages.Checkpoint(start.component, start.incarnation, answer.state)

    async def move(self, order: MoveComponent) -> Moved:
        """Move it; a repeated order returns the outcome of the same move."""
        if self.moved is not None and self.moved.incarnation == order.to_incarnation:
            return self.moved
        if self._moving is not None and not self._moving[1].done():
            if self._moving[0].to_incarnation != order.to_incarnation:
                raise Refused("move_failed", f"it is already moving to {self._moving[0].to}")
        else:
            self._check_runs()
            self._moving = order, asyncio.get_running_loop().create_task(self._move(order))
        return await asyncio.shield(self._moving[1])

    async def _move(self, order: MoveComponent) -> Moved:
        # No timeout: a committed move may last until the other node is known to be gone.
        answer = await self._ask(order, None)
        if self.phase == "running":
            self.phase = "stopping"
        self.moved = Moved(order.component, order.to, order.to_incarnation, answer.dead)
        return self.moved

    async def restore(self, order: RestoreComponent) -> ComponentView:
        if self.phase != "standby":
            raise Refused(
                "move_failed", f"it is {self.phase} on this host; only a component on standby can be restored"
            )
        await self._ask(order, SLACK)
        return self.view()

    async def activate(self, order: messages.ActivateComponent) -> ComponentView:
        self._send(Order(0, order))
        await self.running.wait()
        return self.view()

    def _check_runs(self) -> None:
        if self.phase != "running":
            raise Refused(
                "bad_request", f"{self.start.component} is {self.phase} here; only a running component can do this"
            )

    async def _ask(self, operation: channel.Operation, timeout: float | None) -> OrderAnswer:
        number = next(self._numbers)
        answered: asyncio.Future[OrderAnswer] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answered
        try:
            self._send(Order(number, operation))
            async with asyncio.timeout(timeout):
                answer = await answered
        except TimeoutError:
            raise Refused("not_safe", f"it did not answer within {timeout:g} s") from None
        finally:
            self._waiting.pop(number, None)
        if answer.problem is not None:
            raise Refused(answer.problem.code, answer.problem.message)
        return answer

    def _send(self, message: msgspec.Struct) -> None:
        if self._orders is not None:
            self._orders.put_nowait(channel.pack(message))

    async def _live(self) -> None:
        timeout = self._fleet.placement.start_timeout / SECOND
        late = self._supervisor.call_later(timeout, self._late, timeout)
        try:
            await self._run_child()
        except OSError as error:
            self._verdict = self._verdict or EndReport("failed", f"it can't be started: {error}")
        except Exception as error:
            log.exception("the node failed to run %s", self._tag)
            self._verdict = self._verdict or EndReport("failed", f"its node failed: {error}")
        finally:
            late.cancel()
            await asyncio.shield(self._finish())

    async def _run_child(self) -> None:
        spec = self.start.spec
        if spec.memory_limit or spec.cpu_limit:
            name = f"{self.start.component}.{self.start.incarnation}"
            self._group = await asyncio.to_thread(self._limits.group, name, spec.memory_limit, spec.cpu_limit)
        ours, theirs = socket.socketpair()
        reading, writing = os.pipe()
        output = OutputReader(reading, self.output)
        try:
            with theirs:
                self._child = child = await asyncio.to_thread(self._spawn, theirs.fileno(), writing)
        except OSError:
            ours.close()
            output.finish()
            raise
        finally:
            os.close(writing)
        try:
            # It waits for its job: its use counts from here.
            await asyncio.to_thread(self._group.enter, child.pid)
            await self._serve_connection(ours, child)
        finally:
            ours.close()
            # Its number is not reused before the wait.
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            await asyncio.to_thread(child.wait)
            await asyncio.to_thread(kill_family, self._tag)
            output.finish()

    async def _serve_connection(self, connection: socket.socket, child: subprocess.Popen[bytes]) -> None:
        loop = asyncio.get_running_loop()
        # A socket for orders alone: if one fails, asyncio would close the connection with unread messages.
        sending = connection.dup()
        stream, writer = await asyncio.open_unix_connection(sock=connection, limit=channel.MAX_FRAME)
        self._orders = asyncio.Queue()
        speaking = loop.create_task(_speak(sending, self._orders))
        self._send(channel.ComponentJob(self.start, self._where, self._host, self._fleet, self._tag, self._group.each))
        if self.phase == "stopping":
            self._send(Order(0, messages.StopComponent(self.start.component)))
        if self._verdict is not None:
            self._kill(self._verdict)
        gone = asyncio.Event()
        handle = os.pidfd_open(child.pid)
        loop.add_reader(handle, gone.set)
        receiving = loop.create_task(self._receive(stream))
        try:
            await gone.wait()
            self._gone = True
            # Its last messages are on their way.
            await done_within(LINGER, receiving)
        finally:
            loop.remove_reader(handle)
            os.close(handle)
            receiving.cancel()
            self._orders = None
            writer.close()
            speaking.cancel()
            await asyncio.wait({speaking})
            sending.close()
            if not speaking.cancelled():
                speaking.result()

    def _spawn(self, connection: int, writing: int) -> subprocess.Popen[bytes]:
        return subprocess.Popen(  # noqa: S603 - nothing of it comes over the mesh
            [sys.executable, "-P", "-m", "zscout.behaviors.components.runner", str(connection)],
            stdin=subprocess.DEVNULL,
            stdout=writing,
            stderr=writing,
            pass_fds=(connection,),
            start_new_session=True,
            env=os.environ | {VARIABLE: self._tag, "PYTHONUNBUFFERED": "1", "ZSCOUT_HOST": self._host},
        )

    async def _receive(self, stream: asyncio.StreamReader) -> None:
        report: channel.ComponentReport | None
        try:
            while (report := await channel.read(stream, channel.ComponentReport)) is not None:
                self._on_message(report)
        except channel.BadFrame as error:
            self._kill(EndReport("failed", f"it was killed: it sent its node an invalid message: {error}"))

    def _on_message(self, report: channel.ComponentReport) -> None:
        match report:
            case channel.PhaseReport(phase=phase, movable=movable):
                self.movable = movable
                if self.phase != "stopping":
                    self.phase = phase
                if not self.settled.is_set():
                    asyncio.get_running_loop().run_in_executor(None, self._group.settle)
                self.settled.set()
                if phase == "running":
                    self.running.set()
            case EndReport():
                self._end_report = report
                self._supervisor.call_later(LINGER, self._kill, report)
            case _:
                waiting = self._waiting.get(report.number)
                if waiting is not None and not waiting.done():
                    waiting.set_result(report)

    def _late(self, timeout: float) -> None:
        if not self.settled.is_set():
            self._kill(EndReport("failed", f"it was killed: it did not get ready within {timeout:g} s"))

    def _kill(self, verdict: EndReport) -> None:
        if self.over.is_set():
            return
        self._verdict = self._verdict or verdict
        self._kill_child()

    def _kill_child(self) -> None:
        if self.pid is not None:
            # Its number is not reused before the wait.
            with suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)

    async def _finish(self) -> None:
        ends = self._end_report or self._how()
        await asyncio.to_thread(self._group.close)
        self._lasted = self._now() - self._began
        self.phase, self.ended, self.reason, self.bad_params = "ended", ends.how, ends.reason, ends.bad_params
        words = f"{ends.how}: {ends.reason}" if ends.reason else ends.how
        log.info("%s.%d %s", self.start.component, self.start.incarnation, words)
        for waiting in self._waiting.values():
            if not waiting.done():
                waiting.set_exception(Refused("move_failed", f"it has ended, {words}"))
        try:
            self._on_over(self)
        finally:
            for event in (self.settled, self.running, self.over):
                event.set()

    def _how(self) -> EndReport:
        """The outcome if the process sent no final report."""
        if self._verdict is not None:
            return self._verdict
        code = self._child.returncode if self._child is not None else None
        if code == -signal.SIGKILL and self._group.overdrawn():
            return EndReport("failed", f"killed: used more memory than its limit of {self._group.memory} bytes")
        if code is not None and code < 0:
            known = {number.value: number.name for number in signal.Signals}
            return EndReport("failed", f"killed by {known.get(-code, f'signal {-code}')}")
        words = f"its process exited with code {code} without a report"
        return EndReport("failed", words, bad_params=code == BAD_PARAMS)


async def _speak(connection: socket.socket, frames: asyncio.Queue[bytes]) -> None:
    loop = asyncio.get_running_loop()
    connection.setblocking(False)
    with suppress(OSError):
        while True:
            await loop.sock_sendall(connection, await frames.get())
