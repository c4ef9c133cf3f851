"""Pictures of recordings with robots, taken by the real viewer."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from tests.services.recorder.robot_run import BUILDING, GRANT, head, jpeg, png, poses, record, say
from tests.services.recorder.test_viewer_picture import DIMMED, WIDTH, look, pixels, rgb
from zscout.messages import BuildingPlan, RcState
from zscout.services.recorder.blueprint import FLOOR_WORDS
from zscout.services.recorder.colours import ALERT, DOING, HIDDEN, IN_THE_OPEN, OPERATOR, PERSON
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.timeline import Timeline

pytestmark = [pytest.mark.live, pytest.mark.slow]

HEIGHT = 900
PANES = 0.57
"""Part of the width that the panes at the left have."""
FLOOR, CAMERAS = (65, 410), (440, 620)
"""From and to which row of pixels these panes reach."""


def test_a_minute_of_robots_at_a_glance(path: Path, tmp_path: Path) -> None:
    record(path, until=37)
    picture, state = look(path, tmp_path, panes=10, height=HEIGHT)
    assert {view.name for view in state.views} == {
        "Who holds each device",
        "What each request is doing",
        "What each behavior is doing",
        "Load average (1 min) per host",
        f"Floor   {FLOOR_WORDS}",
        "fgrab1",
        "fgrab2",
        "Events",
        "Who comes and goes",
        "Devices (point at a curve)",
    }
    left = round(WIDTH * PANES)
    lanes = picture.crop((0, 550, left, 740))
    for word in ("search", "approach", "enter", "turn", "hidden", "watch", "alert", "unstick", "wait"):
        assert len(pixels(lanes, rgb(DOING[word], DIMMED))) > 100, word
    floor = picture.crop((left, FLOOR[0], WIDTH, FLOOR[1]))
    # Points are shaded as balls are.
    for colour in (HIDDEN, IN_THE_OPEN, OPERATOR, ALERT, PERSON):
        assert len(pixels(floor, rgb(colour), 30)) > 20, f"{colour:08X}"
    # The first camera has the detector's box, the second is the operator's.
    middle = (WIDTH + left) // 2
    one, two = (picture.crop((start, CAMERAS[0], end, CAMERAS[1])) for start, end in ((left, middle), (middle, WIDTH)))
    frame = pixels(one, rgb(ALERT))
    across, down = ([spot[axis] for spot in frame] for axis in (0, 1))
    assert len(frame) > 200
    # 26 by 44 of the picture's 160 by 120 pixels, and half a line at each side.
    assert abs((max(across) - min(across)) / (max(down) - min(down)) - 26 / 44) < 0.08
    assert pixels(two, rgb(ALERT)) == []
    assert is_a_picture(one)
    assert is_a_picture(two)


def test_a_camera_that_nobody_holds_is_dimmed_and_nothing_is_red(path: Path, tmp_path: Path) -> None:
    cameras = ("framegrabber/fgrab1", "framegrabber/fgrab2")
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        tracker.holds[cameras[0]] = {GRANT: HolderRow("hide", robots=("robot/scout33",))}
        for camera, grant in zip(cameras, (GRANT, None), strict=True):
            tracker.frame(1, camera, head(1, grant), jpeg(0, "scout33", None))
        tracker.holds[cameras[0]] = {}
        for camera in cameras * 2:
            tracker.no_frame(4, camera)
        timeline.event(5, "the last is an old picture")
    picture, _ = look(path, tmp_path, panes=7, height=HEIGHT)
    panes = picture.crop((round(WIDTH * PANES), 60, WIDTH, 410))
    assert is_a_picture(panes, 50), "dimmed, and there"
    assert [pixel for _, pixel in panes.getcolors(1 << 24) or [] if pixel[0] > max(pixel[1:]) + 40] == []  # type: ignore[index]


def is_a_picture(pane: Image.Image, least: int = 100) -> bool:
    """Whether there are as many greys as a noisy picture has."""
    greys = {pixel for _, pixel in pane.getcolors(WIDTH * HEIGHT) or [] if len(set(pixel)) == 1}  # type: ignore[arg-type]
    return len(greys) > least


def test_garbled_pictures_and_words_do_not_end_the_viewer(path: Path, tmp_path: Path) -> None:
    """Seen as a live view shows it: the layout has grown with what came."""
    live = tmp_path / "live.rrd"
    good, plan = jpeg(0, "scout33", None), bytearray(png())
    torn = bytearray(good)
    torn[700::7] = b"\xff" * len(torn[700::7])
    plan[200:400] = bytes(200)
    words = "日本 \U0001f916 ✖ عربى"
    with Timeline("lab", path=path) as timeline:
        robots = timeline.robots
        say(robots, 0, f"net/{words}", "search", detail=words)
        for name, picture in (("half", good[: len(good) // 2]), ("torn", bytes(torn)), (words, good)):
            camera = f"framegrabber/{name}"
            robots.holds[camera] = {GRANT: HolderRow("hide", robots=(f"robot/{words}",))}
            robots.frame(0, camera, head(1), picture)
        robots.floor.poses(0, BUILDING, poses([]))
        robots.floor.plan(0, BUILDING, BuildingPlan(words, 6, 4.5, bytes(plan)))
        robots.state(0, RcState(words, "cart", "i", sharable=False, figures={words: 1.0}))
        robots.no_frame(1, "framegrabber/half")
        for number in range(4):
            robots.frame(1, f"framegrabber/fgrab{number}", head(1), good)
        assert robots.floor.size is not None
        timeline.flush(10)
        live.write_bytes(path.read_bytes())
    # Seven cameras on two pages, and each of the other panes.
    look(live, tmp_path, panes=7 + 8, height=HEIGHT)
