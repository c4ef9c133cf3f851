"""`zscout motion` as people and programs run it: on files, on a camera over HTTP, and at a terminal."""

from __future__ import annotations

import json
import logging
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from rerun import RecordingStream
from rerun.chunk import RrdReader

from tests.behaviors.perception.scenes import Scene, box_of, overlap
from tests.cli.tools import COMMAND, Terminal, end, zscout_here
from tests.drivers.mjpeg import MjpegServer, jpeg
from tests.hang import HANG
from zscout.cli.operator import picture_recording
from zscout.services.recorder.drawing import unwritten

RATE = 10.0
COMES, GOES = 5.0, 7.0
"""Seconds between which somebody walks through."""


def walker_at(time: float) -> float | None:
    return 25 + 50 * (time - COMES) if COMES <= time < GOES else None


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds, through which somebody walks once."""
    path, scene = tmp_path_factory.mktemp("video") / "hall.avi", Scene(1, noise=3)
    fourcc = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, RATE, (320, 240))
    assert writer.isOpened()
    for number in range(round(10 * RATE)):
        large = cv2.resize(scene.picture(walker_at(number / RATE)), (320, 240))
        writer.write(np.asarray(cv2.merge([large, large, large]), np.uint8))
    writer.release()
    return path


def test_a_file_is_told_event_by_event(video: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert zscout_here("watch", "--source", video, "--json") == 0
    told = capsys.readouterr()
    events = [json.loads(line) for line in told.out.splitlines()]
    assert len(events) == 1
    event = events[0]
    assert COMES <= event["start"] <= COMES + 0.3
    assert GOES - 0.3 <= event["end"] <= GOES + 0.3
    left, top, width, height = box_of(walker_at(event["peak"]) or 0)
    box = event["boxes"][0]
    assert overlap((box[0], box[1], box[2], box[3]), (2 * left, 2 * top, 2 * width, 2 * height)) > 0.4
    assert event["area"][2] > 2 * event["boxes"][0][2]
    assert 15 <= event["frames"] <= 24
    assert event["going_on"] is False
    assert told.err.startswith("9.9 s watched, 100 pictures; 1 event, motion for ")


def test_in_a_pipe_it_is_plain_lines_and_the_limit_ends_it(video: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert zscout_here("watch", "--source", video, "--limit", 6) == 0
    event, summary = capsys.readouterr().out.splitlines()
    assert "motion and continues, one area at the peak, the largest " in event
    assert summary.startswith("6.0 s watched, 61 pictures; 1 event, motion for ")


def test_a_recording_has_pictures_boxes_and_events(video: Path, tmp_path: Path) -> None:
    file = tmp_path / "runs" / "hall.rrd"
    assert zscout_here("watch", "--source", video, "--record", file) == 0
    counts: dict[str, int] = {}
    for chunk in RrdReader(file).stream():
        counts[str(chunk.entity_path)] = counts.get(str(chunk.entity_path), 0) + chunk.num_rows
    assert counts["/picture"] == counts["/picture/moving"] == counts["/moving"] == 100
    assert counts["/events"] == 1


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--ignore", "0,0,0.5,1", "--ignore", "0.5,0,1,0,1,1,.5,1"], 0),
        (["--ignore", "0,0,1,0.2", "--min-area", "0.01", "--min-duration", "0.5"], 1),
        (["--min-area", "0.1"], 0),
        (["--min-duration", "5s"], 0),
    ],
)
def test_people_limit_what_is_told(
    options: list[str], told: int, video: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert zscout_here("motion", "--source", video, "--json", *options) == 0
    assert capsys.readouterr().out.count("\n") == told


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--ignore", "0,0,1", '--ignore: "0,0,1" has 3 numbers; write x and y of two opposite corners of a rectangle'),
        ("--ignore", "10,10,90,40", '--ignore: "10,10,90,40" is not a region; write numbers from 0 to 1 with commas'),
        ("--ignore", "0,0,0,1", '--ignore: "0,0,0,1" covers nothing; write'),
        ("--ignore", "nan,0,1,1", '--ignore: "nan,0,1,1" is not a region'),
        ("--min-area", "2", "--min-area"),
        ("--min-duration", "-1", "--min-duration"),
        ("--min-duration", "2h", "--min-duration: 2 h is out of range; write 0.0 s to 1 min"),
    ],
)
def test_a_limit_that_can_not_be_is_one_line(
    option: str, value: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert zscout_here("motion", "--source", "x.avi", option, value) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1


def test_too_many_regions_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert zscout_here("motion", "--source", "x.avi", *["--ignore", "0,0,1,1"] * 17) == 2
    words = "--ignore: has 17 regions with 34 corners; at most 16 regions with 100 corners are allowed"
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("none.avi", "can't be read (No such file or directory); name a video file"),
        (".", "is not a file; name a video file"),
        ("notes.txt", "there is no video in"),
        ("empty.avi", "there is no video in"),
        ("", "--source is empty"),
        (
            "http://127.0.0.1:1/video",
            "can't be opened: nothing listens there; does its server run, and is the port right?",
        ),
        ("/dev/video97", "can't be opened: No such file or directory"),
        ("tiny.avi", "are 4 by 4 pixels; each side must have 8 to"),
    ],
)
def test_a_source_that_gives_nothing_is_one_line_and_exit_code_2(
    source: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("notes.txt").write_text("no video\n" * 50)
    Path("empty.avi").touch()
    writer = cv2.VideoWriter("tiny.avi", cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 10, (4, 4))
    writer.write(np.zeros((4, 4, 3), np.uint8))
    writer.release()
    assert zscout_here("watch", "--source", source) == 2
    told = capsys.readouterr()
    assert words in told.err
    assert told.err.count("\n") == 1
    assert not told.out


def test_a_recording_that_cannot_be_written_is_refused(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert zscout_here("watch", "--source", video, "--record", tmp_path / "file" / "x.rrd") == 2
    told = capsys.readouterr().err
    assert "--record: can't record to" in told
    assert "name a file that can be written" in told


def test_a_disk_that_is_full_is_one_line_and_exit_code_1(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_recording, "unwritten", lambda *_: "x.rrd can't be written: its disk is full")
    assert zscout_here("motion", "--source", video, "--record", tmp_path / "x.rrd") == 1
    assert capsys.readouterr().err == "zscout: x.rrd can't be written: its disk is full\n"


@pytest.mark.parametrize(
    "name",
    ["v\udcff.avi", "f\udcff/v.avi", "http://127.0.0.1:9/\udcff", "/dev/v\udcff"],
    ids=["a file", "its folder", "an address", "a device"],  # a worker's messages are UTF-8
)
def test_a_name_that_is_not_utf8_is_one_line(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.CRITICAL, "zscout.drivers.capture")  # a test's report, which has its log, is UTF-8
    monkeypatch.chdir(tmp_path)
    if name.endswith(".avi"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_bytes(b"RIFF\0\0\0\0AVI ")
    assert zscout_here("motion", "--source", name) == 2
    error = capsys.readouterr().err
    assert ("is not UTF-8" in error) is name.endswith(".avi")
    assert error.startswith("zscout: ")
    assert error.count("\n") == 1


def test_a_folder_whose_name_is_not_utf8_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "f\udcff"
    folder.mkdir()
    monkeypatch.chdir(folder)
    Path("v.avi").write_bytes(b"RIFF\0\0\0\0AVI ")
    assert zscout_here("motion", "--source", "v.avi") == 2
    assert "or its folder is not UTF-8" in capsys.readouterr().err


def test_why_a_recording_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "x.rrd"
    good = SimpleNamespace(flush=lambda *, timeout_sec: None)
    dead = SimpleNamespace(flush=Mock(side_effect=RuntimeError("its writer ended")))
    assert unwritten(cast("RecordingStream", good), file, 1) == ""
    assert "x.rrd can't be written (its writer ended)" in unwritten(cast("RecordingStream", dead), file, 1)
    monkeypatch.setattr("os.statvfs", lambda _: SimpleNamespace(f_bavail=2, f_frsize=4096))
    assert unwritten(cast("RecordingStream", dead), file, 1).endswith(
        "x.rrd can't be written: its disk is full; free some"
    )


HANGING = """if True:
    import ctypes, sys
    from zscout.cli.main import main
    from zscout.cli.operator import picture_recording, watch

    def hang(*_, **__):
        mutex = ctypes.create_string_buffer(64)
        print("hangs", flush=True)
        for _ in range(2):
            ctypes.CDLL(None).pthread_mutex_lock(mutex)

    watch.END_TIMEOUT_S = 0.1
    picture_recording.WatchRecording.seen = hang
    main(sys.argv[1:])"""
"""A recording in which Rerun never returns; no signal handler of Python's runs then."""


