"""Supervised tasks, timers and handlers, which fail together; the host's clock; stalls of the process."""

from __future__ import annotations

import asyncio
import functools
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, Final, ParamSpec, Self, TypeVar
from weakref import WeakSet

from zscout.keyexpr import BadName
from zscout.mesh.exchange import Refused
from zscout.types import SECOND, Ns

log = logging.getLogger(__name__)

CLOSE_TIMEOUT = 5.0  # seconds that `close` waits for cancelled tasks
STALL_PERIOD_S = 0.2  # seconds between two readings of the clock
STALL_THRESHOLD_NS = SECOND // 5  # ns by which a reading is late that means a stall
AFTERMATH_NS = SECOND // 4  # ns after a stall within which an arrival may have waited through it

P = ParamSpec("P")
T = TypeVar("T")


class Supervisor:
    """Owns the tasks, timers and guarded handlers of one service.

    The first exception is logged with its traceback, `on_failure(error)` is called once, and all others are cancelled.
    Later exceptions are only logged. A failed or cancelled supervisor is not reused."""

    def __init__(self, name: str, on_failure: Callable[[Exception], object]) -> None:
        self.name = name
        self.error: Exception | None = None
        self._on_failure = on_failure
        self.active = True  # False after a failure or a cancellation
        self._tasks: dict[asyncio.Task[Any], None] = {}
        self._timers: WeakSet[asyncio.TimerHandle] = WeakSet()

    def spawn(self, coro: Coroutine[Any, Any, T], name: str | None = None) -> asyncio.Task[T]:
        """Run `coro` as a task, cancelled at once if the supervisor is not active."""
        task = asyncio.create_task(coro, name=f"{self.name}: {name or getattr(coro, '__name__', 'task')}")
        self._tasks[task] = None
        task.add_done_callback(self._done)
        if not self.active:
            task.cancel()
        return task

    def call_later(self, delay: float, f: Callable[..., object], *args: Any) -> asyncio.TimerHandle:
        handle = asyncio.get_running_loop().call_later(delay, self._call, f, *args)
        if not self.active:
            handle.cancel()
        self._timers.add(handle)
        return handle

    def guard(self, f: Callable[P, object]) -> Callable[P, None]:
        """Wrap `f` as a handler for the mesh, which does nothing once the supervisor is inactive. An exception fails
        the service, and raises Refused (code `internal`) to answer a query; Refused and BadName pass through."""

        @functools.wraps(f)
        def guarded(*args: P.args, **kwargs: P.kwargs) -> None:
            if not self.active:
                return
            try:
                f(*args, **kwargs)
            except (Refused, BadName):
                raise
            except Exception as error:
                self.fail(error)
                raise Refused("internal", "the request failed here; see this node's log") from error

        return guarded

    def fail(self, error: Exception) -> None:
        """Fail the service with `error`, as if one of its tasks had raised it."""
        if error is self.error:  # raised again by a task that awaited the failed one
            return
        log.error("%s failed", self.name, exc_info=error)
        if not self.active:
            return
        self.error, self.active = error, False
        try:
            self._on_failure(error)
        except Exception:
            log.exception("%s could not handle its failure", self.name)
        finally:
            self.cancel()

    def cancel(self) -> None:
        """Cancel all tasks and timers, without waiting for them."""
        self.active = False
        for handle in tuple(self._timers):
            handle.cancel()
        for task in tuple(self._tasks):
            # The task's loop may have stopped.
            if task is not asyncio.current_task(task.get_loop()):
                task.cancel()

    async def close(self) -> None:
        """Cancel all, wait for all tasks but the calling one, and log those that run longer than CLOSE_TIMEOUT."""
        self.cancel()
        tasks = self._tasks.keys() - {asyncio.current_task()}
        if tasks:
            _, stuck = await asyncio.wait(tasks, timeout=CLOSE_TIMEOUT)
            for task in stuck:
                log.error("%s did not end within %g s of its cancellation", task.get_name(), CLOSE_TIMEOUT)

    def _call(self, f: Callable[..., object], *args: Any) -> None:
        try:
            f(*args)
        except Exception as error:  # noqa: BLE001 - `fail` logs it
            self.fail(error)

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.pop(task, None)
        if not task.cancelled() and isinstance(error := task.exception(), Exception):
            self.fail(error)


@asynccontextmanager
async def supervised(name: str) -> AsyncIterator[Supervisor]:
    """A supervisor for the body of an `async with`: a failure cancels the body, and is raised when it ends."""
    body = asyncio.current_task()
    assert body is not None  # noqa: S101 - a coroutine runs in a task
    supervisor = Supervisor(name, lambda _error: body.cancel())
    try:
        yield supervisor
    except asyncio.CancelledError:
        # As in asyncio.timeout: a simultaneous cancellation from outside is not swallowed.
        if supervisor.error is not None and body.uncancel() == 0:
            raise supervisor.error from None
        raise
    finally:
        await supervisor.close()


async def done_within(seconds: float | None, work: Awaitable[object]) -> bool:
    """Await `work`, and cancel it after `seconds`; return True if it finished."""
    try:
        async with asyncio.timeout(seconds) as limit:
            await work
    except TimeoutError:
        if not limit.expired():  # raised by `work` itself
            raise
        return False
    return True


class Alarm:
    """One timer of a supervised service. It is never moved to a later time: most deadlines move before they are
    reached. When it rings early, `ring` has to set it again."""

    def __init__(self, now: Callable[[], Ns], supervisor: Supervisor, ring: Callable[[], object]) -> None:
        self._now, self._supervisor, self._ring = now, supervisor, ring
        self._timer: asyncio.TimerHandle | None = None
        self._at: Ns = 0

    def set(self, at: Ns | None) -> None:
        if at is None or (self._timer is not None and self._at <= at):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._at = at
        self._timer = self._supervisor.call_later(max(0.0, (at - self._now()) / SECOND), self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        self._ring()


class HostClock:
    """Monotonic, also while the machine is suspended. Not comparable between hosts."""

    def now(self) -> Ns:
        """Nanoseconds since boot."""
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


clock: Final = HostClock()


class StallWatch:
    """Last stall of this process (stopped, suspended or starved) by the clock `now`. One watch per process."""

    def __init__(self, now: Callable[[], Ns]) -> None:
        self.length: Ns = 0
        self.ended: Ns = 0
        self._now = now
        self._last = now()
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> Self:
        self._last = self._now()
        self._timer = asyncio.get_running_loop().call_later(STALL_PERIOD_S, self._sample_clock)
        return self

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def check(self) -> None:
        """Record a stall that has just ended."""
        now = self._now()
        gap = now - self._last - round(STALL_PERIOD_S * SECOND)
        if gap > STALL_THRESHOLD_NS:
            self.length, self.ended = gap, now
            log.warning("process stalled for %.2f s", gap / SECOND)
        self._last = now

    def waited_through(self, arrived: Ns) -> Ns:
        """How long (ns) a stall may have delayed an item before this process received it, at `arrived`."""
        self.check()
        return self.length if self.length and arrived <= self.ended + AFTERMATH_NS else 0

    def fresh(self) -> bool:
        """Return True if a stall ended so recently that arrivals during it may not have been handled."""
        self.check()
        return bool(self.length) and self._now() - self.ended <= AFTERMATH_NS

    def _sample_clock(self) -> None:
        self.check()
        self._timer = asyncio.get_running_loop().call_later(STALL_PERIOD_S, self._sample_clock)
