"""Blocking code in the main thread is interrupted, by a signal: so a plain script's body ends with its hold.

An exception can be raised in a thread that blocks (in `time.sleep`, a read, a lock) only by a signal's handler, and
only the main thread runs those. The signal is SIGURG: it is ignored by default, so that one that comes late does no
harm, and hardly anybody uses it. The handler is there only while some body is, and the one before gets what is not for
us.
"""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Callable
from types import CodeType, FrameType
from typing import Any, Final, TypeVar

SIGNAL: Final = signal.SIGURG
AGAIN: Final = 0.1
"""Seconds until the signal is sent again: one that comes right before a blocking call does not interrupt it."""

F = TypeVar("F", bound=Callable[..., Any])


class InterruptibleBody:
    """A body in the main thread, between `enter` and `leave`. `make_error` gives what is raised in it."""

    def __init__(self, make_error: Callable[[], Exception]) -> None:
        self.make_error = make_error
        self.over = False
        """Whether it is to be interrupted."""
        self.told = False
        """Whether it knows."""
        self.waits = False
        """Whether it waits for just that."""

    def enter(self) -> None:
        """Only in the main thread."""
        global _previous
        if not _bodies:
            _previous = signal.signal(SIGNAL, _on_signal)
        _bodies.append(self)

    def leave(self) -> None:
        """The handler from before is back after the last one."""
        self.told = True
        if self in _bodies:
            _bodies.remove(self)
            if not _bodies:
                # None: one that was not set by Python, and can't be set again by it.
                signal.signal(SIGNAL, signal.SIG_DFL if _previous is None else _previous)

    async def interrupt(self) -> None:
        """Raises the error in the main thread: returns when it knows. Runs in any other thread."""
        self.over = True
        while not self.told:
            signal.pthread_kill(_main_thread(), SIGNAL)
            await asyncio.sleep(AGAIN)


def interruptible() -> bool:
    """Whether code of this thread can be interrupted."""
    return threading.current_thread() is threading.main_thread()


def uninterrupted(function: F) -> F:
    """Nothing is raised within `function`; what is due then is raised after it."""
    _quiet.add(function.__code__)
    return function


_bodies: Final[list[InterruptibleBody]] = []
"""Outermost first."""
_quiet: Final[set[CodeType]] = set()
_previous: Any = None
"""What handled the signal before."""


def _main_thread() -> int:
    ident = threading.main_thread().ident
    assert ident is not None  # noqa: S101 - it runs
    return ident


def _on_signal(number: int, frame: FrameType | None) -> None:
    due = next((body for body in _bodies if body.over and not body.told and not body.waits), None)
    if due is None:
        if callable(_previous) and not any(body.over for body in _bodies):
            _previous(number, frame)
        return
    while frame is not None:
        if frame.f_code in _quiet:
            return
        frame = frame.f_back
    due.told = True
    raise due.make_error()
