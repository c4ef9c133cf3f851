"""Hands at a terminal and at a game pad, and what they do with a robot."""

from __future__ import annotations

import asyncio
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from zscout.behaviors.teleop import Teleop, Way
from zscout.config.strict import BadInput, quoted
from zscout.types import SECOND

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

PAD_EVENT: Final = struct.Struct("<IhBB")
"""An event of Linux's joystick interface: time in ms, value, type, number (Documentation/input/joydev)."""
AXIS: Final = 0x02
BUTTON: Final = 0x01
INITIAL: Final = 0x80
ACROSS, ALONG = 0, 1
"""Axes of the left stick."""
FULL: Final = 32_767


class Hands:
    """What keys and pad do."""

    def __init__(self, teleop: Teleop, end: asyncio.Event) -> None:
        self.teleop, self.pilot, self._end = teleop, teleop.pilot, end

    def _now(self) -> float:
        return self.teleop.client.mesh.now() / SECOND

    def key(self, key: bytes) -> None:
        """A key was typed."""
        if key in KEYS:
            self.pilot.press(self._now(), KEYS[key])
            self.teleop.take()
        elif key in (b" ", b"x"):
            self.pilot.stop()
        elif key in (b"+", b"="):
            self.pilot.faster(1)
        elif key in (b"-", b"_"):
            self.pilot.faster(-1)
        elif key == b"g":
            self.teleop.give_back()
        elif key in (b"q", b"\x04"):
            self._end.set()
        self.teleop.wake()

    def moved(self, forward: float, right: float) -> None:
        """The pad's stick was moved."""
        self.pilot.stick(self._now(), forward, right)
        if not self.pilot.wheels(self._now()).still:
            self.teleop.take()
        self.teleop.wake()

    def button(self, number: int) -> None:
        """A button of the pad was pressed."""
        if number == 0:
            self.pilot.stop()
            self.teleop.wake()
        elif number == 1:
            self.teleop.give_back()


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
