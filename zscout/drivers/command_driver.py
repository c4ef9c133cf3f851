"""A device that is switched by your own commands: `start`, `stop`, `safe` and `health` of its table.

They run on the node, as its user, one at a time, each for at most `timeout`. When a command has ended, all processes
left in its process group are killed. A device that can't be started or made safe is lost; if its `health` fails, it is
unwell. It is tried again in both cases."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

from zscout.config.devices import CommandRc, Words
from zscout.drivers.driver import Driver, RcHandle
from zscout.drivers.instances import InstanceState
from zscout.drivers.own import own
from zscout.mesh.supervision import done_within
from zscout.messages import Figures, Holder, Parameter
from zscout.types import SECOND

log = logging.getLogger(__name__)

KEPT_OUTPUT: Final = 4_096
"""Bytes that are kept of the end of a command's output."""
READ_PAUSE_S: Final = 0.02
"""Between two reads of KEPT_OUTPUT bytes: this limits the rate at which a command can write."""
LAST_OUTPUT_S: Final = 0.2
"""Time to read a command's last output, and to wait for its killed process."""
MAX_REASON: Final = 160
"""Characters of its last line that are published."""
START_WAIT_S: Final = 0.1
"""How long the RC waits for `start` and carries out no commands. Later ones are answered `settling`."""
OPENING: Final = 1.0
"""Seconds that a node waits for the first `safe` and `health` before it offers the RC as lost."""
RETRY_PAUSES_S: Final = (1.0, 60.0)
"""Until a failed device is tried again: the first and the longest pause."""


def _retry_pause(failures: int) -> float:
    """Seconds until the next try, by the number of `failures` before the last."""
    return min(RETRY_PAUSES_S[0] * 2.0 ** min(failures, 16), RETRY_PAUSES_S[1])


@dataclass(frozen=True, slots=True)
class Ended:
    problem: str
    """Empty on success; otherwise a text with the last line of its output."""
    seconds: float
    gave_way: bool = False
    """True if it was ended for another command, without a result."""


