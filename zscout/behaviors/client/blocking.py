"""The synchronous client, for scripts and notebooks.

    with zscout.connect() as lab, lab.hold("survey", {"robot/scout33": {}}) as held:
        held.command("robot/scout33", {"name": "echo", "value": 1})

At the end of the hold a signal (`interruption.py`) raises `Revoked` in the body: only in the main thread, while the
body's function is on the stack, and not while a call of a C library ignores signals. Elsewhere the next use of `held`
raises it. After the hold, devices refuse all its commands.

In a notebook, acquire in one cell and release in another:

    held = lab.acquire("survey", {"robot/scout33": {}})
    held.release()"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator, Mapping
from concurrent import futures
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import uvloop

from zscout.behaviors.client.arc import Attempt, Held, Revoked, hold
from zscout.behaviors.client.client import Client, NoRcm
from zscout.behaviors.client.hold_notices import HoldNotice
from zscout.behaviors.client.interruption import InterruptibleBody, interruptible, uninterrupted
from zscout.behaviors.client.lab_status import LabStatus
from zscout.behaviors.client.request import HoldEnd, Needs
from zscout.config.fleet import Fleet
from zscout.mesh.exchange import SPAWN
from zscout.mesh.frames import Frame
from zscout.mesh.supervision import done_within
from zscout.types import SECOND, Grant

T = TypeVar("T")

log = logging.getLogger(__name__)

CLOSED: Final = "this lab is closed; zscout.connect() gives a new one"
FORKED: Final = f"this lab belongs to the parent of this forked process; join the mesh in a new process: {SPAWN}"
LAST_STEPS: Final = 1.0
"""Seconds for which a closing lab waits for the tasks that it cancels."""


class BlockingHeld:
    """A hold, inside the body of `with lab.hold(...)`, or from `lab.acquire(...)` to its release."""

    def __init__(self, lab: Lab, held: Held, attempt: BlockingAttempt) -> None:
        self._lab, self._held, self._attempt = lab, held, attempt
        self._body = InterruptibleBody(self._revoked)
        self._raised = False
        self._ending: HoldEnd | None = None
        """How the hold ended, if it was taken away."""
        self._watches: set[asyncio.Task[None]] = set()

    @property
    def grant(self) -> Grant:
        """Identifies the hold to its devices."""
        return self._held.grant

    @property
    def active(self) -> bool:
        """True while the hold is in force, as far as this client knows."""
        return self._held.active and not self._held.completed

    @property
    def completed(self) -> bool:
        """True if the hold ended after its minimum runtime, rather than before."""
        return self._held.completed

    @property
    def lost(self) -> bool:
        """True once the hold is over, for any reason."""
        return not self.active

    def on_lost(self, callback: Callable[[], object]) -> None:
        """Call `callback` in zscout's thread once the hold is over; at once if it is. A slow callback delays other
        holds of this lab."""
        self._lab.run(self._call_when_over(callback))

    @property
    def upcoming(self) -> list[HoldNotice]:
        """Notices of the waiting request, and of the booking or maintenance, to which this hold yields next."""
        return self._held.upcoming

    def on_notice(self, callback: Callable[[HoldNotice], object]) -> None:
        """Call `callback` in zscout's thread with each notice of a request, booking or maintenance to which the hold
        yields: at once for notices that are known. A slow callback delays other holds of this lab."""
        self._lab.run(self._call_when_noticed(callback))

    async def noticed(self) -> HoldNotice | None:
        """Wait, in any event loop, for the next notice. None: the hold is over."""
        return await asyncio.wrap_future(self._lab.submit(self._held.noticed()))

    async def over(self) -> None:
        """Wait, in any event loop, until the hold is over."""
        self._body.awaits_end = True
        try:
            await asyncio.wrap_future(self._lab.submit(self._held.over()))
            self._body.notified = True
        finally:
            self._body.awaits_end = False

    def release(self) -> None:
        """Give the devices back. Does nothing once the hold is over."""
        self._attempt._leave()

    @property
    def remaining(self) -> float:
        """Seconds left of the minimum runtime, in which only a request of higher priority preempts the hold."""
        return self._held.remaining

    def check(self) -> None:
        """Raise Revoked if the hold is over, and RuntimeError in a forked process."""
        if self._lab.forked:
            raise RuntimeError(FORKED)
        if not self.active:
            self._body.notified = True
            raise self._revoked()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the hold is over, at most `timeout` seconds; return True if it is. Does not raise Revoked."""
        self._body.awaits_end = True
        try:
            over = self._lab.run(self._over_within(timeout))
            self._body.notified |= over
        finally:
            self._body.awaits_end = False
        return over

    @property
    def rcs(self) -> list[str]:
        """The held devices, sorted."""
        return list(self._held.rcs)

    def rc(self, need: str) -> str:
        """Return the device that satisfies a need: `held.rc("framegrabber/*")`. Raises KeyError for a need that was not
        requested."""
        return self._held.rc(need)

    def command(self, need: str, do: Mapping[str, Any], *, ttl: float = 1.0) -> Any:
        """Have a held device carry out a command, and return its result. `need` is the device's name, or the pattern
        that it satisfies. If the device is not ready, the command waits for at most `ttl` seconds. Raises
        CommandRefused; KeyError for a pattern that was not requested; Revoked, at the first use after the hold is
        over."""
        if not self._raised and not self._lab.closed:
            self.check()
        return self._lab.run(self._held.command(need, do, ttl=ttl)).result

    def expect_outage(self, seconds: float, *, each: bool = False) -> dict[str, float]:
        """Announce an outage of the held devices of up to `seconds`, for example before a test reboots them: it does
        not end the hold. With `each`, this applies to every outage under this hold. Return by device how many seconds
        it tolerates: at most its `tolerate_max`, 0 if it does not support that. Raises CommandRefused."""
        return self._lab.run(self._held.expect_outage(seconds, each=each))

    def report_broken(self, reason: str, *needs: str) -> None:
        """Report devices of this hold broken (default: all), with a reason for people. After the hold they are granted
        to operators only, until `zscout maintain DEVICE --well`. Raises RequestRefused; KeyError for a need that was
        not requested; ValueError for a reason that is too long."""
        self._lab.run(self._held.report_broken(reason, *needs))

    def frames(self, need: str) -> Iterator[Frame]:
        """Yield the newest picture of a held framegrabber, again and again until the hold is over; a slow program
        misses some. Pictures of other holds are left out. Raises KeyError for a need that was not requested."""
        frames = self._held.frames(need)
        try:
            while (frame := self._lab.run(_next(frames))) is not None:
                yield frame
        finally:
            if not self._lab.closed:
                self._lab.run(_close(frames))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._held._words}>"

    async def _call_when_over(self, callback: Callable[[], object]) -> None:
        over = asyncio.create_task(self._held.over())
        self._watches.add(over)
        over.add_done_callback(self._watches.discard)
        over.add_done_callback(lambda task: task.cancelled() or callback())

    async def _call_when_noticed(self, callback: Callable[[HoldNotice], object]) -> None:
        self._held.on_notice(callback)

    async def _over_within(self, timeout: float | None) -> bool:
        return await done_within(timeout, self._held.over())

    def _revoked(self) -> Revoked:
        self._raised = True
        arc = self._held.arc
        over = HoldEnd("completed", "its minimum runtime is over") if self._held.active else self._ending
        return Revoked(arc, over)


