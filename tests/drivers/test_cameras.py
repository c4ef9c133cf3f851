"""Cameras as they are in the field: how each can fail, stills, slow ones, and those whose picture stands still."""

from __future__ import annotations

import base64
import hashlib
import http.server
import logging
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.drivers.mjpeg import MjpegServer, jpeg, numbered
from tests.drivers.rtsp import RtspServer
from tests.drivers.test_capture import capturing, later, picture_of, recording, until
from zscout.drivers import capture as module
from zscout.drivers.source_fault import why_closed

TIMEOUT = 30.0
"""Seconds: a machine that stands still is no server that does not answer."""


class Page(http.server.BaseHTTPRequestHandler):
    """Answers as its path says: `/503`, `/text/html`, `/basic` and `/digest` (user a, password `p@ss:w/rd#1`)."""

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        path = self.path[1:].partition("?")[0]
        if path.isdigit():
            self.send_response(int(path))
        elif path in ("basic", "digest"):
            given = self.headers.get("Authorization", "")
            good = given == "Basic " + base64.b64encode(b"a:p@ss:w/rd#1").decode()
            if path == "digest" and given.startswith("Digest "):
                good = self._digest(given)
            self.send_response(200 if good else 401)
            if not good:
                basic = 'Basic realm="cam"'
                wants = basic if path == "basic" else 'Digest realm="cam", nonce="n1", qop="auth"'
                self.send_header("WWW-Authenticate", wants)
        elif path == "loop":
            self.send_response(302)
            self.send_header("Location", "/loop")
        else:
            self.send_response(200)
            self.send_header("Content-Type", path)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _digest(self, given: str) -> bool:
        field = {key.strip(): text.strip('" ') for key, text in (part.split("=", 1) for part in given[7:].split(","))}

        def md5(text: str) -> str:
            return hashlib.md5(text.encode()).hexdigest()  # noqa: S324 - as RFC 7616 has it

        nonce = ":".join(field[name] for name in ("nonce", "nc", "cnonce", "qop"))
        return field["response"] == md5(f"{md5('a:cam:p@ss:w/rd#1')}:{nonce}:{md5('GET:' + field['uri'])}")


