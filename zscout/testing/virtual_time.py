"""An asyncio event loop whose time jumps to the next timer when no callback is ready, and simulated processes on it.

After trio's MockClock. For code without sockets and subprocesses, such as services on a mesh in memory: no real time
passes, and every run has the same order.

A `Process` represents a process of the operating system, with its own clock and random numbers; tasks started in its
context belong to it. It can be frozen, or killed so that no further line of it runs."""

from __future__ import annotations

import asyncio
import functools
import heapq
import random
import selectors
import weakref
from collections.abc import Callable, Coroutine
from contextlib import suppress
from contextvars import Context, ContextVar, copy_context
from typing import Any, Final, ParamSpec, TypeVar

from zscout.keyexpr import RANDOM

P = ParamSpec("P")
T = TypeVar("T")

MANY_TIMERS: Final = 100
"""Number of timers above which cancelled ones are removed as soon as they are half of them."""

START = 1_000.0
"""Time at which a loop starts, in seconds; not 0, which code may take for "never"."""

PROCESS: Final[ContextVar[Process | None]] = ContextVar("PROCESS", default=None)
"""The process whose code runs; None: code outside all simulated processes."""


class Deadlock(RuntimeError):
    """No task can continue, and no timer is left that would wake a task."""


class Process:
    """A simulated process. Its clock showed `boot` seconds at START and runs `rate` times as fast as virtual time."""

    def __init__(self, name: str, *, seed: object = 0, rate: float = 1.0, boot: float = 0.0) -> None:
        self.name, self.rate, self.boot = name, rate, boot
        self.stopped = False
        """True while frozen: due callbacks wait until `resume`."""
        self.dead = False
        self.main: asyncio.Task[None] | None = None
        self._parked: list[asyncio.Handle] = []
        self._tasks: weakref.WeakValueDictionary[int, asyncio.Task[Any]] = weakref.WeakValueDictionary()
        self._begun = 0
        self._context = copy_context()
        self._context.run(PROCESS.set, self)
        self._context.run(RANDOM.set, random.Random(f"{seed} {name}"))  # noqa: S311 - what failed once must fail again

    def run(self, f: Callable[..., T], *args: Any) -> T:
        """Call `f` as code of this process."""
        return self._context.copy().run(f, *args)

    def local(self, time: float) -> float:
        """Return the reading of this process's clock at a virtual time."""
        return self.boot + (time - START) * self.rate

    def virtual(self, local: float) -> float:
        return START + (local - self.boot) / self.rate

    def stop(self) -> None:
        self.stopped = True

    def resume(self) -> None:
        """Unfreeze, and run the callbacks that became due meanwhile, in their order."""
        self.stopped = False
        parked, self._parked = self._parked, []
        for handle in parked:
            handle._loop._ready.append(handle)  # type: ignore[attr-defined]

    def kill(self) -> None:
        """Kill the process: no more of its code runs, not even clean-up."""
        self.dead = True
        self._parked.clear()
        for _, task in sorted(self._tasks.items()):
            asyncio._unregister_task(task)
            task._log_destroy_pending = False  # type: ignore[attr-defined]
            coro = task.get_coro()
            if coro is not None:
                self.run(_close, coro)
        loop = asyncio.get_running_loop()
        if isinstance(loop, VirtualTimeLoop):
            loop.forget(self)

    def park(self, handle: asyncio.Handle) -> bool:
        """Return True if a due callback must not run: of a frozen process it is kept, of a killed process dropped."""
        if self.stopped and not self.dead:
            self._parked.append(handle)
        return self.stopped or self.dead

    def began(self, task: asyncio.Task[Any]) -> None:
        self._begun += 1
        self._tasks[self._begun] = task


def _close(coro: Any) -> None:
    # Closing runs `finally` blocks; these affect nothing, since the timers, tasks and mesh session of a killed process
    # are dead. Their errors are dropped.
    with suppress(BaseException):
        coro.close()


class _Handle(asyncio.Handle):
    __slots__ = ()

    def _run(self) -> None:
        process = self._context.get(PROCESS)  # type: ignore[attr-defined]
        if process is None or not process.park(self):
            super()._run()


