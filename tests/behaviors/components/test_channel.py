"""Frames between a node and a component's process, good and hostile."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from decimal import Decimal
from typing import BinaryIO

import msgspec
import pytest

from zscout.behaviors.components import channel
from zscout.behaviors.components.channel import BadFrame, ComponentJob, ComponentReport, EndReport, Order, PhaseReport
from zscout.config.fleet import default_fleet
from zscout.messages import MAX_CHECKPOINT, ComponentSpec, OpenRequest, RestoreComponent, StartComponent, StopComponent

STOP = Order(0, StopComponent("c"))


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, BinaryIO]]:
    ours, theirs = socket.socketpair()
    with ours, theirs, theirs.makefile("rb") as orders:
        yield ours, orders


def test_messages_arrive_in_order_and_the_end_is_seen(pair: tuple[socket.socket, BinaryIO]) -> None:
    ours, theirs = pair
    request = OpenRequest("1", "survey", {"robot/a": {"rate": Decimal("0.1")}}, 3, Decimal("2.5"))
    start = StartComponent("c", 7, ComponentSpec("counter", {"a": [1, None]}))
    job = ComponentJob(start, "m:C", "h", default_fleet(), "tag", memory=5)
    orders = [STOP, Order(1, RestoreComponent("c", 8, b"\x00\xff", [request]))]
    ours.sendall(b"".join(map(channel.pack, [job, *orders])))
    ours.close()
    assert channel.receive(theirs, ComponentJob) == job
    assert [channel.receive(theirs, Order) for _ in orders] == orders
    assert channel.receive(theirs, Order) is None


def test_the_largest_checkpoint_goes_through(pair: tuple[socket.socket, BinaryIO]) -> None:
    ours, theirs = pair
    state = bytes(range(256)) * (MAX_CHECKPOINT // 256)
    frame = channel.pack(Order(1, RestoreComponent("c", 8, state)))
    sender = threading.Thread(target=ours.sendall, args=(frame,))
    sender.start()
    order = channel.receive(theirs, Order)
    sender.join()
    assert isinstance(order.operation, RestoreComponent)
    assert order.operation.state == state


HOSTILE = {
    "garbage": b"GET / HTTP/1.1\r\n\r\n",
    "too long": b"x" * (channel.MAX_FRAME + 1),
    "no JSON": b"\xff{]\n",
    "no message": b"{}\n",
    "of another sort": channel.pack(PhaseReport("running", movable=True)),
    "deep": b"[" * 200_000 + b"\n",
    "wrong type": b'{"type":"order","number":"x","operation":{"op":"stop","component":"c"}}\n',
}


@pytest.mark.parametrize("raw", HOSTILE.values(), ids=HOSTILE)
def test_what_is_no_frame_is_refused(pair: tuple[socket.socket, BinaryIO], raw: bytes) -> None:
    ours, theirs = pair
    sender = threading.Thread(target=ours.sendall, args=(raw,))
    sender.start()
    with pytest.raises(BadFrame):
        channel.receive(theirs, Order)
    sender.join()


@pytest.mark.parametrize("raw", [channel.pack(STOP)[:-1], b""], ids=["body", "nothing"])
def test_half_a_frame_is_an_end(pair: tuple[socket.socket, BinaryIO], raw: bytes) -> None:
    ours, theirs = pair
    ours.sendall(raw)
    ours.close()
    assert channel.receive(theirs, Order) is None


def test_a_stream_is_read_alike() -> None:
    async def read(raw: bytes) -> ComponentReport | None:
        stream = asyncio.StreamReader(channel.MAX_FRAME)
        stream.feed_data(raw)
        stream.feed_eof()
        told: ComponentReport | None = await channel.read(stream, ComponentReport)
        return told

    ends = EndReport("failed", "why")
    assert asyncio.run(read(channel.pack(ends))) == ends
    assert asyncio.run(read(channel.pack(ends)[:-1])) is None
    for raw in (HOSTILE["garbage"], HOSTILE["too long"], HOSTILE["no JSON"], channel.pack(STOP)):
        with pytest.raises(BadFrame):
            asyncio.run(read(raw))


def test_nothing_too_long_is_sent() -> None:
    with pytest.raises(BadFrame, match="too long"):
        channel.pack(channel.OrderAnswer(1, b"x" * channel.MAX_FRAME))


def test_a_move_as_large_as_the_mesh_takes_fits() -> None:
    order = Order(1, RestoreComponent("c", 8, b"x" * MAX_CHECKPOINT))
    assert len(msgspec.json.encode(order)) < channel.MAX_FRAME
