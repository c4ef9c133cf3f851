"""Hands at a terminal and at a game pad, as calls in the event loop."""

from __future__ import annotations

import asyncio
import os
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from zscout.behaviors.piloting import Way
from zscout.config.strict import BadInput, quoted

KEYS: Final[dict[bytes, Way]] = {
    b"\x1b[A": "forward",
    b"\x1b[B": "back",
    b"\x1b[C": "right",
    b"\x1b[D": "left",
    b"\x1bOA": "forward",
    b"\x1bOB": "back",
    b"\x1bOC": "right",
    b"\x1bOD": "left",
    b"w": "forward",
    b"s": "back",
    b"d": "right",
    b"a": "left",
}
"""Arrows, in both forms that terminals send, and w a s d."""
MAX_TYPED: Final = 1_024

PAD_EVENT: Final = struct.Struct("<IhBB")
"""An event of Linux's joystick interface: time in ms, value, type, number (Documentation/input/joydev)."""
AXIS: Final = 0x02
BUTTON: Final = 0x01
INITIAL: Final = 0x80
ACROSS, ALONG = 0, 1
"""Axes of the left stick."""
FULL: Final = 32_767


def keys_in(typed: bytes) -> Iterator[bytes]:
    """The single keys of what was typed; an escape sequence is one key."""
    at = 0
    while at < len(typed):
        length = 3 if typed[at : at + 2] in (b"\x1b[", b"\x1bO") and len(typed) - at >= 3 else 1
        yield typed[at : at + length]
        at += length


@contextmanager
def typed_keys(pressed: Callable[[bytes], None], ended: Callable[[], None]) -> Iterator[None]:
    """Calls `pressed` with each key typed at the terminal, and `ended` when that is gone. Keys come one by
    one and are not echoed; the terminal is as before afterwards."""
    import termios
    import tty

    loop, terminal = asyncio.get_running_loop(), sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def readable() -> None:
        try:
            typed = os.read(terminal, MAX_TYPED)
        except OSError:
            typed = b""
        if not typed:
            loop.remove_reader(terminal)
            ended()
        for key in keys_in(typed):
            pressed(key)

    tty.setcbreak(terminal)
    loop.add_reader(terminal, readable)
    try:
        yield
    finally:
        loop.remove_reader(terminal)
        # A terminal that is gone has no modes to be set back.
        with suppress(termios.error):
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)


@contextmanager
def game_pad(
    device: Path, moved: Callable[[float, float], None], button: Callable[[int], None]
) -> Iterator[None]:
    """Calls `moved(forward, right)`, -1 to 1 each, as the left stick moves, and `button` with the number of
    one that is pressed. A pad that is unplugged moves to 0, 0. Raises BadInput for what can't be opened."""
    try:
        descriptor = os.open(device, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise BadInput(
            f"--pad: {quoted(str(device))} can't be opened ({error.strerror}); "
            "name a joystick, as in /dev/input/js0"
        ) from None
    loop = asyncio.get_running_loop()
    stick = {ACROSS: 0.0, ALONG: 0.0}

    def readable() -> None:
        try:
            events = os.read(descriptor, PAD_EVENT.size * 64)
        except BlockingIOError:
            return
        except OSError:
            events = b""
        if not events:
            loop.remove_reader(descriptor)
            moved(0.0, 0.0)
        for _, value, kind, number in PAD_EVENT.iter_unpack(
            events[: len(events) // PAD_EVENT.size * PAD_EVENT.size]
        ):
            if kind & ~INITIAL == AXIS and number in stick:
                stick[number] = value / FULL
                # Pushed away from oneself is negative there.
                moved(-stick[ALONG], stick[ACROSS])
            elif kind == BUTTON and value:
                button(number)

    loop.add_reader(descriptor, readable)
    try:
        yield
    finally:
        loop.remove_reader(descriptor)
        os.close(descriptor)
