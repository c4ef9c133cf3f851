"""The building in motion: the same again by seed, and nobody in anything's place."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from tests.simulation.building.rooms import QUIET, SOFA, room, shipped
from tests.thorough import times
from zscout.drivers.packets import DrivePacket
from zscout.simulation.building.bodies import RADIUS, TOP_SPEED, Pose
from zscout.simulation.building.collisions import SLACK
from zscout.simulation.building.drawn import drawn_plan
from zscout.simulation.building.people import FOOT
from zscout.simulation.building.plan import ROBOT_HEIGHT, Furniture, Person, Plan, Wall
from zscout.simulation.building.world import MAX_STEP, World


def wander(world: World, rng: np.random.Generator) -> None:
    """Now and then a robot is told something else, mostly ahead."""
    for body in world.bodies.values():
        if rng.random() < 0.15:
            left, right = rng.uniform(-0.4, 1.0, 2)
            body.command(float(left), float(right), 2.0, world.time)


def scatter(world: World, rng: np.random.Generator) -> None:
    for body in world.bodies.values():
        body.place(*world.random_start(rng))


# The same again


def run(plan: Plan, seed: int, *, look: tuple[str, ...] = ("scout33",)) -> tuple[list[Pose], list[bytes]]:
    world, rng, pictures = World(plan, seed=seed), np.random.default_rng(9), []
    for step in range(40):
        wander(world, rng)
        world.step(0.1)
        if step % 6 == 0:
            taken = [world.picture(name) for name in look]
            pictures.append(taken[0].tobytes())
    return [body.pose for body in world.bodies.values()], pictures


def test_the_same_seed_gives_the_same_world_bit_for_bit() -> None:
    plan = shipped("living_room")
    first = run(plan, 5)
    assert run(plan, 5) == first
    other = run(plan, 6)
    assert other[0] != first[0]
    assert other[1][0] != first[1][0]


def test_looking_at_one_camera_changes_nothing_for_the_others() -> None:
    plan = shipped("living_room")
    assert run(plan, 5, look=("scout33", "scout37", "scout39")) == run(plan, 5)


def test_starts_are_taken_and_unknown_robots_are_not() -> None:
    world = World(room(robots=2), starts={"r2": Pose(3.0, 2.0, 1.0)})
    assert [body.pose for body in world.bodies.values()] == [(1.0, 1.0, 0.0), (3.0, 2.0, 1.0)]
    with pytest.raises(KeyError, match="r9"):
        World(room(), starts={"r9": Pose(1, 1, 0)})


@pytest.mark.parametrize("dt", [0.0, -0.1, MAX_STEP * 1.01, math.nan])
def test_a_step_that_is_too_long_is_refused(dt: float) -> None:
    world = World(room())
    with pytest.raises(ValueError, match="step"):
        world.step(dt)
    assert world.time == 0.0


def test_steps_of_any_length_lead_to_the_same_place() -> None:
    ends = []
    for dt in (0.02, 0.04, 0.1):
        world = World(room())
        world.bodies["r1"].receive(DrivePacket(1, 0, 1.0, 0.8, 5.0), 0.0)
        for _ in range(round(2.0 / dt)):
            world.step(dt)
        assert world.time == pytest.approx(2.0)
        ends.append(world.bodies["r1"].pose)
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)
    assert ends[0] == pytest.approx(ends[2], abs=1e-3)


# Collisions


@pytest.mark.parametrize("name", ["living_room", "office", "drawn"])
def test_a_robot_is_never_within_anything(name: str) -> None:
    plan, bumped = drawn_plan(3) if name == "drawn" else shipped(name), 0
    for seed in range(times(1)):
        world, rng = World(replace(plan, people=()), seed=seed), np.random.default_rng(seed)
        scatter(world, rng)
        for _ in range(300):
            wander(world, rng)
            world.step(0.1)
            bodies = list(world.bodies.values())
            for number, body in enumerate(bodies):
                assert world.obstacles.gap(body.x, body.y) >= RADIUS - SLACK
                bumped += body.bumped
                for other in bodies[:number]:
                    assert math.dist(body.pose[:2], other.pose[:2]) >= 2 * RADIUS - 2 * SLACK
    assert bumped > 30


@pytest.mark.parametrize(
    "obstacle",
    [
        Wall(start=(2.0, 0.0), end=(2.0, 3.0), thickness=0.02),
        Furniture(name="post", kind="solid", x=2.0, y=1.5, width=0.03, depth=3.0, height=0.5),
        replace(SOFA, x=2.4, y=1.5, depth=3.0, width=0.8, clearance=ROBOT_HEIGHT - 0.01),
    ],
)
def test_nothing_is_too_thin_to_stop_a_robot(obstacle: Wall | Furniture) -> None:
    plan = room(walls=(obstacle,)) if isinstance(obstacle, Wall) else room(obstacle)
    world = World(plan)
    body = world.bodies["r1"]
    # Through its middle, aslant at its middle, and along it.
    for heading, ahead in ((0.0, True), (0.7, True), (-0.7, True), (0.0, False)):
        body.place(1.0, 1.5, heading + (0 if ahead else math.pi))
        body.command(*((1.0, 1.0) if ahead else (-1.0, -1.0)), 100.0, world.time)
        touched = 0
        for _ in range(60):
            world.step(0.1)
            touched += body.bumped
            assert body.x <= 2.0 - RADIUS + SLACK
        assert touched > 5


def test_a_robot_slides_along_a_wall_with_less_speed() -> None:
    world = World(room())
    body = world.bodies["r1"]
    body.place(1.0, RADIUS, -0.5)
    body.command(1.0, 1.0, 10.0, world.time)
    for _ in range(20):
        world.step(0.1)
    free = TOP_SPEED * 2.0
    assert body.bumped
    assert 0.2 * free < body.x - 1.0 < 0.8 * free
    assert body.y == pytest.approx(RADIUS, abs=SLACK)
    # And gets off again.
    body.place(body.x, body.y, math.pi / 2)
    body.command(1.0, 1.0, 1.0, world.time)
    world.step(0.1)
    world.step(0.1)
    assert not body.bumped


@pytest.mark.parametrize(("clearance", "under"), [(0.12, True), (ROBOT_HEIGHT - 0.01, False)])
def test_a_robot_drives_under_what_is_higher_than_itself(clearance: float, under: bool) -> None:
    world = World(room(replace(SOFA, clearance=clearance)))
    body = world.bodies["r1"]
    body.place(SOFA.x, 1.5, math.pi / 2)
    body.command(1.0, 1.0, 5.0, world.time)
    for _ in range(45):
        world.step(0.1)
    assert (body.y > SOFA.y) == under
    assert world.is_dark("r1") == under
    assert under or body.bumped


def test_robots_that_meet_stop_each_other() -> None:
    world = World(room(robots=2))
    left, right = world.bodies.values()
    left.place(1.0, 1.5, 0.0)
    right.place(2.0, 1.5, math.pi)
    for body in (left, right):
        body.command(1.0, 1.0, 10.0, world.time)
    for _ in range(60):
        world.step(0.1)
        assert math.dist(left.pose[:2], right.pose[:2]) >= 2 * RADIUS - 2 * SLACK
    assert left.bumped
    assert right.bumped
    # Neither pushes the other through the room.
    assert 1.0 < left.x < right.x < 2.0


def test_feet_push_a_robot_aside() -> None:
    walk = Person(name="ada", path=((0.3, 1.5), (3.7, 1.5)), first=0.1, jitter=0, speed=1.0, walks=1)
    world = World(room(people=(walk,)))
    body = world.bodies["r1"]
    body.place(2.0, 1.5 + 0.05, 0.0)
    for _ in range(60):
        world.step(0.1)
        for x, y, radius in world.walkers[0].feet():
            assert math.dist((x, y), (body.x, body.y)) >= RADIUS + radius - 2 * SLACK
    assert math.dist((2.0, 1.55), (body.x, body.y)) > 0.05
    assert world.obstacles.gap(body.x, body.y) >= RADIUS


def test_feet_push_no_robot_into_a_wall() -> None:
    walk = Person(name="ada", path=((0.3, 0.2), (3.7, 0.2)), first=0.1, jitter=0, speed=0.5, walks=1)
    world, met = World(room(people=(walk,))), 0
    body = world.bodies["r1"]
    body.place(2.0, RADIUS + 0.01, 0.0)
    for _ in range(90):
        world.step(0.1)
        met += body.bumped
        assert world.obstacles.gap(body.x, body.y) >= RADIUS - SLACK
    assert met > 3


def test_nobody_can_stand_where_somebody_walks() -> None:
    walk = Person(name="ada", path=((0.5, 1.5), (3.5, 1.5)), first=0.1, jitter=0, speed=0.5)
    world = World(room(people=(walk,)))
    assert world.clear(0.5, 1.5)
    for _ in range(10):
        world.step(0.1)
    (x, y, _), _ = world.walkers[0].feet()
    assert not world.clear(x + FOOT + RADIUS / 2, y)
    assert world.clear(x, y + FOOT + 4 * RADIUS)


def test_a_place_in_a_doorway_makes_nobody_black() -> None:
    door = Furniture(name="door", kind="solid", x=1.5, y=0.02, width=0.9, depth=0.04, height=2.05)
    walk = Person(name="ada", path=((1.5, -0.5), (1.5, 1.0)), first=0.1, jitter=0, speed=0.5)
    world = World(room(door, people=(walk,), noise=QUIET))
    seen = 0
    for _ in range(40):
        world.step(0.1)
        shapes = [shape for shape in world._moving(None) if shape.person]
        seen += len(shapes)
        assert all(shape.light >= world.median_light / 4 for shape in shapes)
    assert seen > 60
