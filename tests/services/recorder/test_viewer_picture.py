"""A real picture: the recording of the paper's example, opened by the real viewer without a screen."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from decimal import Decimal
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from PIL import Image, ImageChops
from rerun.experimental import ViewerClient, ViewerState

from tests.hang import HANG
from tests.ports import free_port
from tests.services.recorder.paper_run import (
    FGRAB1,
    FGRAB2,
    RCS,
    RERUN,
    SCOUT33,
    SCOUT35,
    TABLE2,
    lanes,
    play_table1,
    second_by_second,
)
from zscout.messages import BookedDate, BookingsTold, BookingView
from zscout.services.recorder.blueprint import AHEAD, LIVE_WINDOW, MARGIN, ONE_PANE, TIME
from zscout.services.recorder.colours import ABSENT, ALERT, LINES, MAINTENANCE, OPERATOR, PALETTE, STATES
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.timeline import Timeline

pytestmark = pytest.mark.live

SECONDS = 18
WIDTH, HEIGHT = 1600, 1000
PANES = 0.62
"""Part of the width that the panes with a time axis have."""
HOSTS = {"anvil": 4.0, "bellows": 10.0, "crucible": 16.0}
"""When each host's load is at its peak, in seconds."""
DIMMED = 200 / 255
"""The viewer paints a state's bar with this part of its colour."""

ARCS = {"0": PALETTE[0], "1": PALETTE[1], "2": PALETTE[2], "3": PALETTE[3], "4": OPERATOR}
"""arc4 is the operator's."""
WORDS = {state[0]: colour for state, colour in STATES.items()}

Rgb = tuple[int, int, int]
T = TypeVar("T")


