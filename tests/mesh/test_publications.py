"""Publications and frames: what services may rely on, held against both meshes."""

from __future__ import annotations

import asyncio
import itertools
import logging
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Any, cast

import pytest

from tests.hang import HANG
from tests.mesh.both_meshes import FRAMES, LONG, NEWS, Ping, Pong, World, Zenoh
from tests.mesh.kit import until
from zscout import messages
from zscout.keyexpr import BadName
from zscout.mesh.exchange import LatestByKey
from zscout.mesh.session import KEPT_BY_KEY
from zscout.mesh.transport import Quality
from zscout.messages import MAX_FRAME, FrameHead, base


async def test_publications_arrive_in_order(world: World) -> None:
    a, b = await world.open("a", "b")
    heard, own = list[tuple[str, int]](), list[int]()
    a.subscribe("test/*", Ping, lambda key, ping: heard.append((key, ping.number)))
    b.subscribe(NEWS, Ping, lambda _, ping: own.append(ping.number))
    await world.declared()
    publisher = b.publisher(NEWS, Ping)
    for number in range(0, 100, 2):
        publisher.put(Ping(number))
        b.put(NEWS, Ping(number + 1))
    await until(lambda: len(heard) == 100 and len(own) == 100)
    assert (heard, own) == ([(NEWS, number) for number in range(100)], list(range(100)))
    publisher.close()


@pytest.mark.parametrize("world", [Zenoh], indirect=True)
async def test_a_peer_that_does_not_read_for_less_than_the_lease_misses_nothing(world: Zenoh) -> None:
    # As on a host without processor time; a link that is closed for it takes the liveliness of all behind it along.
    payload, count, sent = bytes(50_000), 640, 0  # more than the buffers of a connection take

    def send() -> None:
        nonlocal sent
        for sent in range(1, count + 1):  # noqa: B007 - told to the story below
            world.meshes[1]._transport.put(NEWS, payload, Ping)

    world.lease = 30.0
    a, _ = await world.open("a", "b")
    go_on, heard = threading.Event(), list[int]()

    def on_sample(_key: str, payload: bytes, _head: bytes | None) -> None:
        go_on.wait(HANG)
        heard.append(len(payload))

    a._transport.subscriber(NEWS, on_sample)
    await world.declared()
    sending, before = asyncio.create_task(asyncio.to_thread(send)), 0
    while sent == 0 or sent != before:  # until it stands still
        before = sent
        await asyncio.sleep(0.5)
    assert sent < count
    go_on.set()
    await sending
    await until(lambda: len(heard) == count)


async def test_what_is_published_before_a_subscription_is_not_kept(world: World) -> None:
    a, b, witness = await world.open("a", "b", "c")
    heard, witnessed = list[int](), list[int]()
    witness.subscribe(NEWS, Ping, lambda _, ping: witnessed.append(ping.number))
    await world.declared()
    b.put(NEWS, Ping(1))
    await until(lambda: witnessed)  # what is put goes out a little later
    a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number))
    await world.declared()
    b.put(NEWS, Ping(2))
    await until(lambda: heard)
    assert heard == [2]


@pytest.mark.parametrize("world", [Zenoh], indirect=True)
async def test_of_deletes_and_keys_with_wildcards_nothing_is_heard(world: Zenoh) -> None:
    a, b = await world.open("a", "b")
    heard: list[int] = []
    a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number))
    polled, frames = a.poll_latest(NEWS, Ping), list[bytes]()
    a._transport.subscriber(NEWS, lambda _key, payload, _head: frames.append(payload))
    await world.declared()
    transport = cast("Any", b._transport)
    session = transport.current._session
    session.put("test/*", b'{"number": 1}')
    session.delete(NEWS)
    b.put(NEWS, Ping(2))
    await until(lambda: heard and frames)
    assert (heard, frames) == ([2], [b'{"number":2}'])
    assert [ping.number for _, ping in polled.each()] == [2]


async def test_alike_subscriptions_are_closed_one_by_one(world: World) -> None:
    a, b = await world.open("a", "b")
    one, other = list[int](), list[int]()
    first = a.subscribe(NEWS, Ping, lambda _, ping: one.append(ping.number))
    second = a.subscribe(NEWS, Ping, lambda _, ping: other.append(ping.number))
    assert len(a._shared) == 1
    await world.declared()
    b.put(NEWS, Ping(1))
    await until(lambda: other)
    first.close()
    b.put(NEWS, Ping(2))
    await until(lambda: len(other) == 2)
    assert one == [1]
    second.close()
    assert not a._shared


async def test_a_malformed_publication_and_a_handler_that_fails_stop_nobody(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        a, b = await world.open("a", "b")
        heard: list[int] = []

        def fail(_: str, ping: Ping) -> None:
            if ping.number == 1:
                raise BadName("no name")
            raise ValueError("broken")

        a.subscribe(NEWS, Ping, fail)
        a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number))
        await world.declared()
        b.put(NEWS, Pong(1, "x"))  # unknown fields are ignored
        b._transport.put(NEWS, b"no JSON", Ping)
        b.put(NEWS, Ping(2))
        await until(lambda: len(heard) == 2)
        assert heard == [1, 2]
    texts = [record.getMessage() for record in caplog.records if record.name.startswith("zscout")]
    assert len(texts) == 3
    assert "no name" in texts[0]
    assert "not a valid Ping" in texts[1]
    assert texts[2] == "a handler failed"


