"""A robot that is driven through a radio, and stopped when drive commands cease.

The robot only receives packets. So it counts as working once its radio has accepted a halt for it, and as unwell while
the radio can't send one."""

from __future__ import annotations

import asyncio
import itertools
import statistics
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import msgspec

from zscout.config.devices import RobotRc
from zscout.drivers import commands
from zscout.drivers.driver import Driver, RcHandle
from zscout.drivers.instances import InstanceState
from zscout.drivers.own import RcDirectory, own
from zscout.mesh import Declaration, Refused, Reply
from zscout.mesh.supervision import done_within
from zscout.messages import Command, Done, Figures, Holder, Parameter, RcState
from zscout.types import SECOND, Grant, Ns

ANSWER: Final = 0.5
"""Seconds for the radio's answer to a command, and longest time that a command may wait on its way."""
HALT_ANSWER: Final = 0.25
HALT_TRIES: Final = 4
"""Failed halts after which the robot is unwell. Further halts follow."""
PAUSES: Final = (0.05, 2.0)
"""Seconds between halts while its state is unknown: the first, and the longest."""
STANDBY_CHECK_S: Final = 0.5
"""Between two checks whether it is still on standby."""
MAX_WAITING: Final = 16
RECENT: Final = 64
"""Answers of the radio over which the latency is measured."""


@dataclass(slots=True)
class _Waiting:
    order: commands.RadioDrive | commands.RadioCamera | commands.RadioStop
    radio: str
    grant: Grant
    answer: asyncio.Future[Any]

    def resolve(self, outcome: Any) -> None:
        """Answer the command if it has no answer yet. A Refused as outcome refuses it."""
        if self.answer.done():
            return
        if isinstance(outcome, Refused):
            self.answer.set_exception(outcome)
        else:
            self.answer.set_result(outcome)


