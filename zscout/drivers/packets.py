"""Packets on a robot's radio: what is sent to a Scout, as bytes and back. Pure.

A packet is a sync byte, the length of its body, the body (robot, number, operation, arguments) and a CRC-16
(CCITT, polynomial 0x1021, start 0xFFFF) over length and body:

    5A | length | robot | number | operation | arguments ... | crc high | crc low

The radio goes one way, without acknowledgements. So a drive command carries its own end (`lasts`), and other packets
are sent several times under the same number."""

from __future__ import annotations

import binascii
import struct
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar, Final

from zscout.types import MAX_CHANNEL, MAX_ROBOT

SYNC: Final = 0x5A
OVERHEAD: Final = 7
"""Bytes of a packet that are not its arguments."""
MAX_PACKET: Final = OVERHEAD + 3
"""Bytes of the longest packet, a drive command."""
TICKS: Final = 50
"""`lasts` is carried in 1/50 s."""
MAX_LASTS: Final = 255 / TICKS
"""Seconds that one drive command may last at most."""
FULL: Final = 127
"""The byte for a wheel's top speed."""


@dataclass(frozen=True, slots=True)
class Packet:
    """Base of all packets. `robot` is 0 to 254; `number` counts a robot's commands from 0 to 255 and round
    again: a repeated one is obeyed once."""

    operation: ClassVar[int]
    robot: int
    number: int

    def __post_init__(self) -> None:
        _check("robot id", self.robot, MAX_ROBOT)
        _check("packet number", self.number, 255)

    @property
    def size(self) -> int:
        """In bytes."""
        return len(encode(self))


@dataclass(frozen=True, slots=True)
class DrivePacket(Packet):
    """Turns the wheels for `lasts` seconds, unless a newer packet says otherwise.

    `left` and `right` are -1 to 1 of top speed; they are carried in steps of 1/127, `lasts` in 1/50 s."""

    operation: ClassVar[int] = 1
    left: float
    right: float
    lasts: float

    def __post_init__(self) -> None:
        # Not super(): a dataclass with slots is another class than the one that super() would look in.
        Packet.__post_init__(self)
        if not (-1 <= self.left <= 1 and -1 <= self.right <= 1):
            raise ValueError(f"wheels {self.left:g}, {self.right:g} are not within -1 to 1")
        if not 0 < self.lasts <= MAX_LASTS:
            raise ValueError(f"lasts {self.lasts:g} is not above 0 and at most {MAX_LASTS:g} s")


@dataclass(frozen=True, slots=True)
class StopPacket(Packet):
    """Wheels stop; the transmitter stays as it is."""

    operation: ClassVar[int] = 2


@dataclass(frozen=True, slots=True)
class CameraPacket(Packet):
    """The camera's transmitter on `channel` (1 to 15); 0 switches it off."""

    operation: ClassVar[int] = 3
    channel: int

    def __post_init__(self) -> None:
        Packet.__post_init__(self)
        _check("video channel", self.channel, MAX_CHANNEL)


@dataclass(frozen=True, slots=True)
class HaltPacket(Packet):
    """The safe state: wheels stop and the transmitter is off."""

    operation: ClassVar[int] = 4


def encode(packet: Packet) -> bytes:
    """The packet as it goes over the air."""
    arguments = b""
    if isinstance(packet, DrivePacket):
        lasts = max(1, round(packet.lasts * TICKS))
        arguments = struct.pack("bbB", round(packet.left * FULL), round(packet.right * FULL), lasts)
    elif isinstance(packet, CameraPacket):
        arguments = bytes((packet.channel,))
    framed = bytes((3 + len(arguments), packet.robot, packet.number, packet.operation)) + arguments
    return bytes((SYNC,)) + framed + _crc(framed)


def _check(what: str, value: int, most: int) -> None:
    if not 0 <= value <= most:
        raise ValueError(f"{what} {value} is not one of 0 to {most}")


def _crc(framed: bytes) -> bytes:
    return binascii.crc_hqx(framed, 0xFFFF).to_bytes(2, "big")


class PacketDecoder:
    """Finds packets in a stream of bytes that may begin anywhere, miss parts and hold noise."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self.spoiled = 0
        """Sync bytes that began no valid packet."""

    def feed(self, data: bytes) -> list[Packet]:
        """The packets that `data` completes, in order. Less than a packet is kept for the next call."""
        self._rest += data
        found: list[Packet] = []
        at = 0
        while (at := self._rest.find(SYNC, at)) >= 0:
            if len(self._rest) - at < 2:
                break
            length = self._rest[at + 1]
            if OVERHEAD <= length + 4 <= MAX_PACKET:
                end = at + length + 4
                if end > len(self._rest):
                    break
                if (packet := _decode(bytes(self._rest[at + 1 : end]))) is not None:
                    found.append(packet)
                    at = end
                    continue
            # No packet begins here; one may begin within what was taken for it.
            self.spoiled += 1
            at += 1
        del self._rest[: at if at >= 0 else len(self._rest)]
        return found


def _decode(framed: bytes) -> Packet | None:
    """The packet between sync byte and end; None: no valid one."""
    if _crc(framed[:-2]) != framed[-2:]:
        return None
    robot, number, operation, *arguments = framed[1:-2]
    with suppress(ValueError):
        match operation, arguments:
            case DrivePacket.operation, [_, _, ticks]:
                left, right = struct.unpack_from("bb", framed, 4)
                return DrivePacket(robot, number, left / FULL, right / FULL, ticks / TICKS)
            case StopPacket.operation, []:
                return StopPacket(robot, number)
            case CameraPacket.operation, [channel]:
                return CameraPacket(robot, number, channel)
            case HaltPacket.operation, []:
                return HaltPacket(robot, number)
    return None