async def _next(frames: AsyncGenerator[Frame, None]) -> Frame | None:
    return await anext(frames, None)


async def _close(frames: AsyncGenerator[Frame, None]) -> None:
    await frames.aclose()


class BlockingAttempt(AbstractContextManager[BlockingHeld, None]):
    def __init__(self, lab: Lab, attempt: Attempt, *, interrupt: bool) -> None:
        self._lab, self._attempt, self._interrupt = lab, attempt, interrupt
        self._held: BlockingHeld | None = None
        self._entering: asyncio.Task[Any] | None = None
        self._watch: asyncio.Task[None] | None = None

    def __enter__(self) -> BlockingHeld:
        try:
            self._held = BlockingHeld(self._lab, self._lab.run(self._granted()), self)
            interrupts = self._interrupt and interruptible()
            if interrupts:
                self._held._body.enter()
            self._lab.run(self._watch_over(self._held, interrupts=interrupts))
        except BaseException:
            self._leave()
            raise
        return self._held

    @uninterrupted
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        held = self._held
        assert held is not None  # noqa: S101 - entered before left
        if self._lab.forked:
            return
        unknown = kind is None and not held.active and not held.completed and not held._body.notified
        revoked = held._revoked() if unknown else None
        self._leave()
        if revoked is not None:
            raise revoked

    @uninterrupted
    def _leave(self) -> None:
        try:
            if not self._lab.closed:
                self._lab.run(self._end())
        finally:
            if self._held is not None:
                self._held._body.leave()

    async def _granted(self) -> Held:
        self._entering = asyncio.current_task()
        await self._lab.client.see_rcm()
        return await self._attempt.granted()

    async def _watch_over(self, held: BlockingHeld, *, interrupts: bool) -> None:
        self._watch = asyncio.create_task(self._when_over(held, interrupts=interrupts))

    async def _when_over(self, held: BlockingHeld, *, interrupts: bool) -> None:
        direct = self._lab.client.internals.direct_hold(held.grant)
        await held._held.over()
        if direct is None:
            await self._give_up(held)
        if interrupts:
            await held._body.interrupt()
        if interrupts and direct is not None:
            await asyncio.sleep(max(0, direct.gone_by - held._held.now()) / SECOND)
            log.warning("%s still cleans up, and the next hold begins: interrupting it", direct.arc.name)
            held._body.notified = False
            await held._body.interrupt()

    async def _give_up(self, held: BlockingHeld) -> None:
        """Leave the queue: if it were granted again, no body would use that hold."""
        arc = held._held.arc
        if not held.completed:
            held._ending = arc._ending
            if arc.open:
                await self._lab.client.end(arc)

    async def _end(self) -> None:
        if self._watch is not None:
            self._watch.cancel()
        if self._entering is not None and not self._entering.done():
            # Entering was interrupted: wait until it has withdrawn its request.
            await asyncio.wait([self._entering])
        arc, client = self._attempt.arc, self._lab.client
        if self._held is not None and (direct := client.internals.direct_hold(self._held.grant)) is not None:
            direct.returned()
        if arc is not None and arc.open:
            if self._held is not None and self._held.completed:
                client.internals.complete(arc)
            else:
                await client.end(arc)