class RobotDriver(Driver):
    Options = RobotRc

    def __init__(self, robot: int, *, radio: str, channels: Mapping[str, int], warm_up: float, dead_man: float) -> None:
        """`robot`: its id on the air. `channels`: of its camera, by video RC. `warm_up`: seconds until the camera
        works. `dead_man`: seconds from a drive command until the robot is stopped, even if the command lasts longer."""
        self.activation = warm_up
        self._id, self._radio, self._channels = robot, radio, dict(channels)
        self._dead_man = dead_man
        self._waiting: deque[_Waiting] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._stopped_at: Ns | None = 0
        """When the wheels stop by themselves; None while a drive command is under way."""
        self._unsure = asyncio.Event()
        self._unsure.set()
        self._wake = asyncio.Event()
        self._queued = asyncio.Event()
        self._declared: list[Declaration] = []
        self._counts = Counter(commands=0, refused=0, halts=0, dead_man_stops=0)
        self._latencies: deque[float] = deque(maxlen=RECENT)
        self._sent = itertools.count(1)

    @classmethod
    def configured(cls, options: Any) -> Self:
        return cls(
            options.id,
            radio=options.radio,
            channels=options.channels,
            warm_up=options.warm_up / SECOND,
            dead_man=options.dead_man / SECOND,
        )

    async def open(self, rc: RcHandle) -> None:
        rc = own(rc)
        self._rc, self._mesh = rc, rc.mesh
        rc.fail(f"{self._radio} has not yet accepted its halt")
        self._directory = RcDirectory(rc.mesh, self._on_directory_change)
        state = rc.mesh.keys.rc_state(self._radio)
        self._declared = [self._directory.watch(), rc.mesh.subscribe(state, RcState, self._on_radio_state)]
        rc.supervisor.spawn(self._halt_until_sure())
        rc.supervisor.spawn(self._send_all())

    async def close(self) -> None:
        for declared in self._declared:
            declared.close()

    def parameters(self) -> list[Parameter]:
        return []

    def usable_cold(self, do: Mapping[str, Any]) -> bool:
        """Only the camera warms up, and only after a command that switches it on."""
        return True

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        order = commands.robot_command(do)
        radio = self._radio_of(holder)
        self._counts["commands"] += 1
        sent: commands.RadioDrive | commands.RadioCamera | commands.RadioStop
        if isinstance(order, commands.RobotCamera):
            sent = commands.RadioCamera(self._id, self._channel_of(holder) if order.on else 0)
        else:
            self._drop({"replaced": True}, commands.RadioDrive)  # the newest command wins
            sent = commands.RadioStop(self._id)
            if isinstance(order, commands.RobotDrive):
                sent = commands.RadioDrive(self._id, order.left, order.right, order.lasts)
            self._restart_dead_man(turns=isinstance(order, commands.RobotDrive) and bool(order.left or order.right))
        if len(self._waiting) >= MAX_WAITING:
            raise Refused("busy", f"{MAX_WAITING} commands wait for {radio}; send fewer")
        waiting = _Waiting(sent, radio, holder.grant, asyncio.get_running_loop().create_future())
        (self._waiting.appendleft if isinstance(sent, commands.RadioStop) else self._waiting.append)(waiting)
        self._queued.set()
        return waiting.answer

    def _radio_of(self, holder: Holder) -> str:
        radios = [rc for rc in holder.rcs if rc.startswith("radio/")]
        if self._radio in radios:
            return self._radio
        if len(radios) == 1:
            return radios[0]
        holds = "holds no radio" if not radios else f"holds {' and '.join(radios)}, and not its own"
        raise Refused("no_radio", f"your request {holds}, so it can't reach the robot; request {self._radio} as well")

    def _channel_of(self, holder: Holder) -> int:
        videos = [rc for rc in holder.rcs if rc.startswith("video/")]
        if not videos:
            raise Refused("no_video", "your request holds no video channel to transmit on; request video/* as well")
        if len(videos) > 1:
            why = f"your request holds {' and '.join(videos)}, but the camera has one transmitter; request one of them"
            raise Refused("no_video", why)
        channel = self._channels.get(videos[0])
        if channel is None:
            known = ", ".join(sorted(self._channels)) or "none"
            raise Refused("no_video", f"this robot has no channel for {videos[0]}; it has {known}")
        return channel

    async def _send_all(self) -> None:
        while True:
            await self._queued.wait()
            self._queued.clear()
            while self._waiting:
                await self._send(self._waiting.popleft())

    async def _send(self, waiting: _Waiting) -> None:
        began, order = self._mesh.now(), waiting.order
        if isinstance(order, commands.RadioDrive):
            self._stopped_at = None
        reply = await self._ask_radio(waiting.radio, order, waiting.grant, ANSWER)
        self._latencies.append((self._mesh.now() - began) / SECOND)
        if reply is not None and reply.message is not None:
            result = reply.message.result
            if isinstance(order, commands.RadioDrive) and self._stopped_at is None:
                self._stopped_at = self._mesh.now() + round((_after(result) + order.lasts) * SECOND)
            waiting.resolve(result)
            return
        self._counts["refused"] += 1
        code, why = "unknown", f"{waiting.radio} did not answer: the command may have been sent or not"
        if reply is not None and reply.problem is not None:
            code, why = "radio_refused", f"{waiting.radio}: {reply.problem.message} ({reply.problem.code})"
        waiting.resolve(Refused(code, why))

    async def _ask_radio(self, radio: str, order: Any, grant: Grant | None, timeout: float) -> Reply[Done] | None:
        key = self._mesh.keys.command(radio, self._mesh.me)
        id_ = f"{self._rc.instances.instance}-{next(self._sent)}"
        message = Command(do=msgspec.to_builtins(order), grant=grant, ttl=timeout, id=id_)
        return await self._mesh.ask_one(key, message, Done, timeout=timeout)

    def _drop(self, outcome: Any, kind: type = object) -> None:
        for waiting in [waiting for waiting in self._waiting if isinstance(waiting.order, kind)]:
            self._waiting.remove(waiting)
            waiting.resolve(outcome)

    async def safe(self) -> None:
        """Halt the robot: wheels and transmitter. The RC is unwell until the radio accepts the halt."""
        self._restart_dead_man(turns=False)
        self._drop(Refused("ended", "the hold ended before the command was sent"))
        await self._send_urgent(commands.RadioHalt(self._id, self._rc.name), HALT_TRIES)

    def _restart_dead_man(self, *, turns: bool) -> None:
        """Restart the dead man's clock if the wheels turn, otherwise stop it."""
        if self._timer is not None:
            self._timer.cancel()
        self._stopped_at = None if turns else 0
        if turns:
            self._timer = self._rc.supervisor.call_later(self._dead_man, self._stop_unattended)

    def _stop_unattended(self) -> None:
        if self._stopped_at is not None and self._stopped_at <= self._mesh.now():
            return
        self._counts["dead_man_stops"] += 1
        self._drop(Refused("stale", "the command waited too long for the radio; send it again"), commands.RadioDrive)
        self._stopped_at = 0
        self._rc.supervisor.spawn(self._send_urgent(commands.RadioStop(self._id, self._rc.name), HALT_TRIES))

    async def _send_urgent(self, order: commands.RadioStop | commands.RadioHalt, tries: int) -> bool:
        """Send a stop or a halt by the robot's own radio. Return False if that failed; the RC is then unwell."""
        problem = ""
        for _ in range(tries):
            if not self._directory.hosts(self._radio):
                problem = f"{self._radio} is not offered"
                break
            reply = await self._ask_radio(self._radio, order, None, HALT_ANSWER)
            if reply is not None and reply.message is not None:
                self._counts["halts"] += isinstance(order, commands.RadioHalt)
                return True
            problem = f"{self._radio} does not answer"
            if reply is not None and reply.problem is not None:
                problem = f"{self._radio}: {reply.problem.message}"
        self._set_unsure(problem)
        return False

    def _set_unsure(self, why: str) -> None:
        """The robot can't be stopped, so it must not be driven either."""
        if self._rc.health != why:
            self._rc.unwell(why)
        self._unsure.set()

    async def _halt_until_sure(self) -> None:
        """Halt the robot whenever its state is unknown, and recover when that succeeds."""
        pause = PAUSES[0]
        await self._rc.informed.wait()
        while True:
            await self._unsure.wait()
            self._wake.clear()
            if self._rc.instances.state is InstanceState.STANDS_BY:
                # Another host's instance serves, and its holder has the robot.
                await asyncio.sleep(STANDBY_CHECK_S)
                continue
            if await self._send_urgent(commands.RadioHalt(self._id, self._rc.name), 1):
                self._unsure.clear()
                self._rc.recover()
                pause = PAUSES[0]
                continue
            if not await done_within(pause, self._wake.wait()):
                pause = min(2 * pause, PAUSES[1])

    def _on_directory_change(self) -> None:
        self._wake.set()
        if not self._directory.hosts(self._radio) and not self._unsure.is_set():
            self._set_unsure(f"{self._radio} is not offered")

    def _on_radio_state(self, _key: str, state: RcState) -> None:
        if state.rc != self._radio:
            return
        why = state.health if state.health != "ok" else state.unwell.why if state.unwell is not None else ""
        if why:
            self._set_unsure(f"{self._radio}: {why}")
        else:
            self._wake.set()

    def figures(self) -> Figures:
        latency = round(1000 * statistics.median(self._latencies), 2) if self._latencies else 0.0
        return {name: float(count) for name, count in self._counts.items()} | {"latency_ms": latency}


def _after(result: Any) -> float:
    """Seconds until a packet is sent, from the radio's answer."""
    after = result.get("after") if isinstance(result, dict) else None
    return float(after) if isinstance(after, int | float) and 0 <= after < 60 else 0.0
