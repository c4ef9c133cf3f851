"""Packets that go out several times, since nobody acknowledges: stop, camera and halt. Pure; ns passed in.

A repeat has the number of its original, so that the robot obeys once. Where something else went to the robot
in between, it gets a number of its own: it then repeats what still stands. What has been overtaken by a
newer packet is not repeated: after a drive command nothing of a halt is left but "transmitter off".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from zscout.drivers.packets import (
    CameraPacket,
    DrivePacket,
    HaltPacket,
    Packet,
    StopPacket,
)
from zscout.types import SECOND, Ns

TIMES: Final = 3
"""How often such a packet goes out in all."""
SPACING: Final[Ns] = SECOND // 20
"""From one to the next: longer than most bursts of interference, short against a person's patience."""


@dataclass(slots=True)
class Retransmission:
    """A packet that goes out `left` times more, next at `due`."""

    packet: Packet
    left: int
    due: Ns


class RetransmitSchedule:
    """What was sent to one robot: its numbers, and what of it is to be repeated."""

    def __init__(self, first_number: int) -> None:
        self._next = first_number
        self._last: Packet | None = None
        self._count = 0
        self.repeats: list[Retransmission] = []

    def number(self) -> int:
        """The number for the next packet that is no repeat."""
        self._next, number = (self._next + 1) % 256, self._next
        return number

    def sent(self, packet: Packet, now: Ns) -> None:
        """`packet`, no repeat, went out: earlier ones that it overtakes are not repeated."""
        kept = (_remainder(repeat, packet) for repeat in self.repeats)
        self.repeats = [repeat for repeat in kept if repeat is not None]
        if not isinstance(packet, DrivePacket):
            self.repeats.append(Retransmission(packet, TIMES - 1, now + SPACING))
        self._last = packet
        self._count += 1

    def next_due(self) -> Retransmission | None:
        return min(self.repeats, key=lambda repeat: repeat.due, default=None)

    def retransmit(self, repeat: Retransmission, now: Ns) -> Packet:
        """The packet that goes out now for `repeat`."""
        # The very first number may by chance be the last that an earlier radio used: then the robot passes
        # it over, and must hear another.
        if repeat.packet is not self._last or self._count == 1:
            repeat.packet = replace(repeat.packet, number=self.number())
        self._last = repeat.packet
        self._count += 1
        repeat.left -= 1
        repeat.due = now + SPACING
        if not repeat.left:
            self.repeats.remove(repeat)
        return repeat.packet


def _remainder(repeat: Retransmission, newer: Packet) -> Retransmission | None:
    """What of `repeat` still stands once `newer` was sent."""
    match repeat.packet, newer:
        case (
            (_, HaltPacket())
            | (StopPacket(), DrivePacket() | StopPacket())
            | (CameraPacket(), CameraPacket())
        ):
            return None
        case HaltPacket() as halt, DrivePacket() | StopPacket():
            return Retransmission(CameraPacket(halt.robot, halt.number, 0), repeat.left, repeat.due)
        case HaltPacket() as halt, CameraPacket():
            return Retransmission(StopPacket(halt.robot, halt.number), repeat.left, repeat.due)
    return repeat
