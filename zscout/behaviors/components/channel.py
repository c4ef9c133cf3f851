"""What a node and a component's process exchange over a socket pair: JSON objects, one in each line.

The node sends orders, the process reports.
"""

from __future__ import annotations

import asyncio
from typing import Any, BinaryIO, Final, Literal, TypeAlias

import msgspec

from zscout import messages
from zscout.config.fleet import Fleet
from zscout.messages import MAX_MOVE, HowEnded, Problem, StartComponent

MAX_FRAME: Final = MAX_MOVE + 65_536
"""Bytes."""
PATIENCE: Final = 5.0
"""Seconds that a component has to come to a safe point for a checkpoint."""


class BadFrame(Exception):
    """The other side does not keep to the form; says what came."""


class ComponentJob(msgspec.Struct, frozen=True, tag="job"):
    """The first order: what to run, and as whom."""

    start: StartComponent
    where: str
    """`module:class` of the kind."""
    host: str
    fleet: Fleet
    tag: str
    """Stands in the environment of this process and of all that it starts."""
    memory: int = 0
    """Bytes that each process may allocate; 0: no limit of this sort."""

    @property
    def client(self) -> str:
        return f"{self.start.component}.{self.start.incarnation}"


Operation: TypeAlias = (
    messages.StopComponent
    | messages.CheckpointComponent
    | messages.MoveComponent
    | messages.RestoreComponent
    | messages.ActivateComponent
)


class Order(msgspec.Struct, frozen=True, tag="order"):
    """What the node was asked, as it was asked. Answered with an OrderAnswer of this number; a stop and an
    activation are not, but reports follow."""

    number: int
    operation: Operation


class PhaseReport(msgspec.Struct, frozen=True, tag="stands"):
    """How far the component has come."""

    phase: Literal["standby", "running"]
    movable: bool


class OrderAnswer(msgspec.Struct, frozen=True, tag="answer"):
    """To the order of this number: the state of a component, or how long (s) a move took it out of work.
    `problem`: it was not carried out, and the component goes on."""

    number: int
    state: bytes = b""
    dead: float = 0.0
    problem: Problem | None = None


class EndReport(msgspec.Struct, frozen=True, tag="ends"):
    """The last report: how it ended, and the reason in words. `bad_params`: its parameters are no good anywhere."""

    how: HowEnded
    reason: str = ""
    bad_params: bool = False


ComponentReport: TypeAlias = PhaseReport | OrderAnswer | EndReport


def pack(message: msgspec.Struct) -> bytes:
    """A message as a frame. Raises BadFrame if it is too long."""
    body = msgspec.json.encode(message, enc_hook=str)
    if len(body) >= MAX_FRAME:
        raise BadFrame(f"{len(body)} bytes are too many; less than {MAX_FRAME} go in one frame")
    return body + b"\n"


def receive(connection: BinaryIO, kind: Any) -> Any:
    """The next message, of `kind`; None when the other side has closed, be it half-way. Raises BadFrame."""
    try:
        line = connection.readline(MAX_FRAME)
    except ConnectionError:
        return None
    if line.endswith(b"\n"):
        return _unpack(line, kind)
    if len(line) == MAX_FRAME:
        raise BadFrame(_TOO_LONG)
    return None


async def read(stream: asyncio.StreamReader, kind: Any) -> Any:
    """The same for a stream, whose limit is MAX_FRAME."""
    try:
        return _unpack(await stream.readuntil(b"\n"), kind)
    except (asyncio.IncompleteReadError, ConnectionError):
        return None
    except asyncio.LimitOverrunError:
        raise BadFrame(_TOO_LONG) from None


_TOO_LONG: Final = f"a frame of more than {MAX_FRAME} bytes comes"


def _unpack(body: bytes, kind: Any) -> Any:
    try:
        return msgspec.json.decode(body, type=kind, dec_hook=lambda path, value: path(value))
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
        raise BadFrame(f"can't read a frame: {str(error)[:200]}") from None
