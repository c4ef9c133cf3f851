"""Frames on a real mesh: who looks gets the newest, and a framegrabber publishes for holders and lookers."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.drivers.mjpeg import MjpegServer, jpeg, number_of, numbered
from tests.hang import HANG
from tests.live.bench import Bench, SharedBench, Stand, answer, running, until
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client
from zscout.drivers import framegrabber
from zscout.drivers.capture import Capture
from zscout.drivers.framegrabber import FramegrabberDriver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Sender
from zscout.mesh import ZenohMesh
from zscout.mesh.frames import Frame, FrameWatch
from zscout.mesh.transport import Quality
from zscout.messages import MAX_FRAME, FrameHead, RcAsk, RcState
from zscout.rcm.recovery import RecoveredState
from zscout.rcm.terms import BELIEVED
from zscout.services.rcm.rcm import Rcm
from zscout.types import Term

pytestmark = pytest.mark.live

GRABBER = "framegrabber/f"
BLUE = 1_000
"""The pictures of the second server are coloured, and numbered from here."""


def head(number: int) -> FrameHead:
    return FrameHead(number=number, time=float(number), width=160, height=120)


def picture_in(frame: Frame) -> Any:
    picture = cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


async def frame_of(watch: FrameWatch) -> Frame:
    frame = await watch.next(HANG)
    assert frame is not None
    return frame


def refused(watch: FrameWatch, before: int) -> bool:
    """Whether one more was refused; fails if it takes what is no frame."""
    # One that was thought to be dropped may still come: it is the last good one, and no harm.
    frame = watch.take()
    assert frame is None or frame.head.number == 10
    return watch.malformed > before


def looked_at(driver: FramegrabberDriver) -> int:
    """The number of the last picture that its pump has had in its hands, or, where it has none, that was read."""
    assert driver._capture is not None
    return driver._before["number"] + (driver._capture.number if driver._pump is None else driver._pump._after)


async def look_at(driver: FramegrabberDriver, pictures: int) -> None:
    """Waits until that has gone on by so many."""
    wanted = looked_at(driver) + pictures
    await until(lambda: looked_at(driver) >= wanted)


async def until_there(put: Callable[[], None], there: Callable[[], bool]) -> None:
    """Publishes until it has arrived: on a busy machine a frame may be dropped, as frames are."""
    async with asyncio.timeout(HANG):
        while True:
            put()
            for _ in range(100):
                if there():
                    return
                await asyncio.sleep(0.01)


async def test_what_is_no_frame_is_passed_over(lab: Lab) -> None:
    async with AsyncExitStack() as stack:
        here, there = [
            await stack.enter_async_context(await ZenohMesh.open(lab.fleet_of(name), Sender(name, "node")))
            for name in ("here", "there")
        ]
        key = here.keys.frame(GRABBER)
        publisher, watch = here.frame_publisher(key), there.frames(there.keys.frame_any)

        async def arrives(number: int, jpeg: bytes) -> None:
            got: list[Frame] = []

            def there() -> bool:
                # A session that has just joined may be sent what came before it subscribed.
                got.extend(frame for frame in [watch.take()] if frame is not None and frame.head.number == number)
                return bool(got)

            await until_there(lambda: publisher.put(head(number), jpeg), there)
            assert (got[0].key, got[0].head, got[0].jpeg) == (key, head(number), jpeg)

        await arrives(10, b"x" * MAX_FRAME)
        bad: list[tuple[bytes, bytes | None]] = [
            (b"no head", None),
            (b"no JSON", b"{"),
            (b"a field of the wrong type", b'{"number": "1", "time": 0, "width": 1, "height": 1}'),
            (b"a head without end", b" " * 100_000),
            (b"x" * (MAX_FRAME + 1), b'{"number": 1, "time": 0, "width": 1, "height": 1}'),
        ]
        raw = here._transport.publisher(key, None, Quality.FRAME)
        for payload, attachment in bad:
            before = watch.malformed
            await until_there(
                functools.partial(raw.put, payload, attachment), functools.partial(refused, watch, before)
            )
        await arrives(11, b"good")
        watch.close()
        publisher.close()


@dataclass
class Scene:
    """A framegrabber on a mesh with an RCM, and two video channels that it can receive."""

    lab: Lab
    client: Client
    rc: ResourceController
    driver: FramegrabberDriver
    one: MjpegServer
    two: MjpegServer

    def watch(self) -> FrameWatch:
        return self.client.mesh.frames(self.client.mesh.keys.frame(GRABBER))

    async def ask(self, grant: Any, name: str, **how: Any) -> Any:
        return (await self.client.command(GRABBER, grant, {"name": name} | how)).result


@asynccontextmanager
async def scene(folder: Path, *, rate: float = 60) -> AsyncIterator[Scene]:
    async with AsyncExitStack() as stack:
        lab = await stack.enter_async_context(Lab(folder))
        stand = await stack.enter_async_context(Stand(lab))
        # A source here that does not run for a while has not failed.
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setattr(framegrabber, "Capture", functools.partial(Capture, open_timeout=HANG, read_timeout=HANG))
        one = stack.enter_context(MjpegServer(rate=40))
        two = stack.enter_context(
            MjpegServer(rate=40, picture=lambda number: jpeg(numbered(BLUE + number, grey=False)))
        )
        leader = await ZenohMesh.open(lab.fleet_of("leader"), Sender("leader", "node"))
        stack.push_async_callback(leader.close)
        rcm = Rcm(leader, lab.fleet, Term(1, "test"), lambda _: BELIEVED, lambda _: None)
        rcm.start(RecoveredState())
        stack.callback(rcm.stop)
        sources = {"video/ch1": one.url, "video/ch2": two.url}
        driver = FramegrabberDriver(sources, rate=rate, quality=80)
        rc = await stand.rc(GRABBER, driver)
        for name in ("video/ch1", "video/ch2", "video/ch9"):
            await stand.rc(name, SharedBench())
        await stand.rc("robot/a", Bench())
        client = await lab.client()
        await lab.ready(client, GRABBER, "video/ch1", "video/ch2", "video/ch9", "robot/a")
        # That it has a picture was tried as it began: nobody is sent another, which would count.
        await until(lambda: one.connected == two.connected == 0)
        yield Scene(lab, client, rc, driver, one, two)


@pytest.mark.slow
async def test_frames_are_published_while_somebody_holds_and_somebody_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded: list[bytes] = []
    encode = framegrabber.encode

    def counted(picture: Any, quality: int) -> bytes:
        encoded.append(encode(picture, quality))
        return encoded[-1]

    monkeypatch.setattr(framegrabber, "encode", counted)
    async with scene(tmp_path) as at:
        # Free: somebody looks, and nothing is opened.
        tried = at.one.accepted, at.two.accepted
        watch = at.watch()
        await until(lambda: at.driver._publisher.watched)
        assert (at.one.accepted, at.two.accepted) == tried == (1, 0)

        first, grant = await running(at.client, "first", GRABBER, "video/ch1")
        frames = [await frame_of(watch) for _ in range(6)]
        assert {(frame.head.grant, frame.head.source) for frame in frames} == {(grant, "video/ch1")}
        numbers = [frame.head.number for frame in frames]
        assert numbers == sorted(set(numbers))
        times = [frame.head.time for frame in frames]
        assert times == sorted(times)
        for frame in frames:
            picture = picture_in(frame)
            # It came in three colours, and had none.
            assert picture.shape == (frame.head.height, frame.head.width) == (120, 160)
            assert 0 < number_of(picture) <= at.one.sent
        drawn = [number_of(picture_in(frame)) for frame in frames]
        # Numbers count the source's pictures, those included that were not published.
        assert len({here - there for here, there in zip(drawn, numbers, strict=True)}) == 1

        told = await at.ask(grant, "snapshot")
        assert told["source"] == "video/ch1"
        assert (told["health"], told["width"], told["height"]) == ("ok", 160, 120)
        assert told["number"] >= numbers[-1]
        # A frame may arrive before the thread that published it has counted it.
        await until(lambda: at.driver.figures()["latency_ms"] > 0 and at.driver.figures()["published"] >= 6)
        figures = (await at.lab.rc(at.client, GRABBER)).figures
        assert (figures["opened"], figures["stalls"], figures["width"]) == (1, 0, 160)
        assert 0 < figures["frames_per_second"] <= 60
        assert figures["published"] >= 6

        # A gang on another channel, with more weight: from its first frame on nothing is of the old hold.
        second, newer = await running(at.client, "second", GRABBER, "video/ch2", priority=5)
        seen = [await frame_of(watch)]
        while seen[-1].head.grant != newer:
            assert (seen[-1].head.grant, seen[-1].head.source) == (grant, "video/ch1")
            seen.append(await frame_of(watch))
        for _ in range(4):
            frame = await frame_of(watch)
            assert (frame.head.grant, frame.head.source) == (newer, "video/ch2")
            picture = picture_in(frame)
            assert picture.shape == (120, 160, 3)
            assert BLUE < number_of(picture) <= BLUE + at.two.sent
            assert frame.head.number > numbers[-1]
        await until(lambda: at.one.connected == 0)

        # Nobody looks: it stays open, and encodes nothing.
        watch.close()
        await until(lambda: not at.driver._publisher.watched)
        done = len(encoded)
        await look_at(at.driver, 10)
        assert len(encoded) <= done + 1
        assert at.two.connected == 1
        # Somebody looks again: at once there are frames, and not of those that gathered.
        before = looked_at(at.driver)
        with closing(at.watch()) as watch:
            assert (await frame_of(watch)).head.number >= before

            # Free again: it stays open for the next while somebody looks, and publishes nothing.
            await at.client.end(first)
            await at.client.end(second)
            await until(lambda: at.driver._holder is None)
            # Nothing was commanded under it: from its first frame to its last it was used.
            keys = at.client.mesh.keys
            reply = await at.client.mesh.ask_one(
                keys.ask_rc_state(GRABBER, at.client.mesh.me), RcAsk(), RcState, timeout=HANG
            )
            assert reply is not None
            assert reply.message is not None
            assert {use.grant: use.seconds for use in reply.message.used}[newer] > 0
            # One that was under way is counted.
            await look_at(at.driver, 3)
            published = at.driver.figures()["published"]
            await look_at(at.driver, 10)
            assert at.driver.figures()["published"] == published
            assert (at.two.connected, at.driver.figures()["opened"]) == (1, 2)

            # The next holder has it at once, but nothing that was there before its hold.
            assert at.driver._capture is not None
            before = at.driver._before["number"] + at.driver._capture.number
            third, newest = await running(at.client, "third", GRABBER, "video/ch2")
            frame = await frame_of(watch)
            while frame.head.grant == newer:  # it was under way
                frame = await frame_of(watch)
            assert frame.head.grant == newest
            assert frame.head.number > before
            assert at.driver.figures()["opened"] == 2

            # What is too old or too large is not sent.
            for limit, value in (("MAX_AGE", -1.0), ("MAX_FRAME", 100)):
                with monkeypatch.context() as patch:
                    patch.setattr(framegrabber, limit, value)
                    await look_at(at.driver, 3)
                    published = at.driver.figures()["published"]
                    await look_at(at.driver, 10)
                    assert at.driver.figures()["published"] == published
            assert at.driver.figures()["too_large"] > 0
            await at.client.end(third)
            await until(lambda: at.driver._holder is None)
        await until(lambda: at.two.connected == 0)
        assert at.driver._capture is None


async def test_tuning_by_hand(tmp_path: Path) -> None:
    async with scene(tmp_path, rate=10) as at:
        watch = at.watch()
        arc, grant = await running(at.client, "free", GRABBER, "robot/a")
        told = await at.ask(grant, "snapshot")
        assert told["source"] is None
        assert told["health"] == "no video channel is in its hold; tune it to one of video/ch1, video/ch2"
        assert (at.one.accepted, at.two.accepted) == (1, 0)

        def tune(**how: Any) -> Any:
            return answer(at.client.command(GRABBER, at_grant, {"name": "tune"} | how))

        at_grant = grant
        for wrong in ({}, {"to": 1}, {"to": "video/ch9"}, {"to": ["video/ch1"]}):
            assert await tune(**wrong) == "bad_command"
        assert await at.ask(grant, "tune", to="video/ch2") == {"source": "video/ch2"}
        times = []
        for _ in range(5):
            frame = await frame_of(watch)
            times.append(frame.head.time)
            assert frame.head.source == "video/ch2"
        # Of 40 a second 10 are published; one may be half an interval early.
        assert times[-1] - times[0] > 0.34
        assert await tune(to="video/ch1") == "done"
        frame = await frame_of(watch)
        while frame.head.source != "video/ch1":
            frame = await frame_of(watch)
        assert frame.head.grant == grant
        assert await answer(at.client.command(GRABBER, grant, {"name": "zoom"})) == "unknown_command"
        await at.client.end(arc)

        # A gang that has a channel is not shown another one's.
        arc, at_grant = await running(at.client, "mine", GRABBER, "video/ch1")
        assert await tune(to="video/ch2") == "bad_command"
        await at.client.end(arc)
        arc, at_grant = await running(at.client, "deaf", GRABBER, "video/ch9")
        assert "does not receive video/ch9" in (await at.ask(at_grant, "snapshot"))["health"]
        assert at.rc.health == "ok"
        await at.client.end(arc)


@pytest.mark.slow
async def test_a_source_that_falls_silent_loses_the_framegrabber_until_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(framegrabber, "UNWELL_AFTER", 2.0)
    async with scene(tmp_path) as at:
        monkeypatch.setattr(framegrabber, "TRY_NEXT_AFTER", 600)
        arc, grant = await running(at.client, "hide", GRABBER, "video/ch1")
        # Whether or not somebody looks: whoever holds it may be about to.
        await until(lambda: at.driver._capture is not None and at.driver._capture.number > 0)
        at.one.close()
        await until(lambda: arc.state == "queued")
        assert arc._ending is not None
        assert arc._ending.outcome == "lost"
        assert "no picture of video/ch1 for 2 s: http://127.0.0.1" in arc._ending.reason
        assert "can't be opened" in arc._ending.reason
        assert "no picture of video/ch1" in (await at.lab.rc(at.client, GRABBER)).health
        await until(lambda: at.driver._holder is None)
        at.one.open()
        async with asyncio.timeout(HANG):
            again = await at.client.granted(arc)
        assert again is not None
        assert again > grant
        watch = at.watch()
        frame = await frame_of(watch)
        while frame.head.grant != again:
            frame = await frame_of(watch)
        assert at.rc.health == "ok"

        # With several sources it is there for others as soon as any of them works.
        monkeypatch.setattr(framegrabber, "TRY_NEXT_AFTER", 0.3)
        at.one.close()
        await until(lambda: arc.state == "queued")
        await at.client.end(arc)
        await until(lambda: at.rc.health == "ok")
        arc, grant = await running(at.client, "other", GRABBER, "video/ch2")
        frame = await frame_of(watch)
        while frame.head.grant != grant:
            frame = await frame_of(watch)
        assert frame.head.source == "video/ch2"
        watch.close()
        await at.client.end(arc)
