"""The newest picture of real sources, which stall, tear, go away and come back."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.drivers.mjpeg import MjpegServer, jpeg, number_of, numbered
from tests.hang import HANG
from zscout.drivers.capture import Capture, CapturedFrame, kind_of, shown


@contextmanager
def capturing(source: str, **how: Any) -> Iterator[Capture]:
    capture = Capture(source, **how)
    try:
        yield capture
    finally:
        capture.stop()


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + HANG
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def picture_of(capture: Capture, after: int = 0) -> CapturedFrame:
    captured = capture.wait(after, HANG)
    assert captured is not None, capture.health
    return captured


def later(capture: Capture) -> CapturedFrame:
    """A picture newer than all that is there."""
    return picture_of(capture, capture.number)


def recording(path: Path, numbers: int, *, rate: float, size: tuple[int, int] = (160, 120)) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, size)
    assert writer.isOpened()
    for number in range(1, numbers + 1):
        writer.write(cv2.merge([numbered(number, width=size[0], height=size[1])] * 3))
    writer.release()
    return path


def test_pictures_come_whole_and_in_order() -> None:
    with MjpegServer(picture=lambda number: jpeg(numbered(number, grey=False))) as server:
        with capturing(server.url) as capture:
            first = picture_of(capture)
            assert first.picture.shape == (120, 160, 3)
            assert first.picture.dtype == np.uint8
            seen = [first]
            for _ in range(8):
                seen.append(picture_of(capture, seen[-1].number))
            assert capture.health == "ok"
            assert (capture.opened, capture.stalls) == (1, 0)
        told = [captured.number for captured in seen]
        drawn = [number_of(captured.picture) for captured in seen]
        assert told == sorted(set(told))
        # No picture was lost before it was numbered: the difference is what went before the first.
        assert len({number - here for number, here in zip(drawn, told, strict=True)}) == 1
        times = [captured.time for captured in seen]
        assert times == sorted(times)
        # A capture that has ended lets go of its camera.
        until(lambda: server.connected == 0)


def test_a_slow_reader_gets_the_newest_picture() -> None:
    with MjpegServer(rate=60) as server, capturing(server.url) as capture:
        got = picture_of(capture)
        for _ in range(3):
            before = got
            until(lambda before=before: capture.number >= before.number + 20)  # type: ignore[misc]
            newest, got = capture.number, picture_of(capture, before.number)
            # Whatever gathered meanwhile is skipped.
            assert got.number >= newest
            assert number_of(got.picture) >= number_of(before.picture) + 20
        assert capture.dropped >= 3 * 19


def test_each_picture_is_given_once_and_read_ones_are_not_dropped() -> None:
    with MjpegServer(rate=20) as server, capturing(server.url, read_timeout=0.4) as capture:
        number = picture_of(capture).number
        server.mode = "stall"
        until(lambda: capture.stalls > 0)
        last, dropped = capture.number, capture.dropped
        assert capture.wait(last, 0) is None
        assert capture.wait(last, 0.01) is None
        assert last == number or capture.wait(number, 0) is not None
        assert capture.wait(0, 0) is not None
        server.mode = "run"
        picture_of(capture, last)
        assert capture.dropped - dropped <= capture.number - last - 1


def test_a_stream_that_is_cut_off_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    """Only a camera of stills ends after each picture."""
    with MjpegServer(rate=20) as server, capturing(server.url) as capture:
        until(lambda: capture.number >= 3)
        server.cut()
        until(lambda: capture.opened >= 2)
        picture_of(capture, capture.number)
    assert any(record.getMessage().endswith("was cut off") for record in caplog.records)


def test_a_stalled_stream_is_opened_again() -> None:
    with MjpegServer() as server, capturing(server.url, read_timeout=0.4) as capture:
        before = later(capture)
        server.mode = "stall"
        until(lambda: capture.stalls >= 1)
        until(lambda: re.match(r"no picture from http://127\.0\.0\.1:.* 0\.4 s", capture.health) is not None)
        server.mode = "run"
        after = picture_of(capture, capture.number)
        assert after.number > before.number
        assert number_of(after.picture) > number_of(before.picture)
        assert capture.opened >= 2
        assert capture.health == "ok"


def test_a_server_that_goes_away_and_comes_back() -> None:
    with MjpegServer() as server, capturing(server.url) as capture:
        picture_of(capture)
        server.close()
        until(lambda: "can't be opened" in capture.health)
        gone, opened = capture.number, capture.opened
        server.open()
        assert picture_of(capture, gone).number > gone
        assert (capture.opened, capture.stalls) == (opened + 1, 0)


@pytest.mark.parametrize("mode", ["half", "torn"])
def test_half_a_picture_is_no_picture(mode: str) -> None:
    texture = np.random.default_rng(1).integers(0, 20, (120, 160), np.uint8)
    # The number stands in either half: FFmpeg fills what is missing from an older picture.
    twice = 257
    with (
        # So slow that this is over before there are too many for 16 bits.
        MjpegServer(rate=8, picture=lambda number: jpeg(numbered(twice * number) + texture)) as server,
        capturing(server.url, open_timeout=0.8, read_timeout=0.8) as capture,
    ):
        seen = picture_of(capture)
        server.mode = mode
        accepted, halves = server.accepted, 0
        end = time.monotonic() + HANG
        # Until it has opened the stream again after a half, and got whole ones.
        while not halves or number_of(seen.picture) <= twice * halves:
            if not halves and server.accepted > accepted:
                server.mode, halves = "run", server.sent
            seen = capture.wait(seen.number, 0.02) or seen
            assert number_of(seen.picture) % twice == 0
            assert server.sent < 256
            assert time.monotonic() < end


def test_garbled_pictures_do_not_end_the_stream_the_first_included() -> None:
    with MjpegServer(rate=60) as server:
        server.mode = "garble"
        with capturing(server.url) as capture:
            picture_of(capture)
            sent = server.sent
            until(lambda: server.sent > sent + 20)
            server.mode = "run"
            after = server.sent
            until(lambda: (got := capture.wait(0, 0)) is not None and number_of(got.picture) > after)
            assert (capture.health, capture.stalls, capture.opened, server.accepted) == ("ok", 0, 1, 1)


def test_a_page_that_is_not_there_is_told_and_tried_again_ever_more_rarely() -> None:
    with MjpegServer() as server:
        server.mode = "404"
        began = time.monotonic()
        with capturing(server.url) as capture:
            # Each is followed by a question why it failed.
            until(lambda: server.accepted >= 5)
            # 0.2 and 0.4 s: a busy machine makes it longer, never shorter.
            assert time.monotonic() - began > 0.5
            assert "can't be opened: it has no such page" in capture.health
            assert (capture.opened, capture.number) == (0, 0)
            server.mode = "run"
            picture_of(capture)
            assert capture.health == "ok"


def test_of_two_openers_the_second_waits_for_the_first() -> None:
    with MjpegServer(clients=1) as server:
        with capturing(server.url) as first:
            picture_of(first)
            second = Capture(server.url)
            until(lambda: "can't be opened" in second.health)
            assert later(first).number > 0
        picture_of(second)
        assert second.health == "ok"
        second.stop()


def test_a_silent_server_holds_up_nobody_and_stop_does_not_wait_for_it() -> None:
    with MjpegServer() as silent, MjpegServer() as server:
        silent.mode = "stall"
        blocked = Capture(silent.url, open_timeout=60)
        until(lambda: silent.accepted == 1)
        with capturing(server.url) as capture:
            # OpenCV's own lock would keep this one out for 60 s.
            picture_of(capture)
        blocked.stop(0.05)
        assert blocked.alive
        silent.cut()
        until(lambda: not blocked.alive)


@pytest.mark.live
@pytest.mark.parametrize("mode", ["run", "stall"])
def test_a_process_ends_whatever_its_captures_do(mode: str) -> None:
    with MjpegServer() as server:
        server.mode = mode
        code = (
            "import sys\n"
            "from zscout.drivers import capture\n"
            "capture.EXIT_WAIT = 0.3\n"
            "capture = capture.Capture(sys.argv[1], open_timeout=600)\n"
            "sys.stdin.readline()\n"
        )
        process = subprocess.Popen(
            [sys.executable, "-c", code, server.url], stdin=subprocess.PIPE, stderr=subprocess.PIPE
        )
        until(lambda: server.accepted == 1 and (mode == "stall" or server.sent > 5))
        assert (process.communicate(timeout=HANG)[1], process.returncode) == (b"", 0)


def test_who_waits_is_let_go_by_stop() -> None:
    with MjpegServer() as server, capturing(server.url) as capture:
        picture_of(capture)
        got: list[CapturedFrame | None] = []
        waiter = threading.Thread(target=lambda: got.append(capture.wait(10**9, 600)))
        waiter.start()
        capture.stop()
        waiter.join(HANG)
        assert got == [None]


def test_a_file_runs_at_its_own_rate_and_from_its_start_again(tmp_path: Path) -> None:
    path = recording(tmp_path / "film.avi", 6, rate=50)
    with capturing(str(path)) as capture:
        seen = [picture_of(capture)]
        began = seen[0]
        while seen[-1].number < 20:
            seen.append(picture_of(capture, seen[-1].number))
        assert capture.health == "ok"
        assert capture.opened >= 3
    # Read no faster than it was recorded.
    assert seen[-1].time - began.time > 0.9 * (seen[-1].number - began.number) / 50
    for captured in seen:
        assert number_of(captured.picture) == (captured.number - 1) % 6 + 1


def health_of(source: str) -> str:
    """As soon as it was tried to open it."""
    with capturing(source) as capture:
        until(lambda: capture.health != "not open yet")
        return capture.health


def test_sources_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "text.avi").write_bytes(b"no video at all\n" * 100)
    (tmp_path / "empty.avi").touch()
    for name, words in (
        ("gone.avi", "gone.avi can't be opened: No such file or directory"),
        ("text.avi", "text.avi can't be opened: it is not a video"),
        ("empty.avi", "empty.avi can't be opened: it is not a video"),
        ("film.avi/", "No such file or directory"),
        (".", " is not a file"),
        ("/dev/null", "can't be opened"),
    ):
        assert words in health_of(f"{tmp_path / name}{'/' * name.endswith('/')}")
    assert "can't be opened" in health_of("99")


def test_a_file_that_appears_later_is_found(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    with capturing(str(path)) as capture:
        until(lambda: "No such file" in capture.health)
        ready = recording(tmp_path / "new.avi", 5, rate=25)
        ready.rename(path)
        assert number_of(picture_of(capture).picture) == 1


def test_what_a_source_is() -> None:
    kinds = {"device": ("0", "12", "/dev/video0"), "url": ("http://camera/video", "rtsp://camera:554/1")}
    kinds["file"] = "film.avi", "./0", "²", ""
    for kind, sources in kinds.items():
        assert {kind_of(source) for source in sources} == {kind}


def test_secrets_of_a_url_are_not_told() -> None:
    for source, told in (
        ("rtsp://me:secret@camera:554/1?token=secret", "rtsp://camera:554/1"),
        ("http://secret@[fe80::1]/video#secret", "http://[fe80::1]/video"),
        ("http://me:secret@camera:notaport/", "http://..."),
        ("film secret.avi", "film secret.avi"),
    ):
        assert shown(source) == told


def test_a_secret_is_not_in_the_words_of_health() -> None:
    with MjpegServer() as server:
        server.mode = "404"
        with capturing(server.url.replace("//", "//me:secret@") + "?secret") as capture:
            until(lambda: "can't be opened" in capture.health)
            assert "secret" not in capture.health
            assert server.url in capture.health
