"""Pictures, captions and boxes in real recordings, and what is no picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.services.recorder.paper_run import events, rows
from tests.services.recorder.robot_run import CAMERA, GRANT, NET, captions, head, jpeg, png, say
from zscout.behaviors.perception.lens import grey_picture
from zscout.drivers.image_size import MAX_SCANS, jpeg_size, png_size
from zscout.services.recorder import robots
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.timeline import Timeline
from zscout.types import Grant, Term


def test_a_picture_that_is_old_says_so(path: Path) -> None:
    picture = jpeg(0, "scout33", None)
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        tracker.no_frame(0, CAMERA)
        tracker.holds[CAMERA] = {GRANT: HolderRow("hide", robots=("robot/scout33",))}
        tracker.frame(1, CAMERA, head(1), picture)
        say(tracker, 1.5, "net/a/watch", "alert", camera=CAMERA, boxes=[[1, 2, 30, 40]], robot="robot/scout33")
        for at in (4, 7):
            tracker.no_frame(at, CAMERA)
        tracker.frame(8, CAMERA, head(2), picture)
        tracker.holds[CAMERA] = {}
        tracker.no_frame(11, CAMERA)
        tracker.frame(12, CAMERA, head(3, None), picture)
    assert [(at, text) for at, text, _ in captions(path, "fgrab1")] == [
        (1, "scout33"),
        (4, "scout33 · no picture"),
        (8, "scout33 · alert"),
        (11, "not held"),
        (12, ""),
    ]
    seen = {at: value for _, at, value in rows(path, "/camera/fgrab1", "EncodedImage:opacity")}
    assert {at for at, (value,) in seen.items() if value < 1} == {4, 11}
    # What was marked in an old picture is not marked in the next.
    assert [at for _, at, _ in rows(path, "/camera/fgrab1/boxes", "Clear:is_recursive")] == [4]


def test_an_old_picture_is_a_whole_one_in_the_next_file_too(path: Path, tmp_path: Path) -> None:
    """An opacity alone has no picture there."""
    picture = jpeg(0, "scout33", None)
    with Timeline("lab", path=path) as timeline:
        timeline.robots.frame(1, CAMERA, head(1), picture)
        timeline.roll(2, tmp_path / "next.rrd")
        timeline.robots.no_frame(4, CAMERA)
    shown = {at: bytes(blob) for _, at, (blob,) in rows(tmp_path / "next.rrd", "/camera/fgrab1", "EncodedImage:blob")}
    assert shown == {2: picture, 4: picture}


def test_boxes_end_with_what_they_mark(path: Path) -> None:
    picture = jpeg(0, "scout33", None)
    next_grant, box = Grant(Term(1, "rcm"), 8), [10, 10, 20, 20]
    holds = {GRANT: HolderRow("a", robots=("robot/a",)), next_grant: HolderRow("b", robots=("robot/b",))}
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        tracker.holds[CAMERA] = holds
        say(tracker, 0, "net/a", "alert", camera=CAMERA, boxes=[box])  # no picture to draw on yet
        tracker.frame(1, CAMERA, head(1), picture)
        bad = [[150, 110, 20, 20], [-1, 0, 5, 5], [160, 0, 5, 5], [0, 0, 161, 5], [0, 0, 0, 5], [10**9] * 4]
        say(tracker, 2, "net/a", "alert", camera=CAMERA, boxes=bad)
        say(tracker, 3, "net/a", "watch", camera=CAMERA)
        say(tracker, 4, "net/b", "alert", camera=CAMERA, boxes=[box])
        say(tracker, 5, "net/b", "wait")  # the hold is over: it names no camera
        say(tracker, 6, "net/c", "alert", camera=CAMERA, boxes=[box])
        tracker.frame(7, CAMERA, head(2, next_grant), picture)  # another robot is seen
        say(tracker, 8, "net/d", "alert", camera=CAMERA, boxes=[box])
        tracker.left(9, NET)
    drawn = [(at, len(value)) for _, at, value in rows(path, "/camera/fgrab1/boxes", "Boxes2D:half_sizes")]
    assert drawn == [(2, 1), (4, 1), (6, 1), (8, 1)]
    assert [at for _, at, _ in rows(path, "/camera/fgrab1/boxes", "Clear:is_recursive")] == [3, 5, 7, 9]


def test_what_is_no_picture_is_left_out(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots, "MAX_CAMERAS", 2)
    good = jpeg(0, "scout33", None)
    size = good.index(b"\xff\xc0") + 5
    with Timeline("lab", path=path) as timeline:
        for bad in (b"", b"\xff\xd8", png(), good[:size], good[:size] + b"\xff\xff\xff\xff" + good[size + 4 :]):
            timeline.robots.frame(0, "framegrabber/bad", head(1), bad)
        for number in range(4):
            timeline.robots.frame(1, f"framegrabber/cam{number}", head(1), good)
    assert {name for name, _, _ in rows(path, "/camera/**", "EncodedImage:blob")} == {"/camera/cam0", "/camera/cam1"}
    assert events(path) == [
        "timeline: bad sends pictures that are no JPEG of at most 4096 pixels a side: left out",
        "timeline: more than 2 cameras: the pictures of the others are not shown",
    ]


@given(st.integers(1, 200), st.integers(1, 200), st.integers(1, 100), st.data())
def test_the_head_of_a_picture_tells_its_size(width: int, height: int, quality: int, data: st.DataObject) -> None:
    picture = np.full((height, width, 3), 90, np.uint8)
    as_jpeg = bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
    as_png = bytes(cv2.imencode(".png", picture)[1])
    assert jpeg_size(as_jpeg) == png_size(as_png) == (width, height)
    assert jpeg_size(as_png) is None
    assert png_size(as_jpeg) is None
    # Whatever is cut off or spoiled, an answer is a size or none, and no error.
    cut = data.draw(st.integers(0, len(as_jpeg) - 1))
    spoiled = as_jpeg[:cut] + data.draw(st.binary(max_size=8)) + as_jpeg[cut + 1 :]
    for size in (jpeg_size(as_jpeg[:cut]), jpeg_size(spoiled), png_size(as_png[: len(as_png) * cut // len(as_jpeg)])):
        assert size is None or min(size) > 0


def test_a_picture_of_many_scans_is_left_out() -> None:
    picture = np.random.default_rng(1).integers(0, 255, (16, 16, 3), np.uint8)
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    progressive = bytes(cv2.imencode(".jpg", picture, options)[1])
    assert 1 < progressive.count(b"\xff\xda") <= MAX_SCANS
    assert jpeg_size(progressive) == (16, 16)
    scan = progressive[progressive.rindex(b"\xff\xda") : -2]
    bomb = progressive[:-2] + scan * 5_000 + progressive[-2:]
    assert jpeg_size(bomb) is None
    assert grey_picture(bomb) is None