def record(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        play_table1(timeline)
        for quarter in range(SECONDS * 4 + 1):
            for host, peak in HOSTS.items():
                load = 0.1 + 1.5 * math.exp(-(((quarter / 4 - peak) / 3.5) ** 2))
                timeline.hosts.load(quarter / 4, host, load, cpu=0.5)


@contextmanager
def viewer(recording: Path, home: Path, *, panes: int = 5, height: int = HEIGHT) -> Iterator[ViewerClient]:
    """A viewer without a window that has the recording open; skips where it finds no graphics driver.

    `panes` are those that the recording's layout has, hidden ones among them."""
    port = str(free_port())
    size = f"{WIDTH}x{height}"
    command: list[str | Path] = [RERUN, "--headless", "--window-size", size, "--bind", "127.0.0.1"]
    log = home / "viewer.log"
    with (
        log.open("wb") as output,
        subprocess.Popen(
            [*command, "--port", port, recording],
            stdout=output,
            stderr=output,
            env=os.environ | {"HOME": str(home), "RUST_LOG": "error"},
        ) as process,
    ):
        try:
            client = until(lambda: opened(process, log, f"rerun+http://127.0.0.1:{port}/proxy", panes))
            yield client
        finally:
            process.kill()


def opened(process: subprocess.Popen[bytes], log: Path, url: str, panes: int) -> ViewerClient | None:
    """The viewer, once it has all panes."""
    if process.poll() is not None:
        words = log.read_text(errors="replace")
        if "render context" in words or "graphics adapter" in words:
            pytest.skip("no Vulkan driver: apt-get install libvulkan1 mesa-vulkan-drivers")
        pytest.fail(f"the viewer ended with {process.returncode}: {words}")
    try:
        client = ViewerClient.connect(url)
        return client if len(client.get_state().views) == panes else None
    except (RuntimeError, ConnectionError):
        return None


def until(ask: Callable[[], T | None]) -> T:
    deadline = time.monotonic() + HANG
    while time.monotonic() < deadline:
        if (answer := ask()) is not None:
            return answer
        time.sleep(0.05)
    pytest.fail("the viewer was never ready")


def settled_picture(client: ViewerClient, path: Path) -> Image.Image:
    """The picture, once two in a row are the same: panes and columns find their sizes over some frames."""

    def shoot() -> Image.Image:
        client.save_screenshot(str(path))
        with Image.open(path) as shot:
            return shot.convert("RGB")

    last = shoot()

    def same() -> Image.Image | None:
        nonlocal last
        before, last = last, shoot()
        return last if ImageChops.difference(before, last).getbbox() is None else None

    return until(same)


def look(recording: Path, home: Path, *, panes: int = 5, height: int = HEIGHT) -> tuple[Image.Image, ViewerState]:
    """The picture of a recording, of which no pane complains, and the viewer's state."""
    with viewer(recording, home, panes=panes, height=height) as client:
        picture, state = settled_picture(client, home / "picture.png"), client.get_state()
    assert [report for view in state.views for report in view.reports] == []
    return picture, state


def rgb(rgba: int, part: float = 1.0) -> Rgb:
    red, green, blue = (round((rgba >> shift & 0xFF) * part) for shift in (24, 16, 8))
    return red, green, blue


def pixels(picture: Image.Image, colour: Rgb, off: int = 3) -> list[tuple[int, int]]:
    """Where a colour is that is at most `off` from this one: x and y."""
    far = np.abs(np.asarray(picture, np.int16) - np.array(colour, np.int16)).max(axis=2)
    return [(int(x), int(y)) for y, x in np.argwhere(far <= off)]


def near(one: Rgb, two: Rgb) -> bool:
    return max(abs(left - right) for left, right in zip(one, two, strict=True)) <= 3


def bars_of(picture: Image.Image, colours: dict[str, int], start: float, length: float) -> list[str]:
    """What the bars say, from top to bottom, in the form of Table 2: one letter per second, "-" for no bar.

    The axis is `length` seconds wide, from `start`. Each second is read at two places, and a pixel row counts
    where they agree, so not where texts or edges are; four such rows make a bar."""
    names = {name: rgb(colour, DIMMED) for name, colour in colours.items()}
    scale = WIDTH * PANES / length

    def read(at: float, y: int) -> str:
        pixel = picture.getpixel((round((at - start) * scale), y))
        assert isinstance(pixel, tuple)
        red, green, blue = pixel
        return next((name for name, colour in names.items() if near((red, green, blue), colour)), "-")

    rows: list[str] = []
    for y in range(picture.height):
        pairs = [(read(second + 0.4, y), read(second + 0.8, y)) for second in range(SECONDS)]
        agreed = all(first == second for first, second in pairs)
        rows.append(" ".join(first for first, _ in pairs) if agreed else "")
    bars = [text for text, run in groupby(rows) if len(list(run)) >= 4 and set(text) - {"-", " "}]
    return [text for text, _ in groupby(bars)]


@pytest.mark.essential
def test_the_paper_s_example_in_the_viewer(path: Path, tmp_path: Path) -> None:
    record(path)
    picture, state = look(path, tmp_path)
    names = {"Who holds each device", "What each request is doing", "Load average (1 min) per host"}
    assert {view.name for view in state.views} == names | {"Events", "Who comes and goes"}
    (shown,) = state.recordings
    assert [(timeline.name, timeline.time_type) for timeline in shown.timelines] == [(TIME, "duration")]

    # The file opens on the whole run, and the picture says what Table 2 says.
    length = SECONDS * (1 + MARGIN)
    held = bars_of(picture.crop((0, 0, WIDTH, HEIGHT // 3)), ARCS, 0, length)
    assert held == [TABLE2[rc] for rc in (FGRAB1, FGRAB2, SCOUT33, SCOUT35)]

    doing = bars_of(picture.crop((0, HEIGHT // 3, WIDTH, HEIGHT)), WORDS, 0, length)
    assert doing == [
        "r r r r r d d d d d d d d d d d d d",
        "w w w w w r r r r r d d d d d d d d",
        "- w w w w w w w r r r p p p r r r r",
        "- - w w w r r r d d d d d d d d d d",
        "- - - - - - - - - - - r r r d d d d",
    ]

    counts = picture.getcolors(WIDTH * HEIGHT)
    assert counts is not None
    pixels = {colour: count for count, colour in counts}
    for colour in LINES[: len(HOSTS)]:
        assert pixels.get(rgb(colour), 0) > 500


@pytest.mark.slow
def test_what_several_want_stands_above_and_what_is_not_there_below(tmp_path: Path) -> None:
    with Timeline("lab", path=tmp_path / "run.rrd") as timeline:
        # By their names they would stand the other way round.
        timeline.holders(0, "robot/a", [], "the node of ws1 is gone")
        timeline.holders(0, "robot/b", [HolderRow("survey")])
        timeline.holders(0, "robot/c", [HolderRow("drive", operator=True)])
        for number in range(ONE_PANE):
            timeline.holders(0, f"robot/free{number}", [])
        timeline.contended(1, ["robot/c"])
        timeline.arc(1, "film", "waiting", "for drive: robot/c")
        timeline.event(SECONDS, "the end")
    picture, _ = look(tmp_path / "run.rrd", tmp_path, panes=7)
    bars = [round(height_of(picture, colour)) for colour in (OPERATOR, PALETTE[0], ABSENT)]
    assert bars == sorted(bars)


@pytest.mark.slow
def test_what_is_booked_is_outlined_ahead_of_now(tmp_path: Path) -> None:
    now, hour = 1_800_000_000, 3_600

    def booked(name: str, rc: str, start: int, hours: int, maintenance: bool = False, **date: Any) -> BookingView:
        dates = [BookedDate(now + start * hour, now + (start + hours) * hour, "open", **date)]
        runtime, patience = Decimal(hours * hour), Decimal(60)
        return BookingView(
            name, name, {rc: {}}, 1, dates[0].start, runtime, patience, maintenance=maintenance, dates=dates
        )

    with Timeline("lab", path=tmp_path / "run.rrd") as timeline:
        timeline.holders(0, "robot/a", [])
        bookings = [
            booked("survey", "robot/a", 2, 6),
            booked("mend", "robot/b", 2, 6, maintenance=True),
            booked("film", "robot/c", 14, 6, danger="robot/c is gone"),
        ]
        timeline.bookings.take(0, BookingsTold(now, bookings))
        timeline.event(SECONDS, "the end")
    picture, state = look(tmp_path / "run.rrd", tmp_path, panes=7)
    assert {one.name for one in AHEAD} <= {view.name for view in state.views}

    def spread(colour: int) -> tuple[int, int, int, int, int]:
        """Edges of what has this colour, left of the events, and how many pixels it has."""
        pixels = np.asarray(picture)[:, : round(WIDTH * PANES)].astype(int)
        down, across = np.nonzero((abs(pixels - rgb(colour)) <= 3).all(axis=2))
        return int(across.min()), int(across.max()), int(down.min()), int(down.max()), len(down)

    survey, mend, film = (spread(colour) for colour in (PALETTE[0], MAINTENANCE, ALERT))
    # The first two are as long and begin at one time; the third is as long, and twelve hours later.
    assert survey[:2] == pytest.approx(mend[:2], abs=2)
    assert film[1] - film[0] == pytest.approx(survey[1] - survey[0], abs=2)
    assert film[0] - survey[0] == pytest.approx(2 * (survey[1] - survey[0]), abs=6)
    assert survey[3] < mend[2] < mend[3] < film[2]
    # An outline, nothing more: within it the rest is dark, but for the text.
    around = 2 * (survey[1] - survey[0] + survey[3] - survey[2])
    assert survey[4] < 3 * around
    x, y = survey[0] + (survey[1] - survey[0]) // 8, (survey[2] + survey[3]) // 2
    assert max(picture.crop((x, y, x + 1, y + 1)).tobytes()) < 40


def height_of(picture: Image.Image, colour: int) -> float:
    """The middle of the bar of this colour, in pixels from the top."""
    wanted, rows = rgb(colour, DIMMED), []
    for y in range(picture.height):
        line = [picture.getpixel((x, y)) for x in range(0, round(WIDTH * PANES), 10)]
        if sum(isinstance(pixel, tuple) and near((pixel[0], pixel[1], pixel[2]), wanted) for pixel in line) > 50:
            rows.append(y)
    return sum(rows) / len(rows)


@pytest.mark.slow
def test_a_recorder_that_was_killed_leaves_a_recording_that_opens(path: Path, tmp_path: Path) -> None:
    code = (
        "import pathlib, sys, threading; from tests.services.recorder.paper_run import *;"
        "timeline = Timeline('lab', path=pathlib.Path(sys.argv[1]));"
        "play_table1(timeline); threading.Event().wait()"
    )
    with subprocess.Popen([sys.executable, "-c", code, path], cwd=Path(__file__).parents[3]) as recorder:
        try:
            until(lambda: written(path))
        finally:
            recorder.kill()
    picture, _ = look(path, tmp_path)
    # It has the live layout: the last minute, and two seconds to come.
    held = bars_of(picture.crop((0, 0, WIDTH, HEIGHT // 3)), ARCS, SECONDS - LIVE_WINDOW, LIVE_WINDOW + 2)
    assert held == [TABLE2[rc] for rc in (FGRAB1, FGRAB2, SCOUT33, SCOUT35)]


def written(path: Path) -> bool | None:
    """True once all of Table 2 is in the file that is still open."""
    with suppress(ValueError, RuntimeError, OSError, KeyError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shown = lanes(path, "/devices/**")
        done = lanes(path, "/requests/**")
        if len(done) == 5 and {rc: second_by_second(shown[f"/devices/{rc}"]) for rc in RCS} == TABLE2:
            return True
    return None
