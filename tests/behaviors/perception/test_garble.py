"""Spoiled pictures are told from good ones, the darkest included."""

from __future__ import annotations

import math

import cv2
import msgspec
import numpy as np
import pytest

from studies.robots.watch import hide_at_random
from tests.behaviors.perception.rooms import room, sofa
from zscout.behaviors.perception.garble import garbled
from zscout.behaviors.perception.lens import MAX_PIXELS, Picture, grey_picture
from zscout.behaviors.sensor_net.scout import NO_PICTURE_TIMEOUT, Scout
from zscout.simulation.building.air import Air, tear
from zscout.simulation.building.bodies import Pose
from zscout.simulation.building.plan import Robot
from zscout.simulation.building.plan_file import load_plan, shipped_plans
from zscout.simulation.building.world import World

CHANNEL = 1


@pytest.fixture(scope="module")
def world() -> World:
    plan = room(sofa(4.0))
    both = (*plan.robots, Robot(name="other", id=2, x=1.0, y=1.0))
    world = World(msgspec.structs.replace(plan, robots=both), seed=3)
    world.bodies["scout"].transmit(CHANNEL, 0.0)
    while world.time < 2.5:
        world.step(0.1)
    return world


@pytest.fixture(scope="module")
def good(world: World) -> list[Picture]:
    """Through the air, from the open and from beneath the sofa, all ways around."""
    air, pictures = Air(seed=1), []
    for turn in range(24):
        for x in (1.5, 3.2, 4.4):
            world.bodies["scout"].place(*Pose(x, 2.0, turn * math.pi / 12))
            world.step(0.1)
            pictures.append(air.receive(world, CHANNEL))
    return pictures


def test_good_pictures_are_believed(good: list[Picture]) -> None:
    assert [garbled(picture) for picture in good].count(None) == len(good)


def test_snow(world: World) -> None:
    air = Air(seed=2)
    assert {garbled(air.receive(world, 7)) for _ in range(20)} == {"snow"}


def test_two_transmitters_on_one_channel(world: World) -> None:
    air = Air(seed=4)
    world.bodies["other"].transmit(CHANNEL, 0.0)
    try:
        found = []
        for turn in range(30):
            world.bodies["scout"].place(*Pose(1.5 + turn / 10, 2.0, turn / 4))
            found.append(garbled(air.receive(world, CHANNEL)))
    finally:
        world.bodies["other"].transmit(None, world.time)
    assert found.count(None) <= 1


@pytest.mark.parametrize("noise", [0.5, 1.0, 2.0])
def test_lines_that_are_all_torn_and_few_that_are(noise: float) -> None:
    plan = load_plan(shipped_plans()["office"])
    plan = msgspec.structs.replace(plan, noise=msgspec.structs.replace(plan.noise, sensor=noise, analog=noise))
    found: dict[int, list[str | None]] = {0: [], 1: [], 2: [], 4: [], 120: []}
    for seed in range(20):
        world, air, rng = World(plan, seed=seed), Air(seed=seed), np.random.default_rng(seed)
        robot = hide_at_random(world, rng)
        world.bodies[robot].transmit(CHANNEL, -60.0)
        for _ in range(3):
            world.step(0.1)
            picture = air.receive(world, CHANNEL)
            for bands, words in found.items():
                spoiled = picture.copy()
                tear(spoiled, rng, bands=bands)
                words.append(garbled(spoiled))
    all_torn = found.pop(120)
    assert all(words == [None] * 60 for words in found.values())
    assert all_torn.count("torn") >= 57


def test_a_receiver_without_sync_teaches_nothing_and_is_given_up(world: World) -> None:
    """As it is one that shows snow."""
    world.bodies["scout"].place(*Pose(3.2, 2.0, math.pi))
    air, rng, scout = Air(seed=6), np.random.default_rng(6), Scout()
    scout.held(0.0)
    for number in range(1, 60):
        world.step(0.1)
        picture = air.receive(world, CHANNEL)
        tear(picture, rng, bands=120)
        step = scout.see(number / 4, picture, "video/ch1")
        if step.blind:
            break
        assert (step.left, step.right) == (0, 0)
    assert step.blind
    assert number / 4 == pytest.approx(NO_PICTURE_TIMEOUT, abs=0.5)
    assert scout.blindness.choose(20.0, ["video/ch1", "video/ch2"]) == "video/ch2"


@pytest.mark.parametrize("grey", [0, 16, 128, 255])
def test_blank(grey: int) -> None:
    assert garbled(np.full((120, 160), grey, np.uint8)) == "blank"


def test_half_a_picture(good: list[Picture]) -> None:
    for picture in good:
        half = picture.copy()
        half[70:] = 128
        assert garbled(half) is not None


# JPEG pictures from outside: what is legal is read, what is too large is not decoded


PICTURE = np.arange(120 * 160, dtype=np.uint8).reshape(120, 160)
JPEG = cv2.imencode(".jpg", PICTURE)[1].tobytes()


@pytest.mark.parametrize("count", [1, 2, 7])
def test_fill_bytes_before_a_marker_are_legal(count: int) -> None:
    """ITU-T T.81, B.1.1.2: any marker may be preceded by fill bytes 0xFF."""
    frame = JPEG.index(b"\xff\xc0")
    filled = JPEG[:2] + b"\xff" * count + JPEG[2:frame] + b"\xff" * count + JPEG[frame:]
    expected, picture = grey_picture(JPEG), grey_picture(filled)
    assert expected is not None
    assert picture is not None
    assert np.array_equal(picture, expected)


def test_what_is_no_picture_or_claims_too_many_pixels_is_none() -> None:
    size = JPEG.index(b"\xff\xc0") + 5
    huge = JPEG[:size] + (MAX_PIXELS // 160).to_bytes(2, "big") + (161).to_bytes(2, "big") + JPEG[size + 4 :]
    for data in (b"", b"\xff\xd8", JPEG[:40], JPEG[2:], huge):
        assert grey_picture(data) is None