@pytest.fixture
def pages() -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@contextmanager
def answering(reply: bytes) -> Iterator[str]:
    """A server that answers anything with the same bytes and hangs up."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            while True:
                try:
                    client, _ = listener.accept()
                except OSError:
                    return
                with client:
                    client.recv(4096)
                    client.sendall(reply)

        threading.Thread(target=serve, daemon=True).start()
        yield f"127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("401", "it requires a user and password (401)"),
        ("403", "access is forbidden, perhaps only for this user (403)"),
        ("404", "it has no such page; is the path right? (404)"),
        ("503", "it is busy, or has no capacity left for another viewer (503)"),
        ("500", "internal error of the server (500)"),
        ("418", "it refuses this (418)"),
        ("599", "it failed (599)"),
        ("loop", "it redirects endlessly, or without a target (302)"),
        ("text/html", "it sends an HTML page, not pictures; is it a login page?"),
        ("application/json", "it sends application/json, not pictures"),
        ("image/jpeg", None),
        ("multipart/x-mixed-replace", None),
        ("basic", "it requires a user and password (401)"),
        ("digest", "it requires a user and password (401)"),
    ],
)
def test_each_failure_of_a_server_has_its_own_words(pages: str, path: str, words: str | None) -> None:
    assert why_closed(f"http://{pages}/{path}", TIMEOUT) == words


@pytest.mark.parametrize("kind", ["basic", "digest"])
def test_a_user_and_password_are_tried_before_they_are_called_wrong(pages: str, kind: str) -> None:
    assert why_closed(f"http://a:p%40ss%3Aw%2Frd%231@{pages}/{kind}", TIMEOUT) is None
    words = why_closed(f"http://a:secret@{pages}/{kind}", TIMEOUT)
    assert words == "it refuses this user and password (401)"


def test_what_is_no_server_of_pictures_has_its_own_words(pages: str) -> None:
    with socket.socket() as bound, answering(b"") as closes, answering(b"220 ftp\r\n") as other:
        bound.bind(("127.0.0.1", 0))
        for url, words in (
            ("http://no-such-camera.invalid/", "unknown host"),
            ("rtsp://no-such-camera.invalid/", "unknown host"),
            (f"http://127.0.0.1:{bound.getsockname()[1]}/", "nothing listens there"),
            (f"rtsp://127.0.0.1:{bound.getsockname()[1]}/", "nothing listens there"),
            (f"tcp://127.0.0.1:{bound.getsockname()[1]}", "nothing listens there"),
            (f"http://{closes}/", "hung up without an answer"),
            (f"rtsp://{closes}/", "hung up without an answer"),
            (f"http://{other}/", "does not speak HTTP"),
            (f"rtsp://{other}/", "does not speak RTSP"),
            (f"https://{pages}/", "does not speak TLS"),
            ("http://camera:port/", "the address is malformed"),
            ("http:///video", "the address is malformed"),
        ):
            found = why_closed(url, TIMEOUT)
            assert found is not None, url
            assert words in found or (words == "unknown host" and "name lookup" in found), url


def test_a_server_that_says_nothing_has_its_own_words() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for scheme in ("http", "rtsp"):
            url = f"{scheme}://127.0.0.1:{silent.getsockname()[1]}/"
            assert why_closed(url, 0.05) == "it did not answer within 0.05 s"


@pytest.mark.parametrize(
    ("status", "codec", "words"),
    [
        (200, "JPEG", None),
        (401, "JPEG", "it requires a user and password (401)"),
        (404, "JPEG", "it has no such page; is the path right? (404)"),
        (453, "JPEG", "it has no bandwidth left for another viewer (453)"),
        (200, "AV1", "it sends AV1, which can't be decoded here; set the camera to H.264, H.265 or MJPEG"),
    ],
)
def test_each_failure_of_an_rtsp_camera_has_its_own_words(status: int, codec: str, words: str | None) -> None:
    with RtspServer(colour, status=status, codec=codec) as server:
        assert why_closed(server.url, TIMEOUT) == words


def test_a_user_signs_in_to_rtsp_before_anything_is_called_wrong() -> None:
    with RtspServer(colour, status=404, password="s:1") as server:  # noqa: S106
        url = server.url.replace("//", "//a:s%3A1@")
        assert why_closed(url, TIMEOUT) == "it has no such page; is the path right? (404)"
        assert why_closed(url.replace("s%3A1", "wrong"), TIMEOUT) == "it refuses this user and password (401)"
        assert why_closed(server.url, TIMEOUT) == "it requires a user and password (401)"


def colour(number: int) -> NDArray[np.uint8]:
    return numbered(number, grey=False)


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_rtsp_goes_by_the_transport_that_is_asked_for(transport: str) -> None:
    with RtspServer(colour) as server, capturing(server.url, transport=transport, read_timeout=TIMEOUT) as capture:
        assert picture_of(capture).picture.shape == (120, 160, 3)
        assert server.transports == [transport]


class Shared:
    """Pictures that stand still while `still` is set."""

    def __init__(self) -> None:
        self.still = True

    def number(self, number: int) -> int:
        return 1 if self.still else number % 60_000 + 2


@pytest.mark.parametrize("kind", ["mjpeg", "stills", "rtsp"])
def test_a_source_that_sends_one_picture_for_ever_is_frozen(kind: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    shared = Shared()
    how = {"still_after": 0.3, "read_timeout": TIMEOUT}
    with serving(kind, shared) as url, capturing(url, **how) as capture:
        until(lambda: capture.health == "frozen: the same picture for more than 0.3 s" and capture.frozen > 0)
        assert not capture.failed
        assert later(capture).frozen >= 0.3
        shared.still = False
        until(lambda: capture.health == "ok")
        moving = later(capture)
        assert (moving.frozen, capture.frozen) == (0, 0)
        logged = [record.message for record in caplog.records if record.name == module.__name__]
        assert logged == [f"{url} gives pictures", f"{url} is frozen: the same picture for more than 0.3 s",
                          f"{url} gives new pictures"]  # fmt: skip


@contextmanager
def serving(kind: str, shared: Shared) -> Iterator[str]:
    if kind == "rtsp":
        with RtspServer(lambda number: colour(shared.number(number))) as rtsp:
            yield rtsp.url
    elif kind == "mjpeg":
        with MjpegServer(picture=lambda number: jpeg(numbered(shared.number(number)))) as server:
            yield server.url
    else:
        count = 0

        class Stills(http.server.BaseHTTPRequestHandler):
            def log_message(self, *_: object) -> None:
                pass

            def do_GET(self) -> None:
                nonlocal count
                count += 1
                self.send_response(200)
                self.send_header("Content-Type", "image/jpeg")
                coded = jpeg(numbered(shared.number(count)))
                self.send_header("Content-Length", str(len(coded)))
                self.end_headers()
                self.wfile.write(coded)

        stills = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Stills)
        threading.Thread(target=stills.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{stills.server_port}/still.jpg"
        stills.shutdown()
        stills.server_close()


def test_a_camera_of_stills_logs_no_picture(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    shared = Shared()
    shared.still = False
    with serving("stills", shared) as url, capturing(url, read_timeout=TIMEOUT) as capture:
        until(lambda: capture.opened >= 4)
        assert capture.health == "ok"
        assert [record.message for record in caplog.records] == [f"{url} gives pictures"]


def test_no_file_is_frozen_unless_that_is_asked_for(tmp_path: Path) -> None:
    path = recording(tmp_path / "still.avi", 1, rate=50)
    with capturing(str(path)) as capture, capturing(str(path), still_after=0.1) as asked:
        until(lambda: asked.frozen > 0 and capture.opened >= 20)
        assert (capture.frozen, capture.health) == (0, "ok")


def test_pictures_that_are_too_large_are_told_of_once(caplog: pytest.LogCaptureFixture) -> None:
    large = jpeg(np.zeros((4_200, 4_200), np.uint8), 10)
    with MjpegServer(picture=lambda _: large) as server, capturing(server.url, read_timeout=TIMEOUT) as capture:
        until(lambda: capture.opened >= 3)
        assert capture.failed
        (line,) = [record.message for record in caplog.records]
        assert line == f"the pictures of {server.url} are 4200 by 4200 pixels; at most 16 million can be"


def av1(path: Path) -> Path:
    """An AV1 video: the picture of an AVIF in the container IVF."""
    good, coded = cv2.imencode(".avif", np.asarray(cv2.merge([numbered(1)] * 3), np.uint8))
    assert good
    data = coded.tobytes()
    frame = data[data.index(b"mdat") + 4 :]
    head = struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, b"AV01", 160, 120, 25, 1, 50, 0)
    path.write_bytes(head + b"".join(struct.pack("<IQ", len(frame), number) + frame for number in range(50)))
    return path


def test_a_codec_that_can_not_be_decoded_is_named(tmp_path: Path) -> None:
    with capturing(str(av1(tmp_path / "video.ivf"))) as capture:
        until(lambda: capture.failed)
        assert "sends AV1, which can't be decoded here; set the camera to H.264, H.265 or MJPEG" in capture.health


def test_a_reason_has_no_password(pages: str) -> None:
    with capturing(f"http://me:secret@{pages}/basic?secret") as capture:
        until(lambda: capture.failed)
        assert capture.health == f"http://{pages}/basic can't be opened: it refuses this user and password (401)"


def test_a_slow_camera_is_open_to_who_waits_for_it() -> None:
    with MjpegServer(rate=1.2) as server:
        how: dict[str, Any] = {"open_timeout": TIMEOUT, "read_timeout": TIMEOUT}
        with capturing(server.url, **how) as capture:
            assert later(capture).number > 0
            assert (capture.opened, capture.stalls) == (1, 0)
