"""Packets that go out several times, since nobody acknowledges: stop, camera and halt. Pure; ns passed in.

An echo has the number of its original, so that the robot obeys once. Where something else went to the robot
in between, it gets a number of its own: it then says again what still stands. What has been overtaken by a
newer packet is not said again: after a drive command nothing of a halt is left but "transmitter off".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from zscout.packets import Camera, Drive, Halt, Packet, Stop
from zscout.scheduling.model import SECOND, Ns

TIMES: Final = 3
"""How often such a packet goes out in all."""
SPACING: Final[Ns] = SECOND // 20
"""From one to the next: longer than most bursts of interference, short against a person's patience."""


@dataclass(slots=True)
class Echo:
    """A packet that goes out `left` times more, next at `due`."""

    packet: Packet
    left: int
    due: Ns


class Said:
    """What was said to one robot: its numbers, and what of it will be said again."""

    def __init__(self, first_number: int) -> None:
        self._next = first_number
        self._last: Packet | None = None
        self._count = 0
        self.echoes: list[Echo] = []

    def number(self) -> int:
        """The number for the next packet that is not an echo."""
        self._next, number = (self._next + 1) % 256, self._next
        return number

    def sent(self, packet: Packet, now: Ns) -> None:
        """`packet`, no echo, went out: earlier ones that it overtakes are not said again."""
        kept = (_left_of(echo, packet) for echo in self.echoes)
        self.echoes = [echo for echo in kept if echo is not None]
        if not isinstance(packet, Drive):
            self.echoes.append(Echo(packet, TIMES - 1, now + SPACING))
        self._last = packet
        self._count += 1

    def next_due(self) -> Echo | None:
        return min(self.echoes, key=lambda echo: echo.due, default=None)

    def say_again(self, echo: Echo, now: Ns) -> Packet:
        """The packet that goes out now for `echo`."""
        # The very first number may by chance be the last that an earlier radio used: then the robot passes
        # it over, and must hear another.
        if echo.packet is not self._last or self._count == 1:
            echo.packet = replace(echo.packet, number=self.number())
        self._last = echo.packet
        self._count += 1
        echo.left -= 1
        echo.due = now + SPACING
        if not echo.left:
            self.echoes.remove(echo)
        return echo.packet


def _left_of(echo: Echo, newer: Packet) -> Echo | None:
    """What of `echo` still stands once `newer` was said."""
    match echo.packet, newer:
        case (_, Halt()) | (Stop(), Drive() | Stop()) | (Camera(), Camera()):
            return None
        case Halt() as halt, Drive() | Stop():
            return Echo(Camera(halt.robot, halt.number, 0), echo.left, echo.due)
        case Halt() as halt, Camera():
            return Echo(Stop(halt.robot, halt.number), echo.left, echo.due)
    return echo
