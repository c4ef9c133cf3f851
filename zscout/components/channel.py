"""What a node and a component's process say to each other: frames over a socket pair.

A frame is its length in 4 bytes, big-endian, and one JSON object. The node orders, the process tells.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import Any, Final, Literal, TypeAlias

import msgspec

from zscout.config import Fleet
from zscout.messages import MAX_MOVE, HowEnded, OpenRequest

MAX_FRAME: Final = MAX_MOVE + 65_536
"""Bytes."""
_HEADER: Final = struct.Struct(">I")


class BadFrame(Exception):
    """The other side does not keep to the form; says what came."""


class Job(msgspec.Struct, frozen=True, tag="job"):
    """The first order: what to run, and as whom."""

    component: str
    incarnation: int
    kind: str
    where: str
    """`module:class` of the kind."""
    params: dict[str, Any]
    host: str
    fleet: Fleet
    tag: str
    """Stands in the environment of this process and of all that it starts."""
    standby: bool = False
    memory: int = 0
    """Bytes that each process may allocate; 0: no limit of this sort."""


class Stop(msgspec.Struct, frozen=True, tag="stop"):
    """End by yourself."""


class TakeCheckpoint(msgspec.Struct, frozen=True, tag="checkpoint"):
    """Answered with Taken."""

    number: int
    patience: float


class MoveAway(msgspec.Struct, frozen=True, tag="move"):
    """Answered with Gone, and then it ends."""

    number: int
    to: str
    incarnation: int
    patience: float


class TakeIn(msgspec.Struct, frozen=True, tag="restore"):
    """Answered with Done."""

    number: int
    state: bytes
    requests: list[OpenRequest]


class Activate(msgspec.Struct, frozen=True, tag="activate"):
    """It is not answered, but Stands tells when it runs."""


Order: TypeAlias = Stop | TakeCheckpoint | MoveAway | TakeIn | Activate


class Stands(msgspec.Struct, frozen=True, tag="stands"):
    """How far the component has come."""

    phase: Literal["standby", "running"]
    movable: bool


class Taken(msgspec.Struct, frozen=True, tag="taken"):
    number: int
    state: bytes


class Gone(msgspec.Struct, frozen=True, tag="gone"):
    """It goes on elsewhere; `dead` seconds lay between."""

    number: int
    dead: float


class Done(msgspec.Struct, frozen=True, tag="done"):
    number: int


class Declined(msgspec.Struct, frozen=True, tag="declined"):
    """An order that was not carried out; the component goes on."""

    number: int
    code: str
    message: str


class Ends(msgspec.Struct, frozen=True, tag="ends"):
    """The last word: how it ended, and the reason in words."""

    how: HowEnded
    reason: str = ""


Answer: TypeAlias = Taken | Gone | Done | Declined
Telling: TypeAlias = Stands | Answer | Ends


def pack(message: msgspec.Struct) -> bytes:
    """A message as a frame. Raises BadFrame if it is too long."""
    body = msgspec.json.encode(message, enc_hook=str)
    if len(body) > MAX_FRAME:
        raise BadFrame(f"{len(body)} bytes are too many; at most {MAX_FRAME} go in one frame")
    return _HEADER.pack(len(body)) + body


def receive(connection: socket.socket, kind: Any) -> Any:
    """The next message, of `kind`, on a blocking socket; None when the other side has closed, be it half-way.

    Raises BadFrame."""
    header = _exactly(connection, _HEADER.size)
    body = _exactly(connection, _length(header)) if header is not None else None
    return None if body is None else _unpack(body, kind)


async def read(stream: asyncio.StreamReader, kind: Any) -> Any:
    """The same for a stream."""
    try:
        header = await stream.readexactly(_HEADER.size)
        body = await stream.readexactly(_length(header))
    except (asyncio.IncompleteReadError, ConnectionError):
        return None
    return _unpack(body, kind)


def _length(header: bytes) -> int:
    length: int = _HEADER.unpack(header)[0]
    if length > MAX_FRAME:
        raise BadFrame(f"a frame of {length} bytes is announced; at most {MAX_FRAME} are taken")
    return length


def _unpack(body: bytes, kind: Any) -> Any:
    try:
        return msgspec.json.decode(body, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BadFrame(f"a frame is not understood: {str(error)[:200]}") from None


def _exactly(connection: socket.socket, count: int) -> bytes | None:
    parts, missing = [], count
    while missing:
        try:
            part = connection.recv(min(missing, 1 << 20))
        except ConnectionError:
            return None
        if not part:
            return None
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)
