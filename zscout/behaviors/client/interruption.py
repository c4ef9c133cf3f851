"""Interruption of blocking code in the main thread by a signal, so that the body of a plain script ends with its hold.

In a thread that blocks (in `time.sleep`, a read, a lock), only the handler of a signal can raise an exception, and only
the main thread runs handlers. The signal is SIGURG, which is rarely used, and ignored by default, so that a late signal
does no harm. The handler is installed only while there is a body; it passes other signals to the previous handler.

The exception is raised only while the body's function is on the stack. A notebook's cell may have returned, or a
generator or coroutine be suspended, while its hold continues; then the exception would end the event loop that runs.
"""

from __future__ import annotations

import asyncio
import inspect
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import CodeType, FrameType
from typing import Any, Final, TypeVar

SIGNAL: Final = signal.SIGURG
REPEAT_AFTER: Final = 0.1
"""Seconds until the signal is repeated: if it arrives right before a blocking call, it does not interrupt that."""
LONGEST_REPEAT: Final = 5.0
"""Longest time in seconds until it is repeated, while the body's function is not on the stack."""

F = TypeVar("F", bound=Callable[..., Any])


class InterruptibleBody:
    """A body in the main thread, between `enter` and `leave`. `make_error` returns the error to raise in it."""

    def __init__(self, make_error: Callable[[], Exception]) -> None:
        self.make_error = make_error
        self.over = False
        """True once it must be interrupted."""
        self.notified = False
        """True once the body has got the error, or learned of the end in another way."""
        self.awaits_end = False
        """True while the body itself waits for the end of its hold."""
        self._frame: FrameType | None = None
        self._off_stack = False
        """True if its function was not on the stack at the last signal."""

    def enter(self) -> None:
        """Begin the body. Only in the main thread."""
        global _previous
        self._frame = _body_of(sys._getframe(1))
        if not _bodies:
            _previous = signal.signal(SIGNAL, _on_signal)
        _bodies.append(self)

    def leave(self) -> None:
        """End the body; the last one to leave restores the previous handler."""
        self.notified, self._frame = True, None
        if self in _bodies:
            _bodies.remove(self)
            if not _bodies:
                # None: the handler was not set by Python, which can't restore it.
                signal.signal(SIGNAL, signal.SIG_DFL if _previous is None else _previous)

    async def interrupt(self) -> None:
        """Raise the error in the main thread; return once the body knows. Call it in any other thread."""
        self.over, pause = True, REPEAT_AFTER
        while not self.notified:
            signal.pthread_kill(_main_thread(), SIGNAL)
            await asyncio.sleep(pause)
            pause = min(2 * pause, LONGEST_REPEAT) if self._off_stack else REPEAT_AFTER

    def is_on(self, frames: list[FrameType]) -> bool:
        self._off_stack = self._frame not in frames
        return not self._off_stack


def interruptible() -> bool:
    """Return True if code in this thread can be interrupted."""
    return threading.current_thread() is threading.main_thread()


def uninterrupted(function: F) -> F:
    """Decorate a function in which nothing may be raised; a due error is raised after it."""
    _uninterrupted.add(function.__code__)
    return function


_bodies: Final[list[InterruptibleBody]] = []
"""Outermost first."""
_uninterrupted: Final[set[CodeType]] = set()
_previous: Any = None
"""The previous handler."""


def _main_thread() -> int:
    ident = threading.main_thread().ident
    assert ident is not None  # noqa: S101 - it runs
    return ident


def _on_signal(number: int, frame: FrameType | None) -> None:
    if not any(body.over for body in _bodies):
        if callable(_previous):
            _previous(number, frame)
        return
    frames = [*_outwards(frame)]
    if any(outer.f_code in _uninterrupted for outer in frames):
        return
    due = (body for body in _bodies if body.over and not body.notified and not body.awaits_end)
    if (body := next((body for body in due if body.is_on(frames)), None)) is not None:
        body.notified = True
        raise body.make_error()


def _outwards(frame: FrameType | None) -> Iterator[FrameType]:
    while frame is not None:
        yield frame
        frame = frame.f_back


def _body_of(frame: FrameType) -> FrameType | None:
    """The frame of the body of a `with` entered from `frame`: of the user of a generator with `@contextmanager`, which
    is suspended."""
    frames = [*_outwards(frame)]
    for use, caller in zip(frames, [*frames[1:], None], strict=True):
        if _module(use).startswith(("contextlib", __package__)):
            continue
        if not (use.f_code.co_flags & inspect.CO_GENERATOR and caller is not None and _module(caller) == "contextlib"):
            return use
    return None


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", ""))