class Lab:
    """A program's connection to the mesh, for code without asyncio. Close it, or use it with `with`. `client` is the
    `zscout.Client` behind it, whose event loop runs in a thread of its own."""

    def __init__(self, name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None) -> None:
        self._loop = uvloop.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="zscout", daemon=True)
        self._asking = threading.Lock()
        self._stopped, self._process = False, os.getpid()
        self._thread.start()
        try:
            self.client = self.run(Client.connect(name, fleet=fleet, host=host))
        except BaseException:
            self._stop()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def forked(self) -> bool:
        """True in a forked process, which has neither the thread nor the connection."""
        return self._process != os.getpid()

    @property
    def closed(self) -> bool:
        """True once the lab was closed, and in a forked process."""
        return self._stopped or self.forked

    def submit(self, coroutine: Coroutine[Any, Any, T]) -> futures.Future[T]:
        """Run a coroutine in the client's event loop. Raises RuntimeError if the lab is closed, or in a forked
        process."""
        if self.forked:  # without the lock, which another thread may have held at the fork
            coroutine.close()
            raise RuntimeError(FORKED)
        with self._asking:
            if not self.closed:
                return asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        coroutine.close()
        raise RuntimeError(CLOSED)

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the client's event loop, and return its result. Raises RuntimeError if the lab is closed,
        or is closed meanwhile by another thread."""
        future = self.submit(coroutine)
        try:
            return future.result()
        except futures.CancelledError:
            raise RuntimeError(CLOSED) from None
        except BaseException:
            future.cancel()
            raise

    @uninterrupted
    def close(self) -> None:
        """Give back everything held or requested, and leave the mesh."""
        if not self.closed:
            try:
                self.run(self.client.close())
            finally:
                self._stop()

    def hold(
        self,
        name: str,
        needs: Needs,
        *,
        priority: int = 0,
        min_runtime: float | None = None,
        keep: bool = True,
        direct: bool = False,
        confirmed: bool = False,
        timeout: float | None = None,
        interrupt: bool = True,
        comment: str = "",
        wait_for_device: bool | None = None,
        booking: str = "",
        until_done: bool = False,
    ) -> AbstractContextManager[BlockingHeld, None]:
        """Hold devices for the body of a `with`, whose target is a `BlockingHeld`.

        Entering waits for all of `needs`, at most `timeout` seconds; leaving gives them back. The hold is protected for
        `min_runtime` seconds (default: the fleet's, 60), and continues until a request of equal or higher priority
        waits for one of its devices. With `keep=False` it ends after `min_runtime`.

        When the hold ends, Revoked is raised in a body in the main thread, even if it blocks; its `outcome` is
        `completed` after the minimum runtime. In other threads, in a suspended body (of a generator or coroutine), and
        with `interrupt=False`, the next command or `held.check()` raises it.

        - `confirmed`: enter once all devices have confirmed the grant, instead of at the grant.
        - `direct`: the body also reaches its devices past zscout. After the end of the hold it has nine tenths of the
          devices' `settle` to clean up, for which the next holder waits; then Revoked is raised again.
        - `comment`: shown to other people.
        - `wait_for_device`: wait for an unknown device instead of raising RequestRefused.
        - `booking`: the id of a booking to take up. The request has its needs and priority, and waits for its next
          date.
        - `until_done`: without `min_runtime`, protect the hold as that of a command (`Client.request`).

        Entering raises TimeoutError; RequestRefused; Revoked if the request was ended elsewhere; NoRcm if no leader is
        visible within 3 s. Leaving raises Revoked if the hold was taken away and the body was not interrupted."""
        how: dict[str, Any] = {"priority": priority, "min_runtime": min_runtime, "keep": keep, "timeout": timeout}
        how |= {"comment": comment, "direct": direct, "confirmed": confirmed, "wait_for_device": wait_for_device}
        how |= {"booking": booking, "until_done": until_done}
        return BlockingAttempt(self, hold(self.client, name, needs, **how), interrupt=interrupt)

    def acquire(self, name: str, needs: Needs, **how: Any) -> BlockingHeld:
        """Hold devices until `release()`, across functions or cells of a notebook. Arguments and errors are those of
        `hold`. The end of the hold interrupts nothing: `held.lost` becomes true, callbacks of `held.on_lost` are
        called, and the next command raises Revoked. `close`, and the end of this process, give the devices back."""
        attempt = self.hold(name, needs, **how, interrupt=False)
        return attempt.__enter__()

    def status(self) -> LabStatus:
        """Return the devices of the fleet with their holders, and the waiting requests. It prints as a table, and shows
        as one in a notebook. Raises NoRcm."""
        return self.run(self._status())

    async def _status(self) -> LabStatus:
        await self.client.see_rcm()
        if (state := await self.client.state()) is None:
            raise NoRcm(f"the leader of fleet {self.client.fleet.name} did not answer; try again")
        return LabStatus(self.client.fleet.name, state)

    def __repr__(self) -> str:
        if self.closed:
            return f"<{type(self).__name__} closed>"
        client = self.client
        leader = f"led by {client.leader}" if client.leader else "without a leader"
        return f"<{type(self).__name__} {client.mesh.me} in fleet {client.fleet.name}, {leader}>"

    def _stop(self) -> None:
        with self._asking:
            if self._stopped:
                return
            self._stopped = True
        asyncio.run_coroutine_threadsafe(self._cancel_rest(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _cancel_rest(self) -> None:
        """Cancel all tasks, for whose results other threads may wait."""
        rest = asyncio.all_tasks() - {asyncio.current_task()}
        for task in rest:
            task.cancel()
        if rest:
            await asyncio.wait(rest, timeout=LAST_STEPS)


def connect(name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None) -> Lab:
    """Join the mesh, for code without asyncio. `name` must be unique on this host; the default is random. `fleet`
    defaults to the fleet file named by $ZSCOUT_FLEET, else to the default fleet. `host` defaults to the name of this
    machine. Raises MeshError, BadInput."""
    return Lab(name, fleet=fleet, host=host)