class _TimerHandle(asyncio.TimerHandle):
    __slots__ = ()

    def _run(self) -> None:
        process = self._context.get(PROCESS)  # type: ignore[attr-defined]
        if process is None or not process.park(self):
            super()._run()


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    _ready: Any
    _timer_cancelled_count: int
    _stopping: bool
    _process_events: Callable[[Any], None]
    _selector: selectors.BaseSelector
    _clock_resolution: float
    _scheduled: list[tuple[float, Any]]
    """Pairs instead of asyncio's handles: the interpreter compares them natively, which is faster, in the same
    order."""

    def __init__(self) -> None:
        self._now = START
        self._threads: set[object] = set()
        super().__init__(_JumpingSelector(self))
        self._clock_resolution = 1e-9
        self.isolated = False
        """True: no thread and no file wakes this loop, so it never polls for them."""
        self.set_task_factory(_begin)

    def time(self) -> float:
        """Return the time by the clock of the calling process."""
        process = PROCESS.get()
        return self._now if process is None else process.local(self._now)

    @property
    def now(self) -> float:
        """Virtual time, in seconds."""
        return self._now

    def jump(self, seconds: float | None) -> bool:
        """Advance virtual time. Returns False, without advancing, while a thread works in real time. Raises Deadlock
        for None."""
        if self._threads:
            return False
        if seconds is None:
            raise Deadlock("no task can continue, and no timer is left to wake one")
        self._now += seconds
        return True

    def _run_once(self) -> None:
        """As in asyncio and in its order, but without polling while the loop is isolated."""
        self._forget_cancelled()
        scheduled, ready = self._scheduled, self._ready
        if not self.isolated or not (ready or self._stopping or scheduled):
            # An overdue timer, as after a direct `jump`, must not turn the clock back.
            left = max(0.0, scheduled[0][0] - self._now) if scheduled else None
            timeout = 0.0 if ready or self._stopping else left
            self._process_events(self._selector.select(timeout))
        elif not (ready or self._stopping):
            self._now += max(0.0, scheduled[0][0] - self._now)
        end = self._now + self._clock_resolution
        while scheduled and scheduled[0][0] < end:
            _, timer = heapq.heappop(scheduled)
            timer._scheduled = False
            ready.append(timer)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle._cancelled:
                handle._run()

    def _forget_cancelled(self) -> None:
        scheduled = self._scheduled
        if len(scheduled) > MANY_TIMERS and self._timer_cancelled_count > len(scheduled) / 2:
            for _, timer in scheduled:
                timer._scheduled = not timer._cancelled
            scheduled[:] = [entry for entry in scheduled if entry[1]._scheduled]
            heapq.heapify(scheduled)
            self._timer_cancelled_count = 0
        while scheduled and scheduled[0][1]._cancelled:
            _, timer = heapq.heappop(scheduled)
            timer._scheduled = False
            self._timer_cancelled_count -= 1

    def forget(self, process: Process) -> None:
        """Drop the callbacks of a killed process's timers, to free their memory. The timers remain in the heap."""
        for _, timer in self._scheduled:
            if timer._context.get(PROCESS) is process and not timer._cancelled:
                timer._callback, timer._args = _do_nothing, ()

    def call_at(  # type: ignore[override]  # like asyncio's own
        self, when: float, callback: Callable[..., object], *args: Any, context: Context | None = None
    ) -> asyncio.TimerHandle:
        process = PROCESS.get() if context is None else context.get(PROCESS)
        timer = _TimerHandle(when if process is None else process.virtual(when), callback, args, self, context)
        heapq.heappush(self._scheduled, (timer._when, timer))  # type: ignore[attr-defined]
        timer._scheduled = True  # type: ignore[attr-defined]
        return timer

    def _call_soon(self, callback: Callable[..., object], args: Any, context: Context | None) -> asyncio.Handle:
        handle = _Handle(callback, args, self, context)
        self._ready.append(handle)
        return handle

    def call_soon_threadsafe(  # type: ignore[override]  # like asyncio's own
        self, callback: Callable[..., object], *args: Any, context: Context | None = None
    ) -> asyncio.Handle:
        if self.isolated:
            return self._call_soon(callback, args, context)
        return super().call_soon_threadsafe(callback, *args, context=context)

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:  # type: ignore[override]  # like asyncio's own
        if PROCESS.get() is not None:
            # In a simulation threads take no time and run in a fixed order.
            done: asyncio.Future[T] = self.create_future()
            try:
                done.set_result(func(*args))
            except Exception as error:  # noqa: BLE001 - raised where the future is awaited
                done.set_exception(error)
            return done
        future = super().run_in_executor(executor, func, *args)
        self._threads.add(future)
        future.add_done_callback(self._threads.discard)
        return future

    async def shutdown_default_executor(self, *args: Any) -> None:
        self._threads.add(self)
        await super().shutdown_default_executor(*args)


def _do_nothing() -> None:
    """Callback of a killed process's timers."""


def _begin(loop: asyncio.AbstractEventLoop, coro: Any, **how: Any) -> asyncio.Task[Any]:
    task: asyncio.Task[Any] = asyncio.Task(coro, loop=loop, **how)
    context = how.get("context")
    process = PROCESS.get() if context is None else context.get(PROCESS)
    if process is not None:
        process.began(task)
        if process.dead:  # started by clean-up code of the killed process
            process.kill()
    return task


class _JumpingSelector(selectors.DefaultSelector):
    def __init__(self, loop: VirtualTimeLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = [] if self._loop.isolated else super().select(0)
        if ready or timeout == 0:
            return ready
        return [] if self._loop.jump(timeout) else super().select(timeout)


def run(coro: Coroutine[Any, Any, T]) -> T:
    """`asyncio.run` in virtual time."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(coro)


def in_virtual_time(test: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:
    """Wrap an async function, such as a test, in an ordinary function that runs it in virtual time."""

    @functools.wraps(test)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        return run(test(*args, **kwargs))

    return call
