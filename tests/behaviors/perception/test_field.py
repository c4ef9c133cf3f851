"""What people report of motion detection in the field: the walker is told soon, and nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.behaviors.perception.scenes import HEIGHT, WIDTH, Scene
from tests.behaviors.perception.test_motion import settled
from zscout.behaviors.perception.motion import Event, EventTracker, MotionDetector
from zscout.messages import MotionLimits

RATE = 10.0
COMES = 6.0
"""Seconds after which the walker of `events` comes."""

Picture = NDArray[np.uint8]
Camera = Callable[[float, float | None], Picture]
"""What it shows at a time, with the walker at a column or without him."""


def events(camera: Camera, *, rate: float = RATE, limits: MotionLimits | None = None) -> Iterator[Event]:
    """The camera's scene, in which somebody walks from COMES for five seconds, and one more."""
    limits = limits or MotionLimits()
    detector, tracker = MotionDetector(limits=limits), EventTracker(limits.min_duration)
    for number in range(round((COMES + 6) * rate)):
        time = number / rate
        walker = 40 * (time - COMES) - 20 if COMES <= time < COMES + 5 else None
        if ended := tracker.see(time, detector.see(time, camera(time, walker))):
            yield ended
    if last := tracker.close():
        yield last


def assert_walker_alone(camera: Camera, limits: MotionLimits | None = None) -> None:
    told = list(events(camera, limits=limits))
    assert len(told) == 1
    assert COMES <= told[0].start <= COMES + 1
    assert told[0].end >= COMES + 3.5


@pytest.mark.parametrize(
    ("depth", "rolls", "lines"),
    [(0.06, 0.05, 60), (0.12, 0.05, 60), (0.12, 0.37, 60), (0.12, 1.3, 30), (0.2, 0.1, 120), (0.25, 0.5, 60)],
)
def test_light_that_rolls_in_bands_hides_nobody(depth: float, rolls: float, lines: int) -> None:
    """As of mains under a rolling shutter: each line has its light."""
    scene, rows = Scene(20), np.arange(HEIGHT)[:, np.newaxis]

    def camera(time: float, walker: float | None) -> Picture:
        return scene.picture(walker, gain=1 + depth * np.sin(2 * np.pi * (rows / lines + time * rolls)))

    assert_walker_alone(camera)


@pytest.mark.parametrize(("size", "comes"), [(0.6, 4.0), (0.85, 4.0), (0.85, 1.0), (1.0, 2.0), (0.75, 0.5)])
def test_who_is_near_is_told_as_long_as_he_is_there(size: float, comes: float) -> None:
    """Somebody comes to a door's camera from 4 s, sways before it, and is away at 12 s."""
    scene, detector, tracker = Scene(21, noise=2.0), MotionDetector(), EventTracker()
    coat = cv2.resize(np.random.default_rng(3).uniform(10, 120, (15, 10)), (200, 200), interpolation=cv2.INTER_CUBIC)
    told = []
    for time in (number / RATE for number in range(round(20 * RATE))):
        picture = scene.picture(40 * (time - 14) - 20 if time >= 14 else None)
        if 4 <= time < 12:
            near = size * min(1.0, (time - 4) / comes, (12 - time) / comes)
            high, wide = max(1, int(HEIGHT * near)), max(1, int(WIDTH * near * 0.9))
            left = int(np.clip((WIDTH - wide) / 2 + 1.5 * np.sin(5 * time), 0, WIDTH - wide))
            picture[HEIGHT - high :, left : left + wide] = coat[:high, :wide]
        if ended := tracker.see(time, detector.see(time, picture)):
            told.append(ended)
    assert len(told) == 2
    assert told[0].start <= 5
    assert told[0].end >= 11
    assert 14 <= told[1].start <= 15


def test_light_that_is_switched_beside_somebody_near_is_learned_soon() -> None:
    scene, detector = Scene(22), MotionDetector()
    seen = []
    for time in (number / RATE for number in range(round(16 * RATE))):
        picture = scene.picture(gain=1.0 if time < 6 else np.linspace(0.4, 1.8, HEIGHT)[:, np.newaxis])
        if 4 <= time < 8:
            left = int(20 * (time - 4))
            picture[40:, left : left + 40] = 30
        seen.append((time, detector.see(time, picture).moving))
    assert all(moving for time, moving in seen if 4.5 <= time < 5.5)
    assert not any(moving for time, moving in seen if time >= 12)


