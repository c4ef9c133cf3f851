"""An asyncio event loop whose time jumps to the next timer when nothing is left to do.

The idea is that of trio's MockClock. For what runs in one process without sockets and subprocesses, such as
services on a mesh in memory: an hour of theirs passes in milliseconds, always in the same order."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")

START = 1_000.0
"""The time at which a loop starts, in seconds: not zero, which often stands for "never"."""


class Deadlock(RuntimeError):
    """No task can go on, and no timer is left that would wake one."""


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self._now = START
        self._threads: set[object] = set()
        super().__init__(_JumpingSelector(self.jump))
        self._clock_resolution = 1e-9

    def time(self) -> float:
        return self._now

    def jump(self, seconds: float | None) -> bool:
        """Lets time pass. Whether it did: not while a thread is at work, which takes real time."""
        if self._threads:
            return False
        if seconds is None:
            raise Deadlock("no task can go on, and no timer is left that would wake one")
        self._now += seconds
        return True

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:  # type: ignore[override]  # like asyncio's own
        future = super().run_in_executor(executor, func, *args)
        self._threads.add(future)
        future.add_done_callback(self._threads.discard)
        return future

    async def shutdown_default_executor(self, *args: Any) -> None:
        self._threads.add(self)
        await super().shutdown_default_executor(*args)


class _JumpingSelector(selectors.DefaultSelector):
    def __init__(self, jump: Callable[[float | None], bool]) -> None:
        super().__init__()
        self._jump = jump

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or timeout == 0:
            return ready
        return [] if self._jump(timeout) else super().select(timeout)


def run(coro: Coroutine[Any, Any, T]) -> T:
    """`asyncio.run` in virtual time."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(coro)
