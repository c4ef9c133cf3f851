"""Packets to a Scout robot on its radio: encoding and decoding. Pure.

A packet is a sync byte, the length of its body, the body (robot, number, operation, arguments) and a CRC-16
(CCITT, polynomial 0x1021, start 0xFFFF) over length and body:

    5A | length | robot | number | operation | arguments ... | crc high | crc low

The radio is one-way, without acknowledgements. So a drive command contains its duration (`lasts`), and other packets
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
"""`lasts` is sent in units of 1/50 s."""
MAX_LASTS: Final = 255 / TICKS
"""Longest duration of a drive command, in seconds."""
FULL: Final = 127
"""The byte for a wheel's top speed."""


@dataclass(frozen=True, slots=True)
class Packet:
    """`robot`: 0 to 254. `number` counts its commands modulo 256; the robot obeys packets of one number once."""

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
    """Turn the wheels for `lasts` seconds, or until a newer packet. `left` and `right` are -1 to 1 of top speed; they
    are sent in steps of 1/127, `lasts` in 1/50 s."""

    operation: ClassVar[int] = 1
    left: float
    right: float
    lasts: float

    def __post_init__(self) -> None:
        # Not super(): dataclass(slots=True) creates a second class, which the implicit super() does not know.
        Packet.__post_init__(self)
        if not (-1 <= self.left <= 1 and -1 <= self.right <= 1):
            raise ValueError(f"wheels {self.left:g}, {self.right:g} are not within -1 to 1")
        if not 0 < self.lasts <= MAX_LASTS:
            raise ValueError(f"lasts is {self.lasts:g} s; it must be above 0 and at most {MAX_LASTS:g} s")


@dataclass(frozen=True, slots=True)
class StopPacket(Packet):
    """Stop the wheels; the transmitter is not affected."""

    operation: ClassVar[int] = 2


@dataclass(frozen=True, slots=True)
class CameraPacket(Packet):
    """Set the camera's transmitter to `channel` (1 to 15); 0 switches it off."""

    operation: ClassVar[int] = 3
    channel: int

    def __post_init__(self) -> None:
        Packet.__post_init__(self)
        _check("video channel", self.channel, MAX_CHANNEL)


@dataclass(frozen=True, slots=True)
class HaltPacket(Packet):
    """The safe state: stop the wheels and switch the transmitter off."""

    operation: ClassVar[int] = 4


def encode(packet: Packet) -> bytes:
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
        raise ValueError(f"{what} {value} is not within 0 to {most}")


def _crc(framed: bytes) -> bytes:
    return binascii.crc_hqx(framed, 0xFFFF).to_bytes(2, "big")


class PacketDecoder:
    """Finds packets in a stream of bytes, which may begin anywhere, have gaps and contain noise."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self.spoiled = 0
        """Sync bytes that began no valid packet."""

    def feed(self, data: bytes) -> list[Packet]:
        """The packets completed by `data`, in order. An incomplete packet is kept for the next call."""
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
            # No packet begins here, but a packet may begin within the bytes after this sync byte.
            self.spoiled += 1
            at += 1
        del self._rest[: at if at >= 0 else len(self._rest)]
        return found


def _decode(framed: bytes) -> Packet | None:
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