@pytest.mark.parametrize(
    ("place", "size", "words"),
    [
        ((4, 12), 0.35, "20:{minutes:02}:{seconds:02}"),
        ((60, 116), 0.35, "20:{minutes:02}:{seconds:02}"),
        ((30, 60), 0.5, "{minutes:02}:{seconds:02}"),
        ((4, 12), 0.4, "{time:06.1f}"),
    ],
)
def test_a_clock_in_the_picture_is_no_motion(place: tuple[int, int], size: float, words: str) -> None:
    scene = Scene(23, noise=2.0)

    def camera(time: float, walker: float | None) -> Picture:
        picture, seconds = scene.picture(walker), int(time + 0.01)
        text = words.format(minutes=7 + (seconds + 56) // 60, seconds=(seconds + 56) % 60, time=time)
        for colour, thick in ((0, 3), (255, 1)):
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, (colour,), thick)
        return picture

    assert_walker_alone(camera)


def test_somebody_far_away_is_told() -> None:
    """As small as a clock's digits, and slow; but the place changes."""
    scene, detector = Scene(24, noise=1.0), settled(Scene(24, noise=1.0))
    told = []
    for number in range(60):
        picture = scene.picture()
        left = 50 + 0.3 * number
        for column in range(int(left), int(left) + 4):
            cover = min(1.0, column + 1 - left, left + 3 - column)
            picture[50:57, column] = (1 - cover) * picture[50:57, column] + cover * 20
        told.append(detector.see(4 + number / RATE, picture).moving)
    assert any(told[:5])
    assert sum(told) > 50


def road(scene: Scene, time: float, walker: float | None) -> Picture:
    """With a road, on the left, on which something is moving in every second second."""
    picture = scene.picture(walker)
    if time % 2 >= 1:
        top = int(20 + 60 * (time % 2 - 1))
        picture[top : top + 20, 2:14] = 20
    return picture


ROAD: list[float] = [0, 0, 0.1, 1.0]


@pytest.mark.parametrize("region", [ROAD, [0, 0, 0.1, 0, 0.1, 1, 0, 1]])
def test_motion_in_an_ignored_region_does_not_count(region: list[float]) -> None:
    scene, limits = Scene(25), MotionLimits([region])
    assert any(event.start < COMES - 1 for event in events(lambda *at: road(scene, *at)))
    assert_walker_alone(lambda *at: road(scene, *at), limits)


