"""What receivers show of the cameras on their channel."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from tests.simulation.building.rooms import SOFA, TABLE, room
from zscout.simulation.building.air import Air, strength_at
from zscout.simulation.building.bodies import WARM_UP
from zscout.simulation.building.camera import Picture
from zscout.simulation.building.plan import Noise, Plan, Receiver
from zscout.simulation.building.world import World

NOISY = Noise(sensor=0.0, analog=1.0, flicker=0.0, daylight=0.0)
PLAN = room(SOFA, TABLE, robots=3, noise=NOISY)


def on_air(*robots: str, plan: Plan = PLAN, warm: bool = True) -> World:
    """A world in which these transmit on channel 1."""
    world = World(plan, seed=2)
    world.bodies["r2"].place(3.2, 1.6, 2.5)
    for name in robots:
        world.bodies[name].transmit(1, -WARM_UP if warm else world.time)
    return world


def alike(one: Picture, other: Picture) -> float:
    """Correlation of two pictures: 1 the same, 0 nothing in common."""
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


TRUE = on_air().picture("r1")
OTHER = on_air().picture("r2")


def test_nobody_on_the_channel_is_snow() -> None:
    air = Air(seed=1)
    for world, channel in ((on_air(), 1), (on_air("r1"), 2)):
        snow = air.receive(world, channel)
        assert snow.shape == (120, 160)
        assert snow.dtype == np.uint8
        assert snow.std() > 40
        assert abs(alike(snow, TRUE)) < 0.05
        assert abs(alike(snow, air.receive(world, channel))) < 0.05


def test_one_transmitter_is_its_picture_with_some_noise() -> None:
    got = Air(seed=1).receive(on_air("r1"), 1)
    assert alike(got, TRUE) > 0.98
    assert 0.5 < np.median(np.abs(got.astype(int) - TRUE)) < 5


def test_air_without_noise_hands_on_the_very_picture() -> None:
    quiet = replace(PLAN, noise=replace(NOISY, analog=0.0))
    assert np.array_equal(Air(seed=1).receive(on_air("r1", plan=quiet), 1), TRUE)


def test_two_on_one_channel_spoil_both() -> None:
    for robots in (("r1", "r2"), ("r1", "r2", "r3")):
        air, world = Air(seed=1), on_air(*robots)
        got = [air.receive(world, 1) for _ in range(10)]
        for true in (TRUE, OTHER):
            assert np.mean([alike(one, true) for one in got]) < 0.75
            assert max(alike(one, true) for one in got) < 0.9
        # And never in the same way twice.
        assert max(alike(one, other) for one, other in pairwise(got)) < 0.9


def test_snow_fades_into_the_picture_while_a_camera_warms_up() -> None:
    air, world, likeness = Air(seed=1), on_air("r1", warm=False), []
    for _ in range(25):
        world.step(0.1)
        likeness.append(alike(air.receive(world, 1), TRUE))
    assert likeness[1] < 0.1
    assert 0.05 < likeness[12] < 0.95
    assert likeness[12] < likeness[17] < likeness[24]
    assert likeness[24] > 0.97


def test_a_camera_without_a_battery_is_off_the_air() -> None:
    world = on_air("r1", "r2")
    world.bodies["r1"].alive = False
    assert alike(Air(seed=1).receive(world, 1), OTHER) > 0.97
    world.bodies["r2"].alive = False
    assert abs(alike(Air(seed=1).receive(world, 1), OTHER)) < 0.05


def test_noise_grows_with_the_way_to_the_receiver() -> None:
    errors = []
    for reach in (1_000.0, 5.0, 1.0):
        far = replace(PLAN, receiver=Receiver(x=4.0, y=3.0, range=reach))
        air, world = Air(seed=1), on_air("r1", plan=far)
        got = [air.receive(world, 1).astype(float) - TRUE for _ in range(5)]
        errors.append(float(np.mean([np.std(one) for one in got])))
    assert errors[0] * 1.5 < errors[1]
    assert errors[1] * 1.5 < errors[2]


def test_half_of_the_signal_is_left_at_the_range() -> None:
    plan = replace(PLAN, receiver=Receiver(x=0.0, y=0.0, range=5.0))
    assert strength_at(plan, 0.0, 0.0) == 1.0
    assert strength_at(plan, 3.0, 4.0) == pytest.approx(0.5)


def test_lines_tear_now_and_then() -> None:
    worse = replace(PLAN, noise=replace(NOISY, analog=3.0))
    air, world, torn = Air(seed=3), on_air("r1", plan=worse), 0
    for _ in range(60):
        off = np.abs(air.receive(world, 1).astype(int) - TRUE).mean(1)
        torn += bool(off.max() > 2 * np.median(off))
    assert 1 <= torn < 30


def test_the_same_seed_gives_the_same_air() -> None:
    for robots in ((), ("r1",), ("r1", "r2")):
        first, again, other = (Air(seed=seed).receive(on_air(*robots), 1) for seed in (4, 4, 5))
        assert np.array_equal(first, again)
        assert not np.array_equal(first, other)