@pytest.mark.live
@pytest.mark.slow
def test_a_signal_ends_it_though_its_recording_hangs(video: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", HANGING, "motion", "--source", str(video)]
    command += ["--record", str(tmp_path / "x.rrd")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "hangs\n"
        process.terminate()
        assert process.wait(HANG) == 128 + signal.SIGTERM


@pytest.fixture
def camera() -> Iterator[MjpegServer]:
    """Somebody walks by every two seconds; the connection breaks once."""
    scene = Scene(2, noise=3)

    def picture(number: int) -> bytes:
        if number == 50:
            server.cut()
        at = number / 20 % 2
        return jpeg(scene.picture(25 + 100 * (at - 1.3) if at >= 1.3 else None))

    server = MjpegServer(rate=20, picture=picture)
    with server:
        yield server


@pytest.mark.live
@pytest.mark.slow
def test_a_camera_that_breaks_off_is_opened_again_and_ctrl_c_ends_with_a_summary(camera: MjpegServer) -> None:
    process = subprocess.Popen(
        [*COMMAND, "watch", "--source", camera.url, "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    hangs = threading.Timer(HANG, process.kill)
    hangs.start()
    try:
        told = ""
        while "delivers pictures again" not in told:
            line = process.stderr.readline()
            assert line, told
            told += line
        # One from before the break may be among them.
        events = [json.loads(process.stdout.readline()) for _ in range(3)]
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=HANG)
        told += rest
    finally:
        hangs.cancel()
        process.kill()
        process.wait()
    assert process.returncode == 130
    assert all(event["start"] <= event["end"] and event["boxes"] for event in events)
    assert f"{camera.url} was cut off; opening it again" in told
    assert f"{camera.url} delivers pictures again" in told
    assert " watched, " in told.splitlines()[-1]
    assert camera.accepted >= 2


@pytest.mark.live
@pytest.mark.slow
def test_ctrl_c_does_not_wait_for_a_camera_that_is_silent(camera: MjpegServer) -> None:
    camera.mode = "stall"
    process = subprocess.Popen([*COMMAND, "watch", "--source", camera.url], stdout=subprocess.PIPE, text=True)
    try:
        # It has asked for pictures, and there are none.
        while not camera.connected:
            assert process.poll() is None
            threading.Event().wait(0.02)
        process.send_signal(signal.SIGINT)
        assert process.wait(HANG) == 130
    finally:
        end(process)


@pytest.mark.live
def test_at_a_terminal_there_is_a_live_line(video: Path) -> None:
    with Terminal("motion", "--source", video) as terminal:
        terminal.until("motion for")
        terminal.until("9.9 s watched, 100 pictures; 1 event")
        assert terminal.code() == 0
        assert "\x1b[" in terminal.raw
