"""The framegrabber's parts that need no mesh: its pace, grey pictures, what it tells, and its tuning."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.drivers.mjpeg import MjpegServer, jpeg, numbered
from tests.drivers.rcs import holder
from tests.live.bench import until
from zscout.drivers.driver import RcHandle
from zscout.drivers.framegrabber import RATE_SPAN, FramegrabberDriver, FrameMeter, encode, is_grey, pace_of
from zscout.mesh import Supervisor
from zscout.messages import FrameHead, MotionLimits
from zscout.types import SECOND, Ns


def ns(at: float) -> Ns:
    return round(at * SECOND)


@pytest.mark.parametrize("source", [1, 5, 9, 10, 10.2, 11, 14, 15, 20, 25, 29.97, 30, 60, 240])
def test_a_pace_admits_no_more_than_its_rate_and_little_less(source: float) -> None:
    pace = pace_of(10)
    admitted = [at for at in (n / source for n in range(int(60 * source))) if pace.admits(1, ns(at))]
    expected = 60 * min(10.0, source)
    assert 0.93 * expected <= len(admitted) <= expected + 1
    # Never more than two too close to each other, never a hole of more than one picture.
    gaps = np.diff(admitted)
    assert gaps.min() >= min(0.05, 1 / source) - 1e-9
    assert gaps.max() <= 1 / min(10.0, source) + 1 / source + 1e-9
    span = 10
    for start in range(len(admitted) - span):
        assert admitted[start + span] - admitted[start] >= span / 10 - 0.05 - 1e-9


def test_uneven_pictures_at_the_very_rate_are_all_admitted() -> None:
    pace, rng = pace_of(10), np.random.default_rng(1)
    jitter = rng.uniform(-0.02, 0.02, 600)
    assert all(pace.admits(1, ns(n / 10 + late)) for n, late in enumerate(jitter))


def test_after_a_pause_there_is_no_burst() -> None:
    pace = pace_of(10)
    assert pace.admits(1, 0)
    admitted = [n for n in range(101) if pace.admits(1, ns(60 + n / 100))]
    # 10 in a second, the one at its beginning, and the half interval that one may be early.
    assert admitted[0] == 0
    assert 10 <= len(admitted) <= 11


def colour() -> NDArray[np.uint8]:
    return np.asarray(cv2.merge([numbered(7)] * 3), np.uint8)


def test_a_picture_without_colour_becomes_a_grey_jpeg() -> None:
    plain = colour()
    assert is_grey(plain)
    grey = cv2.imdecode(np.frombuffer(encode(plain, 80), np.uint8), cv2.IMREAD_UNCHANGED)
    assert grey is not None
    assert grey.shape == (120, 160)
    assert np.abs(grey.astype(int) - plain[:, :, 0]).mean() < 3
    assert encode(plain, 80) == encode(plain[:, :, 1].copy(), 80)
    _, coloured = cv2.imencode(".jpg", plain, [cv2.IMWRITE_JPEG_QUALITY, 80])
    assert len(encode(plain, 80)) < len(coloured)


@pytest.mark.parametrize("place", [(0, 0), (5, 9), (119, 159)])
@pytest.mark.parametrize("plane", [0, 1, 2])
def test_one_coloured_pixel_makes_a_picture_coloured(place: tuple[int, int], plane: int) -> None:
    picture = colour()
    picture[(*place, plane)] += 4
    assert not is_grey(picture)
    decoded = cv2.imdecode(np.frombuffer(encode(picture, 80), np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    assert decoded.shape == (120, 160, 3)


def test_rounding_makes_no_colour() -> None:
    picture = colour()
    picture[::2, ::3, 0] += 3
    assert is_grey(picture)
    assert is_grey(np.zeros((1, 1, 3), np.uint8))


def test_what_a_meter_tells() -> None:
    meter = FrameMeter()
    assert (meter.rate(0), meter.latency()) == (0, 0)
    for number in range(41):
        head = FrameHead(number=number, time=100 + number / 10, width=160, height=120)
        meter.count(head, 2_000 + number, head.time + (0.5 if number == 40 else 0.02))
    assert meter.rate(104.52) == pytest.approx(10, rel=0.2)
    assert meter.latency() == pytest.approx(0.02)
    assert (meter.published, meter.width, meter.height, meter.size) == (41, 160, 120, 2_040)
    assert meter.rate(104.52 + RATE_SPAN) == 0


@pytest.mark.parametrize(
    ("sources", "gang", "tuned", "why"),
    [
        ({"": "0"}, ("robot/a",), "", ""),
        ({"": "0"}, ("robot/a", "video/ch1"), "", ""),
        ({"video/ch1": "1", "video/ch2": "2"}, ("framegrabber/f", "video/ch2"), "video/ch2", ""),
        ({"video/ch1": "1", "video/ch2": "2"}, ("video/ch2", "video/ch1"), "video/ch1", ""),
        ({"video/ch1": "1"}, ("robot/a",), "video/ch1", ""),
        ({"video/ch1": "1"}, ("video/ch3",), None, "does not receive video/ch3; it receives video/ch1"),
        ({"video/ch1": "1", "video/ch2": "2"}, ("robot/a",), None, "tune it to one of video/ch1, video/ch2"),
    ],
)
def test_the_gang_settles_the_source(
    sources: dict[str, str], gang: tuple[str, ...], tuned: str | None, why: str
) -> None:
    source, reason = FramegrabberDriver(sources, rate=10, quality=80)._of_gang(list(gang))
    assert source == tuned
    assert why in reason
    assert bool(reason) == (tuned is None)


def test_a_framegrabber_that_can_not_be() -> None:
    rates = [(rate, 80, {"": "0"}) for rate in (0.0, float("nan"), float("inf"))]
    for rate, quality, sources in (*rates, (10.0, 0, {"": "0"}), (10.0, 101, {"": "0"}), (10.0, 80, dict[str, str]())):
        with pytest.raises(ValueError, match="a framegrabber needs a source"):
            FramegrabberDriver(sources, rate=rate, quality=quality)


class Handle:
    """A device that keeps what its driver reports; somebody looks at its frames."""

    name = "framegrabber/f"
    watched = True

    def __init__(self) -> None:
        self.failed: list[str] = []
        self.well = 0
        self.heads: list[FrameHead] = []
        self.supervisor = Supervisor(self.name, lambda _: None)

    def frame_publisher(self) -> Handle:
        return self

    def follow(self, _changed: object) -> None:
        pass

    def close(self) -> None:
        pass

    def put(self, head: FrameHead, _jpeg: bytes) -> None:
        self.heads.append(head)

    def used(self, _grant: object) -> None:
        pass

    def unwell(self, why: str) -> None:
        self.failed.append(why)

    def recover(self) -> None:
        self.well += 1


@asynccontextmanager
async def grabbing(source: str, **how: Any) -> AsyncIterator[tuple[FramegrabberDriver, Handle]]:
    driver, rc = FramegrabberDriver({"": source}, rate=30, quality=80, **how), Handle()
    await driver.open(cast("RcHandle", rc))
    yield driver, rc
    await driver.safe()
    await driver.close()
    await rc.supervisor.close()


@pytest.mark.real_time
async def test_a_lost_framegrabber_reports_the_newest_reason_once() -> None:
    with MjpegServer() as server:
        server.mode = "404"
        async with grabbing(server.url) as (_, rc):
            await until(lambda: any("(404)" in why for why in rc.failed))
            server.mode, server.clients = "run", 0
            await until(lambda: "(503)" in rc.failed[-1])
            server.clients = 8
            await until(lambda: rc.well > 0)
            assert all(why != newer for why, newer in pairwise(rc.failed)), rc.failed


@pytest.mark.real_time
async def test_frames_tell_what_of_their_motion_is_reported() -> None:
    limits = MotionLimits([[0, 0, 0.4, 0.1]], min_duration=2)
    with MjpegServer() as server:
        async with grabbing(server.url, motion=limits) as (driver, rc):
            await until(lambda: not driver._unwell)
            await driver.begin(holder(1, "look"))
            await until(lambda: bool(rc.heads))
            assert rc.heads[0].motion == limits


@pytest.mark.real_time
async def test_a_frozen_source_ends_no_hold_and_is_in_frames_and_figures() -> None:
    with MjpegServer(picture=lambda _: jpeg(numbered(5))) as server:
        async with grabbing(server.url, still_after=1.0, picture_within=30.0) as (driver, rc):
            await until(lambda: not driver._unwell)
            await driver.begin(holder(1, "look"))
            await until(lambda: bool(rc.heads) and rc.heads[-1].frozen >= 1)
            assert driver.figures()["frozen_seconds"] >= 1
            assert driver._snapshot()["health"] == "frozen: the same picture for more than 1 s"
            assert len(rc.failed) == rc.well  # none but before its first picture


def test_a_slow_source_has_longer_until_it_is_lost() -> None:
    assert [FramegrabberDriver({"": "0"}, rate=10, quality=80, picture_within=s)._slow for s in (1.5, 20.0)] == [0, 40]
