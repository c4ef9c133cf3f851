"""Light on floors and furniture, and what of it counts as dark."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from tests.simulation.building.rooms import CARTON, SOFA, TABLE, room, shipped
from zscout.simulation.building.bodies import RADIUS
from zscout.simulation.building.light import hidden, light_of
from zscout.simulation.building.plan import Furniture, Light, Noise, Rug, Wall
from zscout.simulation.building.solids import Cuboid, as_arrays
from zscout.simulation.building.world import World

FURNISHED = room(SOFA, TABLE, CARTON)
WINDOW = Light(name="window", x=0.0, y=1.5, z=1.5, width=1.0, depth=1.0, kind="window")


def test_the_deeper_under_furniture_the_darker() -> None:
    world = World(FURNISHED)
    open_floor, table = world.floor_light(2.3, 1.2), world.floor_light(TABLE.x, TABLE.y)
    edge, sofa = world.floor_light(SOFA.x, 2.16), world.floor_light(SOFA.x, SOFA.y)
    assert open_floor > 2 * table > 0
    assert table > 2 * sofa > 0
    assert 0.002 < sofa / open_floor < 0.04
    assert edge > 2 * sofa
    assert world.median_light / 2 < open_floor < world.median_light * 2
    # Truly dark is the sofa's floor only: a table, and a carton's black face, are none.
    assert sofa < world.median_light / 4 < table
    assert world.floor_light(CARTON.x - 0.4, CARTON.y) > world.median_light / 4


@pytest.mark.parametrize("name", ["living_room", "office"])
def test_shipped_rooms_are_as_light_and_as_dark_as_rooms_are(name: str) -> None:
    world = World(shipped(name))
    assert 0.1 < world.median_light < 1.0
    darkest = world.truth.light[world.truth.dark]
    assert len(darkest) * world.truth.cell**2 > 1.0
    assert darkest.min() < world.median_light / 20


def test_light_adds_up() -> None:
    one, other = Light(name="a", x=1.0, y=1.0), Light(name="b", x=3.0, y=2.0, z=1.6, power=0.4)
    alone = [light_of(room(SOFA, TABLE, lights=lights)) for lights in ((one,), (other,))]
    both = light_of(room(SOFA, TABLE, lights=(one, other)))
    assert np.allclose(both.floor, alone[0].floor + alone[1].floor, rtol=1e-3, atol=1e-6)
    assert np.allclose(both.atlas, alone[0].atlas + alone[1].atlas, rtol=1e-3, atol=1e-6)
    strong = light_of(room(SOFA, TABLE, lights=(replace(one, power=3.0),)))
    assert np.allclose(strong.floor, 3 * alone[0].floor, rtol=1e-3, atol=1e-6)


def test_a_shadow_ends_where_the_ray_over_the_edge_meets_the_floor() -> None:
    lamp = Light(name="lamp", x=1.0, y=1.5, z=2.4, width=0.02, depth=0.02)
    screen = Furniture(name="screen", kind="solid", x=2.0, y=1.5, width=0.1, depth=2.0, height=1.2)
    lit = light_of(room(screen, lights=(lamp,)))
    row = lit.floor[0, round(1.5 / lit.cell)]
    behind = round(2.2 / lit.cell)
    steps = row[behind + 8 :] / row[behind:-8]
    end = (behind + 4 + int(steps.argmax()) + 0.5) * lit.cell
    assert steps.max() > 1.3
    assert end == pytest.approx(1.0 + (2.05 - 1.0) * 2.4 / (2.4 - 1.2), abs=0.1)


def test_a_room_that_is_its_own_mirror_image_is_lit_so() -> None:
    floor = light_of(room()).floor.sum(0)
    assert np.allclose(floor, floor[::-1], rtol=0.02)
    assert np.allclose(floor, floor[:, ::-1], rtol=0.02)


def test_windows_are_kept_apart_from_lamps_since_only_they_follow_the_day() -> None:
    lamp, window = light_of(room()), light_of(room(lights=(WINDOW,)))
    assert lamp.floor[0].min() > 0
    assert not lamp.floor[1].any()
    assert not window.floor[0].any()
    # Near the window, but not right below it, is the lightest floor.
    row, column = np.unravel_index(window.floor[1].argmax(), window.floor[1].shape)
    assert (column + 0.5) * window.cell < 1.5
    assert abs((row + 0.5) * window.cell - WINDOW.y) < 0.3


def test_who_drives_in_a_room_and_how_well_it_is_seen_changes_no_light() -> None:
    other = room(SOFA, TABLE, CARTON, robots=3, noise=Noise(sensor=3), rugs=(Rug(1.0, 1.0, 0.5, 0.5),))
    assert light_of(replace(other, name="other", covering="tiles")) is light_of(FURNISHED)
    assert light_of(room(SOFA, TABLE)) is not light_of(FURNISHED)


def test_what_hides_a_ray_is_a_box_on_its_way() -> None:
    rng = np.random.default_rng(4)
    footprints = rng.uniform((-1, -1, 0.1, 0.1, -3), (1, 1, 0.5, 0.5, 3), (9, 5)).tolist()
    boxes = as_arrays(Cuboid(x, y, wide, deep, turn, 0.1, 0.6, 0.5) for x, y, wide, deep, turn in footprints)
    origin = rng.uniform(-1.5, 1.5, (400, 3)).astype(np.float32)
    way = rng.uniform(-2, 2, (400, 3)).astype(np.float32)
    found = hidden(origin, way, np.ones(400, np.float32), boxes)
    at = origin[:, None] + way[:, None] * np.linspace(0, 1, 300, dtype=np.float32)[:, None]
    inside = np.zeros(at.shape[:2], np.bool_)
    for x, y, half_width, half_depth, turn in footprints:
        dx, dy = at[..., 0] - x, at[..., 1] - y
        u, v = dx * math.cos(turn) + dy * math.sin(turn), dy * math.cos(turn) - dx * math.sin(turn)
        inside |= (abs(u) < half_width) & (abs(v) < half_depth) & (at[..., 2] > 0.1) & (at[..., 2] < 0.6)
    met = inside.any(1)
    assert 40 < np.count_nonzero(met) < 350
    assert found[met].all()
    # Samples miss what is cut at a corner only.
    assert np.count_nonzero(found & ~met) <= 10


def test_a_robot_faces_the_light_from_under_a_sofa_only_when_it_looks_out() -> None:
    world = World(FURNISHED)
    (name,) = world.bodies
    # Out, against the wall, and along it with a glimpse of the room at the edge of the picture.
    for heading, faces in ((-math.pi / 2, True), (math.pi / 2, False), (0.8, False)):
        world.bodies[name].place(SOFA.x, SOFA.y - 0.1, heading)
        assert world.is_dark(name)
        assert world.faces_light(name) is faces
    # Out in the open nothing is three times as light.
    world.bodies[name].place(2.3, 1.2, 0.0)
    assert not world.is_dark(name)
    assert not world.faces_light(name)


def test_the_other_room_is_out_of_reach_behind_a_wall_without_a_door() -> None:
    with_door = Wall(start=(2.6, 3.0), end=(2.6, 0.8))
    shut = Wall(start=(2.6, 3.0), end=(2.6, 0.0))
    lamps = (Light(name="a", x=1.3, y=1.5), Light(name="b", x=3.3, y=1.5))
    for wall, reached in ((with_door, True), (shut, False)):
        world = World(room(walls=(wall,), lights=lamps))
        truth = world.truth
        there = truth.reachable(1.0, 1.0)
        assert there[round(1.5 / truth.cell), round(3.5 / truth.cell)] == reached
        assert there[round(2.5 / truth.cell), round(0.5 / truth.cell)]
        # Robots start on the larger side.
        rng = np.random.default_rng(1)
        starts = [world.random_start(rng).x for _ in range(60)]
        assert (max(starts) < 2.6 - RADIUS) is not reached


def test_a_random_start_is_open_lit_and_clear() -> None:
    world, rng = World(shipped("office")), np.random.default_rng(2)
    for _ in range(100):
        start = world.random_start(rng)
        assert world.clear(start.x, start.y)
        assert world.obstacles.gap(start.x, start.y) >= RADIUS
        assert world.floor_light(start.x, start.y) > world.median_light * 0.3
    body = next(iter(world.bodies.values()))
    assert not world.clear(body.x + 1.9 * RADIUS, body.y)
