"""Messages between a node and the process of a component: JSON objects over a socket pair, one per line. The node sends
orders, the process sends reports."""

from __future__ import annotations

import asyncio
from typing import Any, BinaryIO, Final, Literal, TypeAlias

import msgspec

from zscout import messages
from zscout.config.fleet import Fleet
from zscout.messages import MAX_MOVE, HowEnded, Problem, StartComponent

MAX_FRAME: Final = MAX_MOVE + 65_536
"""Most bytes of a frame: a move and its envelope."""
PATIENCE: Final = 5.0
"""Seconds that a component has to reach a safe point for a checkpoint."""


class BadFrame(Exception):
    """The other side sent a malformed or oversized frame."""


class ComponentJob(msgspec.Struct, frozen=True, tag="job"):
    """The first order: the component to run."""

    start: StartComponent
    where: str
    """`module:class` of the kind."""
    host: str
    fleet: Fleet
    tag: str
    """Mark in the environment of this process, which its descendants inherit."""
    memory: int = 0
    """Bytes that each process may allocate; 0: no such limit."""

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
    """An operation that the node received, unchanged. The process answers all but stops and activations, whose effect
    it reports, with an OrderAnswer of this `number`."""

    number: int
    operation: Operation


class PhaseReport(msgspec.Struct, frozen=True, tag="stands"):
    phase: Literal["standby", "running"]
    movable: bool


class OrderAnswer(msgspec.Struct, frozen=True, tag="answer"):
    """Answer to the order of this number: the component's `state`, or for how many seconds it was paused by a move
    (`dead`). With `problem` the order failed, and the component continues."""

    number: int
    state: bytes = b""
    dead: float = 0.0
    problem: Problem | None = None


class EndReport(msgspec.Struct, frozen=True, tag="ends"):
    """The last report: how the component ended, and why, for people. `bad_params`: don't restart it, on any host."""

    how: HowEnded
    reason: str = ""
    bad_params: bool = False


ComponentReport: TypeAlias = PhaseReport | OrderAnswer | EndReport


def pack(message: msgspec.Struct) -> bytes:
    """Encode a message as a frame. Raises BadFrame if it is too long."""
    body = msgspec.json.encode(message, enc_hook=str)
    if len(body) >= MAX_FRAME:
        raise BadFrame(f"a frame of {len(body)} bytes is too long; the limit is {MAX_FRAME}")
    return body + b"\n"


def receive(connection: BinaryIO, kind: Any) -> Any:
    """The next message, of `kind`; None once the other side has closed, even within a frame. Raises BadFrame."""
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
    """Like `receive`, from a stream whose limit is MAX_FRAME."""
    try:
        return _unpack(await stream.readuntil(b"\n"), kind)
    except (asyncio.IncompleteReadError, ConnectionError):
        return None
    except asyncio.LimitOverrunError:
        raise BadFrame(_TOO_LONG) from None


_TOO_LONG: Final = f"received a frame of more than {MAX_FRAME} bytes"


def _unpack(body: bytes, kind: Any) -> Any:
    try:
        return msgspec.json.decode(body, type=kind, dec_hook=lambda path, value: path(value))
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
        raise BadFrame(f"can't read a frame: {str(error)[:200]}") from None