async def test_publications_beyond_a_full_queue_are_counted_as_missed(world: World) -> None:
    a, b = await world.open("a", "b")
    heard: list[int] = []
    subscription = a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number), depth=3)
    await world.declared()
    for number in range(10):
        b.put(NEWS, Ping(number))
    await world.occupied(lambda: subscription.missed == 7)
    await until(lambda: heard)
    assert (heard, subscription.missed) == ([0, 1, 2], 7)


async def test_what_is_too_large_waits_nowhere(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(base.LIMITS, Ping, 100)
    waiting, put = list[int](), LatestByKey.put

    def noted(self: LatestByKey, key: str, payload: bytes) -> bool:
        waiting.append(len(payload))
        return put(self, key, payload)

    monkeypatch.setattr(LatestByKey, "put", noted)
    a, b = await world.open("a", "b")
    polled = a.poll_latest(NEWS, Ping)
    heard: list[int] = []
    a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number))
    await world.declared()
    large = b'{"number":1,"x":"' + b"x" * 100_000 + b'"}'
    b._transport.put(NEWS, large, Ping)
    await world.occupied(lambda: waiting)
    assert waiting == [101]
    b.put(NEWS, Ping(2))
    await until(lambda: heard)
    await until(lambda: list(polled.each()) == [(NEWS, Ping(2))])
    assert heard == [2]


async def test_where_the_newest_counts_one_publisher_has_a_share(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "NEWEST_COUNTS", {Ping})
    monkeypatch.setattr(messages, "NEWEST_COUNTS", {Ping})
    a, b = await world.open("a", "b")
    heard = dict[str, list[int]]()
    subscription = a.subscribe("test/*", Ping, lambda key, ping: heard.setdefault(key, []).append(ping.number))
    await world.declared()
    for number in range(100):
        b.put("test/flood", Ping(number))
    b.put("test/other", Ping(1))
    await world.occupied(lambda: subscription.missed == 100 - KEPT_BY_KEY)
    await until(lambda: len(heard) == 2)
    assert heard == {"test/flood": [*range(KEPT_BY_KEY - 1), 99], "test/other": [1]}


async def test_poll_latest_keeps_the_latest(world: World) -> None:
    a, b = await world.open("a", "b")
    polled = a.poll_latest(NEWS, Ping, depth=3)
    heard: list[int] = []
    a.subscribe(NEWS, Ping, lambda _, ping: heard.append(ping.number))
    await world.declared()
    for number in range(5):
        b.put(NEWS, Ping(number))
    b._transport.put(NEWS, b"no JSON", Ping)
    b.put(NEWS, Ping(6))
    await until(lambda: 6 in heard)
    await until(lambda: list(polled.each()) == [(NEWS, Ping(4)), (NEWS, Ping(6))])
    assert list(polled.each()) == []
    polled.close()


async def test_after_burst_waits_for_all_that_arrived_together(world: World) -> None:
    a, b = await world.open("a", "b")
    events: list[str] = []

    def handle(_: str, ping: Ping) -> None:
        events.append(f"handled {ping.number}")
        if ping.number == 0:
            a.after_burst(lambda: events.append("burst over"))

    a.subscribe(NEWS, Ping, handle)
    await world.declared()
    a.after_burst(lambda: events.append("at once"))
    assert events == ["at once"]
    for number in range(3):
        b.put(NEWS, Ping(number))
    await world.occupied(lambda: len(a._inbox.items) == 3)
    await until(lambda: len(events) == 5)
    assert events == ["at once", "handled 0", "handled 1", "handled 2", "burst over"]


async def test_the_newest_frame_is_taken_and_its_publisher_knows_of_subscribers(world: World) -> None:
    a, b = await world.open("a", "b")
    publisher = b.frame_publisher(FRAMES)
    changes: list[bool] = []
    publisher.follow(changes.append)
    assert changes == []
    assert not publisher.watched
    with closing(a.frames("test/*")) as watch:
        await until(lambda: publisher.watched)
        sent = itertools.count()

        def publish(until: Callable[[], object]) -> bool:  # again: a frame that would have to wait is dropped
            number = next(sent)
            publisher.put(FrameHead(number=number, time=0, width=1, height=1), b"jpeg %d" % number)
            return bool(until())

        await until(lambda: publish(lambda: watch.missed >= 2))
        frame = watch.take()
        assert frame is not None
        assert frame.head.number >= 2
        assert (frame.key, frame.jpeg) == (FRAMES, b"jpeg %d" % frame.head.number)
        assert frame.arrived <= a.now()
        waiting = asyncio.create_task(watch.next(LONG))
        await until(lambda: publish(waiting.done))
        assert waiting.result() is not None
        raw = b._transport.publisher(FRAMES, None, Quality.FRAME)

        def publish_malformed() -> bool:
            raw.put(b"no head")
            watch.take()
            return watch.malformed > 0

        await until(publish_malformed)
    with closing(a.frames("test/idle")) as idle:
        assert await idle.next(0.01) is None
    await until(lambda: not publisher.watched)
    assert changes == [True, False]
    with pytest.raises(ValueError, match="too large"):
        publisher.put(FrameHead(number=1, time=0, width=1, height=1), b"x" * (MAX_FRAME + 1))
    publisher.close()
