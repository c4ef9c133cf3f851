"""MJPEG over HTTP, as OpenCV, browsers and strangers ask for it."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.hang import HANG
from tests.simulation.building.real_time import in_real_time, until, with_served
from zscout.config.strict import BadInput
from zscout.simulation.building import video_server
from zscout.simulation.building.video_server import MAX_CLIENTS, MAX_REQUEST, VideoServer

TIMEOUTS = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 20_000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, 20_000]
Picture = NDArray[np.uint8]


def jpeg(grey: int) -> bytes:
    picture = np.full((120, 160), grey, np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


served = with_served(lambda: VideoServer(["ch1", "ch2"]))


async def shown(server: VideoServer, channel: str, frames: Callable[[], bytes]) -> None:
    """Shows frames until it is cancelled, some hundred a second."""
    while True:
        server.show(channel, frames())
        await asyncio.sleep(0.01)


class Showing:
    """Frames are shown as long as the context lasts."""

    def __init__(self, server: VideoServer, channel: str, frames: Callable[[], bytes]) -> None:
        self._task = asyncio.ensure_future(shown(server, channel, frames))

    async def __aenter__(self) -> None:
        return None

    async def __aexit__(self, *exc: object) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


def with_opencv(url: str, count: int) -> list[Picture]:
    """The next frames as OpenCV reads them."""
    capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, TIMEOUTS)
    try:
        assert capture.isOpened()
        pictures = []
        for _ in range(count):
            good, picture = capture.read()
            assert good
            pictures.append(np.asarray(picture, np.uint8))
        return pictures
    finally:
        capture.release()


def address(server: VideoServer) -> tuple[str, int]:
    host, port = server.page.removeprefix("http://").rstrip("/").split(":")
    return host, int(port)


async def asked(server: VideoServer, request: bytes, *, ends: bool = False) -> bytes:
    """What the server answers to these bytes until it closes."""
    reader, writer = await asyncio.open_connection(*address(server))
    try:
        writer.write(request)
        with suppress(ConnectionError):
            await writer.drain()
        if ends:
            writer.write_eof()
        async with asyncio.timeout(HANG):
            return await reader.read()
    finally:
        writer.close()


def get(path: str) -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode()


def status(answer: bytes) -> int:
    return int(answer.split()[1])


@served
async def test_opencv_reads_two_channels_at_a_time(server: VideoServer) -> None:
    async with Showing(server, "ch1", lambda: jpeg(40)), Showing(server, "ch2", lambda: jpeg(200)):
        first, second, again = await asyncio.gather(
            *(asyncio.to_thread(with_opencv, server.url(name), 5) for name in ("ch1", "ch2", "ch1"))
        )
    assert {picture.shape for picture in first + second} == {(120, 160, 3)}
    for pictures, grey in ((first, 40), (again, 40), (second, 200)):
        assert all(abs(float(picture.mean()) - grey) < 3 for picture in pictures)
    await until(lambda: server.clients == 0)


@served
async def test_a_channel_is_watched_only_while_somebody_looks(server: VideoServer) -> None:
    assert server.watched == ()
    reader, writer = await asyncio.open_connection(*address(server))
    writer.write(get("/ch2"))
    await until(lambda: server.watched == ("ch2",))
    server.stall("ch2")
    assert server.watched == ()
    server.stall("ch2", stalled=False)
    server.show("ch2", jpeg(90))
    assert b"200 OK" in await reader.readuntil(b"\r\n")
    writer.close()
    # Without a frame being shown it is noticed that nobody is there.
    await until(lambda: server.watched == ())


@served
async def test_one_frame_alone_and_the_page_with_the_links(server: VideoServer) -> None:
    async with Showing(server, "ch1", lambda: jpeg(130)):
        head, _, body = (await asked(server, get("/ch1.jpg"))).partition(b"\r\n\r\n")
    assert b"Content-Type: image/jpeg" in head
    assert body == jpeg(130)
    page = await asked(server, get("/"))
    assert status(page) == 200
    assert b'href="/ch1"' in page
    assert b'href="/ch2.jpg"' in page
    only_head = await asked(server, b"HEAD /ch1 HTTP/1.1\r\n\r\n")
    assert b"multipart/x-mixed-replace" in only_head
    assert only_head.endswith(b"\r\n\r\n")


@served
async def test_a_frame_that_never_comes_is_refused_in_the_end(
    server: VideoServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video_server, "FRAME_TIME", 0.05)
    server.stall("ch1")
    assert status(await asked(server, get("/ch1.jpg"))) == 503


@served
async def test_who_does_not_read_holds_up_nobody_and_gets_the_newest_in_the_end(server: VideoServer) -> None:
    with socket.socket() as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        await asyncio.to_thread(slow.connect, address(server))
        slow.sendall(get("/ch1"))
        await until(lambda: server.watched == ("ch1",))
        noise = np.random.default_rng(1).integers(0, 255, (60, 60), np.uint8)
        small = cv2.imencode(".jpg", noise)[1].tobytes()
        tried: list[int] = []

        def frame() -> bytes:
            tried.append(server.sent)
            return small

        async with Showing(server, "ch1", frame):
            # Nothing left any more while twenty were shown.
            await until(lambda: len(tried) > 20 and tried[-20] == tried[-1])
            held = server.sent
            pictures = await asyncio.to_thread(with_opencv, server.url("ch1"), 20)
        assert len(pictures) == 20
        # The last one shown is the one it gets when it reads on, after what the kernel had taken.
        server.show("ch1", b"the newest")
        slow.settimeout(HANG)
        got = b""
        while b"the newest" not in got:
            more = await asyncio.to_thread(slow.recv, 65_536)
            assert more
            got = got[-100:] + more
    # Nothing but the kernel kept frames for it: they would grow old.
    assert held < 12
    assert server.missed > 0


@served
async def test_who_reads_nothing_for_long_is_cut_off(server: VideoServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video_server, "SEND_TIME", 0.2)
    with socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        await asyncio.to_thread(deaf.connect, address(server))
        deaf.sendall(get("/ch1"))
        await until(lambda: server.watched == ("ch1",))
        async with Showing(server, "ch1", lambda: bytes(500_000)):
            await until(lambda: server.watched == () and server.clients == 0)
        # What was left of the frame is not kept for it.
        deaf.settimeout(HANG)
        got = 0
        while more := await asyncio.to_thread(deaf.recv, 65_536):
            got += len(more)
        assert got < 500_000


@pytest.mark.parametrize(
    ("request_bytes", "code"),
    [
        (b"GET /ch3 HTTP/1.1\r\n\r\n", 404),
        (b"GET /../etc/passwd HTTP/1.1\r\n\r\n", 404),
        (b"GET /ch1/../ch2 HTTP/1.1\r\n\r\n", 404),
        (b"GET /<script> HTTP/1.1\r\n\r\n", 404),
        (b"POST /ch1 HTTP/1.1\r\nContent-Length: 5\r\n\r\nhello", 405),
        (b"GET http://elsewhere/ HTTP/1.1\r\n\r\n", 400),
        (b"GET /ch1 HTTP/9.9\r\n\r\n", 400),
        (b"GET  /ch1 HTTP/1.1\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n", 400),
        (b"\x00" * 100 + b"\r\n\r\n", 400),
        (b"GET /" + b"a" * 2_000 + b" HTTP/1.1\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * MAX_REQUEST + b"\r\n", 431),
        (b"GET /" + b"a" * 10 * MAX_REQUEST, 431),
    ],
)
@served
async def test_hostile_requests_are_refused(server: VideoServer, request_bytes: bytes, code: int) -> None:
    assert status(await asked(server, request_bytes)) == code
    assert server.refused == 1
    await until(lambda: server.clients == 0)


@served
async def test_half_a_request_is_refused_when_it_ends_or_takes_too_long(
    server: VideoServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert status(await asked(server, b"GET /ch1 HT", ends=True)) == 400
    assert await asked(server, b"", ends=True) == b""
    monkeypatch.setattr(video_server, "REQUEST_TIME", 0.05)
    assert status(await asked(server, b"GET /ch1 HT")) == 408


@served
async def test_more_clients_than_there_is_room_for_are_told_so(server: VideoServer) -> None:
    many = [await asyncio.open_connection(*address(server)) for _ in range(MAX_CLIENTS)]
    for _, writer in many:
        writer.write(get("/ch1"))
    await until(lambda: server.clients == MAX_CLIENTS)
    assert status(await asked(server, get("/ch1"))) == 503
    for _, writer in many:
        writer.close()
    await until(lambda: server.clients == 0)
    assert status(await asked(server, get("/"))) == 200


@in_real_time
async def test_an_address_that_cannot_be_served_on() -> None:
    async with VideoServer(["ch1"]) as server:
        _, port = address(server)
        for host, number, words in (
            ("127.0.0.1", port, "in use"),
            ("192.0.2.1", 0, "choose another"),
            ("127.0.0.1", 70_000, "choose another"),
        ):
            with pytest.raises(BadInput, match=words):
                await VideoServer(["ch1"], host=host, port=number).__aenter__()


@in_real_time
async def test_the_server_ends_with_clients_that_stay() -> None:
    async with VideoServer(["ch1"]) as server:
        _, writer = await asyncio.open_connection(*address(server))
        writer.write(get("/ch1"))
        await until(lambda: server.watched == ("ch1",))
    assert server.clients == 0
    writer.close()