class CommandDriver(Driver):
    """An exclusive device. The environment of its commands has ZSCOUT_DO (start, stop, safe or health) and ZSCOUT_RC;
    for `start` and `stop` also ZSCOUT_ARC, ZSCOUT_CLIENT and ZSCOUT_PARAMETERS (JSON)."""

    Options = CommandRc
    tolerate = 60.0
    tolerate_max = 3_600.0

    def __init__(self, rc: CommandRc) -> None:
        super().__init__(rc)
        self.activation = rc.activation / SECOND
        self.begin_within = rc.timeout / SECOND if rc.start else 0.0
        self._table = rc
        self._holder: Holder | None = None
        self._started: Holder | None = None
        """The holder for which the device was started, until it is stopped."""
        self._starting: asyncio.Task[None] | None = None
        self._started_by = 0.0
        """When `_starting` ends at the latest, by the loop's clock."""
        self._unsure = "it was not made safe yet"
        """Why its state is unknown; empty once `safe` has succeeded."""
        self._lost = ""
        """Why it can't be held."""
        self._failed_starts = 0
        """Failed starts in a row."""
        self._not_before = 0.0
        """After a failed start it is not offered before this time, by the loop's clock."""
        self._checked = asyncio.Event()
        self._failure = asyncio.Event()
        """Set when the device is lost or unwell."""
        self._give_way = asyncio.Event()
        """Set while a command waits that is more urgent than `health`."""
        self._one_at_a_time = asyncio.Lock()
        self._counts = Counter(starts=0, failures=0)
        self._start_seconds = 0.0

    async def open(self, rc: RcHandle) -> None:
        self._rc = own(rc)
        rc.supervisor.spawn(self._keep_well())
        if not self._rc.informed.is_set() or not await done_within(OPENING, self._checked.wait()):
            self._lose(self._unsure or "its health is not known yet")

    async def begin(self, holder: Holder) -> None:
        handed_over = self._holder is not None
        self._holder = holder
        if handed_over:
            return
        self._counts["starts"] += 1
        self._started = holder
        commands = 2 if self._one_at_a_time.locked() else 1
        self._started_by = asyncio.get_running_loop().time() + commands * self._table.timeout / SECOND
        self._starting = self._rc.supervisor.spawn(self._start(holder))
        await asyncio.wait({self._starting}, timeout=START_WAIT_S)

    def begins_for(self) -> float:
        if self._starting is None or self._starting.done():
            return 0.0
        return max(LAST_OUTPUT_S, self._started_by - asyncio.get_running_loop().time())

    async def _start(self, holder: Holder) -> None:
        ended = await self._run("start", self._table.start, holder)
        self._start_seconds = ended.seconds
        if ended.problem:
            pause = _retry_pause(self._failed_starts)
            self._failed_starts += 1
            self._unsure, why = ended.problem, ended.problem
            self._not_before = asyncio.get_running_loop().time() + pause
            if self._failed_starts > 1:
                why += f" ({self._failed_starts} times in a row; tried again in {pause:g} s)"
            self._lose(why)
        else:
            self._failed_starts = 0

    async def end(self, holder: Holder) -> None:
        self._holder = None

    async def safe(self) -> None:
        """Run `stop` first if the device was started."""
        if self._stands_by and self._started is None:
            return
        self._holder, started, self._started = None, self._started, None
        self._unsure, before = "it is being made safe", self._unsure
        try:
            if self._starting is not None and not self._starting.done():
                self._starting.cancel()
                await asyncio.wait({self._starting})
            if started is not None and (why := (await self._run("stop", self._table.stop, started)).problem):
                log.warning("%s: %s", self._rc.name, why)
            self._unsure = (await self._run("safe", self._table.safe)).problem
        except asyncio.CancelledError:  # its RC waits no longer
            self._lose(before or "it was not made safe in time")
            raise
        if self._unsure:
            self._lose(self._unsure)

    def parameters(self) -> list[Parameter]:
        return [Parameter(name, bound=bound) for name, bound in self._table.parameters.items()]

    def figures(self) -> Figures:
        return {**self._counts, "start_seconds": round(self._start_seconds, 3)}

    @property
    def _stands_by(self) -> bool:
        """Return True if another host's instance serves: both may control the same device, so leave it alone."""
        return self._rc.instances.state is InstanceState.STANDS_BY

    def _lose(self, why: str, *, for_good: bool = True) -> None:
        """Report the device as lost, or as unwell if not `for_good`."""
        if why != self._lost:
            self._lost = why
            (self._rc.fail if for_good else self._rc.unwell)(why)
        self._failure.set()

    async def _keep_well(self) -> None:
        """Check a device that is well each `every` seconds, and others at growing intervals until they are well."""
        every = self._table.every / SECOND if self._table.health else None
        tries = 0
        await self._rc.informed.wait()
        while True:
            await self._check()
            self._checked.set()
            if not self._lost:
                tries = 0
                self._failure.clear()
                if not await done_within(every, self._failure.wait()):
                    continue
            if self._stands_by:
                tries = 0
            again = _retry_pause(tries)
            tries += 1
            again = again if every is None or self._unsure else min(again, every)
            await asyncio.sleep(max(again, self._not_before - asyncio.get_running_loop().time()))

    async def _check(self) -> None:
        """Make the device safe if its state is unknown, then check its health."""
        if self._stands_by:
            self._unsure = "it was not made safe: it is on standby"
        elif self._unsure and self._holder is None:
            self._unsure = (await self._run("safe", self._table.safe)).problem
        if not self._unsure:
            ended = await self._run("health", self._table.health)
            if ended.gave_way:
                return
            if ended.problem and not self._unsure:  # a start may have failed before it
                self._lose(ended.problem, for_good=False)
                return
        if self._unsure:
            self._lose(self._unsure)
        elif self._lost and asyncio.get_running_loop().time() >= self._not_before:
            self._lost = ""
            self._rc.recover()

    async def _run(self, do: str, words: Words, holder: Holder | None = None) -> Ended:
        if not words:
            return Ended("", 0.0)
        env = os.environ | {"ZSCOUT_DO": do, "ZSCOUT_RC": self._rc.name}
        if holder is not None:
            # Not all clients' parameters were checked against the bounds when they were requested.
            bounds, asked = self._table.parameters, holder.params.items()
            params = {name: float(amount) for name, amount in asked if name in bounds and amount <= bounds[name]}
            env |= {"ZSCOUT_ARC": holder.arc, "ZSCOUT_CLIENT": holder.client, "ZSCOUT_PARAMETERS": json.dumps(params)}
        if do != "health":
            self._give_way.set()
        async with self._one_at_a_time:
            if do != "health":
                self._give_way.clear()
            give_way = self._give_way if do == "health" else asyncio.Event()  # never set
            ended = await run_bounded(words, env, self._table.timeout / SECOND, give_way)
        if ended.problem:
            self._counts["failures"] += 1
        return replace(ended, problem=ended.problem and f"{do} {ended.problem}")