@pytest.mark.parametrize("size", [(160, 120), (320, 240)])
def test_an_ignored_region_has_no_outlines(size: tuple[int, int]) -> None:
    scene, detector = Scene(26), MotionDetector(outlines=True, limits=MotionLimits([[0.5, 0, 1, 1]]))
    for number in range(60):
        picture = cv2.resize(scene.picture(None if number < 50 else 80), size, interpolation=cv2.INTER_NEAREST)
        seen = detector.see(number / RATE, np.asarray(picture, np.uint8))
    assert seen.mask is not None
    assert np.any(seen.mask)
    assert not np.any(seen.mask[:, size[0] // 2 :])
    assert all(box.x + box.width <= size[0] // 2 for box in seen.boxes)


def test_light_and_noise_are_told_by_what_is_not_ignored() -> None:
    """Most of the picture is a street at night, with its own lights."""
    scene = Scene(27)

    def camera(time: float, walker: float | None) -> Picture:
        picture = scene.picture(walker, gain=1 + 0.2 * math.sin(time))
        picture[:50] = np.clip(picture[:50] * (1.5 + math.sin(9 * time)), 0, 255)
        return picture

    assert_walker_alone(camera, MotionLimits([[0, 0, 1, 0.42]]))


@pytest.mark.parametrize(("min_area", "told"), [(0.0, True), (0.01, True), (0.06, False)])
def test_what_is_smaller_than_asked_for_is_left_out(min_area: float, told: bool) -> None:
    """A walker has 3.8 % of the picture."""
    scene, limits = Scene(28), MotionLimits(min_area=min_area)
    assert bool([*events(lambda _, walker: scene.picture(walker), limits=limits)]) == told


@pytest.mark.parametrize(("min_duration", "told"), [(0.0, True), (3.0, True), (6.0, False)])
def test_what_is_shorter_than_asked_for_is_left_out(min_duration: float, told: bool) -> None:
    scene, limits = Scene(29), MotionLimits(min_duration=min_duration)
    assert bool([*events(lambda _, walker: scene.picture(walker), limits=limits)]) == told


def falling(
    seed: int, drops: int, draw: Callable[[Picture, int, int, np.random.Generator], None], lit: float
) -> Camera:
    """Somewhere else in each picture; `lit` is the part of the light behind a drop that it replaces."""
    scene, rng = Scene(seed), np.random.default_rng(seed)

    def camera(time: float, walker: float | None) -> Picture:
        layer: Picture = np.zeros((4 * HEIGHT, 4 * WIDTH), np.uint8)
        for _ in range(drops):
            draw(layer, int(rng.integers(4 * WIDTH)), int(rng.integers(4 * HEIGHT)), rng)
        cover = lit / 255 * cv2.resize(layer, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.float32)
        return ((1 - cover) * scene.picture(walker) + cover * 225).astype(np.uint8)

    return camera


@pytest.mark.parametrize(
    ("drops", "length", "slant", "thick"),
    [
        (4, (15, 40), 0.17, 1),
        (15, (15, 40), 0.17, 1),
        (60, (15, 40), -0.5, 1),
        (120, (15, 40), 0.17, 1),
        (20, (40, 90), 1.0, 1),
        (20, (40, 90), 0.1, 2),
        (25, (6, 12), 3.0, 2),
    ],
)
def test_rain_is_no_motion_and_the_walker_in_it_is(
    drops: int, length: tuple[int, int], slant: float, thick: int
) -> None:
    def streak(layer: Picture, x: int, y: int, rng: np.random.Generator) -> None:
        high = int(rng.integers(*length))
        cv2.line(layer, (x, y), (int(x + slant * high), y + high), (255,), thick)

    assert_walker_alone(falling(30, drops, streak, 0.5))


@pytest.mark.parametrize(("flakes", "most"), [(5, 8), (12, 12), (40, 5), (150, 5), (30, 9)])
def test_snow_is_no_motion_and_the_walker_in_it_is(flakes: int, most: int) -> None:
    def flake(layer: Picture, x: int, y: int, rng: np.random.Generator) -> None:
        cv2.circle(layer, (x, y), int(rng.integers(1, most)), (255,), -1)

    assert_walker_alone(falling(31, flakes, flake, 0.9))


def test_rain_that_begins_and_ends_is_no_motion_either() -> None:
    def streak(layer: Picture, x: int, y: int, rng: np.random.Generator) -> None:
        cv2.line(layer, (x, y), (x + 5, y + int(rng.integers(15, 40))), (255,), 1)

    wet, dry = falling(32, 15, streak, 0.5), falling(32, 0, streak, 0.5)
    assert_walker_alone(lambda time, walker: (wet if 3 <= time < 4.5 or time > 8 else dry)(time, walker))


def test_people_who_run_about_are_no_rain() -> None:
    """Five of them, twice a second: nobody covers any of where he was."""
    scene = Scene(33)
    detector, rng = settled(scene), np.random.default_rng(1)
    moving = []
    for number in range(10):
        picture = scene.picture()
        for place in range(5):
            left, top = 32 * place + int(rng.integers(0, 24)), int(rng.integers(40, 90))
            picture[top : top + 18, left : left + 7] = 20
        moving.append(detector.see(4 + number / 2, picture).moving)
    assert sum(moving) >= 8


def test_a_road_that_is_seldom_empty_is_no_noise() -> None:
    """Cars of any shade cover a lane for half of the time."""
    rng, scene, detector = np.random.default_rng(36), Scene(36, noise=2.0), MotionDetector(outlines=True)
    comes, found, there = 0.0, 0, 0
    cars = [(comes := comes + 1.2 * rng.uniform(0.2, 2), rng.uniform(20, 230)) for _ in range(30)]
    for time in (number / RATE for number in range(350)):
        picture, truth = scene.picture(), np.zeros((HEIGHT, WIDTH), np.bool_)
        for since, shade in cars:
            if since <= time < since + 0.6:
                top = int(HEIGHT * (time - since) / 0.6) - 20
                car = np.s_[max(0, top) : top + 20, 70:95]
                truth[car], picture[car] = True, shade
        mask = detector.see(time, picture).mask
        if time > 15 and mask is not None:
            found, there = found + int(np.count_nonzero(truth & (mask > 0))), there + int(np.count_nonzero(truth))
    assert found > 0.75 * there
