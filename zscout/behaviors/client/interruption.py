"""Blocking code in the main thread is interrupted, by a signal: so a plain script's body ends with its hold.

An exception can be raised in a thread that blocks (in `time.sleep`, a read, a lock) only by a signal's handler, and
only the main thread runs those. The signal is SIGURG: it is ignored by default, so that one that comes late does no
harm, and hardly anybody uses it. The handler is there only while some body is, and the one before gets what is not for
us.

It is raised only while the function of the body is on the stack. A notebook's cell, a generator or a coroutine may have
returned, or be suspended, while its hold goes on: what runs then is an event loop, which the exception would end.
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
AGAIN: Final = 0.1
"""Seconds until the signal is sent again: one that comes right before a blocking call does not interrupt it."""
SELDOM: Final = 5.0
"""Seconds until then, at most, while the function of the body is not on the stack."""

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
        self._frame: FrameType | None = None
        self._away = False
        """Whether its function was not on the stack when the last signal came."""

    def enter(self) -> None:
        """Only in the main thread."""
        global _previous
        self._frame = _body_of(sys._getframe(1))
        if not _bodies:
            _previous = signal.signal(SIGNAL, _on_signal)
        _bodies.append(self)

    def leave(self) -> None:
        """The handler from before is back after the last one."""
        self.told, self._frame = True, None
        if self in _bodies:
            _bodies.remove(self)
            if not _bodies:
                # None: one that was not set by Python, and can't be set again by it.
                signal.signal(SIGNAL, signal.SIG_DFL if _previous is None else _previous)

    async def interrupt(self) -> None:
        """Raises the error in the main thread: returns when it knows. Runs in any other thread."""
        self.over, pause = True, AGAIN
        while not self.told:
            signal.pthread_kill(_main_thread(), SIGNAL)
            await asyncio.sleep(pause)
            pause = min(2 * pause, SELDOM) if self._away else AGAIN

    def is_on(self, frames: list[FrameType]) -> bool:
        """Return True if its function is on this stack."""
        self._away = self._frame not in frames
        return not self._away


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
    if not any(body.over for body in _bodies):
        if callable(_previous):
            _previous(number, frame)
        return
    frames = [*_outwards(frame)]
    if any(one.f_code in _quiet for one in frames):
        return
    due = (body for body in _bodies if body.over and not body.told and not body.waits)
    if (body := next((body for body in due if body.is_on(frames)), None)) is not None:
        body.told = True
        raise body.make_error()


def _outwards(frame: FrameType | None) -> Iterator[FrameType]:
    while frame is not None:
        yield frame
        frame = frame.f_back


def _body_of(frame: FrameType) -> FrameType | None:
    """The function whose body a `with` that is entered from `frame` has. A generator with `@contextmanager` is
    suspended meanwhile: it is the function that uses that."""
    frames = [*_outwards(frame)]
    for one, caller in zip(frames, [*frames[1:], None], strict=True):
        if _module(one).startswith(("contextlib", __package__)):
            continue
        if not (one.f_code.co_flags & inspect.CO_GENERATOR and caller is not None and _module(caller) == "contextlib"):
            return one
    return None


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", ""))