async def run_bounded(words: Words, env: Mapping[str, str], timeout: float, give_way: asyncio.Event) -> Ended:
    """Run a program in a new session for at most `timeout` seconds, or until `give_way` is set. At its end, and when
    cancelled, kill all of its process group."""
    began = time.monotonic()
    try:
        reading, writing = os.pipe()
    except OSError as error:
        return Ended(f"can't be run: {words[0]}: {error.strerror or error}", 0.0)
    reader = asyncio.StreamReader(limit=KEPT_OUTPUT)
    protocol = asyncio.StreamReaderProtocol(reader)
    pipe, _ = await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, os.fdopen(reading, "rb", 0))
    output = OutputTail(reader)
    draining = asyncio.ensure_future(output.drain())
    try:
        try:
            process = await asyncio.create_subprocess_exec(
                *words, stdin=subprocess.DEVNULL, stdout=writing, stderr=writing, env=env, start_new_session=True
            )
        except OSError as error:
            return Ended(f"can't be run: {words[0]}: {error.strerror or error}", 0.0)
        finally:
            os.close(writing)
        waiting, yielding = asyncio.ensure_future(process.wait()), asyncio.ensure_future(give_way.wait())
        try:
            await asyncio.wait({waiting, yielding}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
            done = waiting.done()
        finally:
            yielding.cancel()
            # The number stays that group's as long as it has processes.
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            # A process that hangs in a kernel driver can't be killed: do not wait for it.
            await asyncio.wait({waiting}, timeout=LAST_OUTPUT_S)
        await asyncio.wait({draining}, timeout=LAST_OUTPUT_S)
        seconds = time.monotonic() - began
        if not done:
            if give_way.is_set():
                return Ended("", seconds, gave_way=True)
            return Ended(f"was killed: it took longer than {timeout:g} s{output.last_line}", seconds)
        code = waiting.result()
        if not code:
            return Ended("", seconds)
        how = f"ended with exit code {code}" if code > 0 else f"ended by signal {-code}"
        return Ended(how + output.last_line, seconds)
    finally:
        draining.cancel()
        pipe.close()


class OutputTail:
    def __init__(self, reader: asyncio.StreamReader) -> None:
        self._reader = reader
        self._kept = b""

    async def drain(self) -> None:
        while some := await self._reader.read(KEPT_OUTPUT):
            self._kept = (self._kept + some)[-KEPT_OUTPUT:]
            await asyncio.sleep(READ_PAUSE_S)

    @property
    def last_line(self) -> str:
        """The last line after ": ", to append to the outcome; empty without output."""
        lines = self._kept.decode(errors="replace").split("\n")
        shown = ("".join(char if char.isprintable() else " " for char in line).strip() for line in reversed(lines))
        last = next(filter(None, shown), "")
        return f": {last[:MAX_REASON]}" if last else ""
