"""What cameras see: geometry against plane trigonometry, light, exposure and noise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.simulation.building.rooms import CARTON, LAMP, SOFA, TABLE, column_at, room, shipped
from zscout.simulation.building.camera import MAX_VIEWS
from zscout.simulation.building.casting import (
    ALL,
    EYE,
    FIRST_BOX,
    FOCAL,
    HEIGHT,
    HORIZON,
    VIEW,
    WIDTH,
    Caster,
    Cylinder,
    Geometry,
    columns_of,
)
from zscout.simulation.building.plan import Furniture, Light, Noise, Plan
from zscout.simulation.building.sensor import GAMMA, MOST_GAIN, SETTLES, TARGET, Sensor
from zscout.simulation.building.solids import Floats, cuboids_of
from zscout.simulation.building.world import World

BLOCK = Furniture(name="block", kind="solid", x=3.0, y=1.5, width=0.4, depth=0.6, height=0.3)


def caster(plan: Plan) -> Caster:
    return Caster(plan, cuboids_of(plan))


def cast(view: Caster, x: float, y: float, heading: float, moving: list[Cylinder], columns: slice = ALL) -> Geometry:
    return view.with_moving(view.cast(x, y, heading, columns), x, y, moving)


def linear(world: World, robot: str) -> Floats:
    """A picture with its gamma undone."""
    return np.asarray((world.picture(robot) / 255) ** GAMMA, np.float32)


def test_a_wall_is_as_far_as_trigonometry_says() -> None:
    seen = caster(room()).cast(1.0, 1.5, 0.0)
    # 3 m ahead is wall 3, numbered from 2.
    middle = seen.surface[:, WIDTH // 2]
    assert (middle[HORIZON - 1], seen.depth[HORIZON - 1, WIDTH // 2]) == (3, pytest.approx(3.0, rel=1e-5))
    floor = np.flatnonzero(middle == 0)
    assert floor[0] == pytest.approx(HORIZON + EYE / 3.0 * FOCAL, abs=1)
    assert floor[-1] == HEIGHT - 1
    # The ceiling is above the picture, even at the far wall.
    assert not np.any(seen.surface == 1)


def test_a_box_covers_the_columns_and_rows_that_it_should() -> None:
    seen = caster(room(BLOCK)).cast(1.0, 1.5, 0.0)
    rows, columns = np.nonzero(seen.surface == FIRST_BOX)
    near = 3.0 - BLOCK.width / 2 - 1.0
    edge = math.atan2(BLOCK.depth / 2, near)
    assert columns.min() == pytest.approx(column_at(edge), abs=1)
    assert columns.max() == pytest.approx(column_at(-edge), abs=1)
    assert rows.min() == pytest.approx(HORIZON - (BLOCK.height - EYE) / near * FOCAL, abs=1)
    assert rows.max() == pytest.approx(HORIZON + EYE / near * FOCAL, abs=1)
    assert seen.depth[HORIZON, WIDTH // 2] == pytest.approx(near, rel=1e-5)
    # Turned away there is none of it.
    assert not np.any(caster(room(BLOCK)).cast(1.0, 1.5, math.pi).surface == FIRST_BOX)


def test_the_nearer_thing_hides_the_farther() -> None:
    behind = Cylinder(3.6, 1.5, 0.1, 0.0, 0.25, 0.5, 0.5, person=True)
    before = behind._replace(x=2.0)
    view = caster(room(BLOCK))
    for body, shown in ((behind, False), (before, True)):
        surface = cast(view, 1.0, 1.5, 0.0, [body]).surface
        assert np.any(surface == view.first_moving) == shown


def test_the_columns_of_a_cylinder_are_where_it_is_seen() -> None:
    rng, view, bare, seen = np.random.default_rng(7), caster(room(TABLE)), caster(room()), 0
    for _ in range(200):
        x, y, heading = rng.uniform(0.1, 3.9), rng.uniform(0.1, 2.9), rng.uniform(-9, 9)
        body = Cylinder(
            rng.uniform(0.3, 3.7), rng.uniform(0.3, 2.7), rng.uniform(0.03, 0.3), 0, 1, 0.5, 0.5, person=True
        )
        part = columns_of(x, y, heading, body)
        shown = np.flatnonzero((cast(bare, x, y, heading, [body]).surface == bare.first_moving).any(0))
        if part is None:
            assert not len(shown)
            continue
        if len(shown):
            seen += 1
            assert part.start <= shown[0] <= part.start + 3
            assert part.stop - 4 <= shown[-1] < part.stop
        whole = cast(view, x, y, heading, [body])
        some = cast(view, x, y, heading, [body], part)
        assert np.array_equal(some.surface, whole.surface[:, part])
        assert np.array_equal(some.depth, whole.depth[:, part])
    assert seen > 40


def test_under_a_sofa_there_is_a_dark_gap() -> None:
    world = World(room(SOFA, lights=(Light(name="lamp", x=2.0, y=1.0),)))
    world.bodies["r1"].place(2.0, 1.0, math.pi / 2)
    light = linear(world, "r1")
    front = SOFA.y - SOFA.depth / 2 - 1.0
    gap = HORIZON + EYE / front * FOCAL, HORIZON - (SOFA.clearance - EYE) / front * FOCAL
    middle = slice(WIDTH // 2 - 15, WIDTH // 2 + 15)
    inside = light[round(gap[1]) + 2 : round(gap[0]) - 1, middle].mean()
    before = light[round(gap[0]) + 4 : round(gap[0]) + 12, middle].mean()
    above = light[round(gap[1]) - 12 : round(gap[1]) - 2, middle].mean()
    assert inside < before / 6
    assert inside < above / 3


def test_what_is_above_shows_its_dark_underside() -> None:
    canopy = Furniture(
        name="canopy", kind="raised", x=3.0, y=1.5, width=2.0, depth=1.6, height=1.2, turn=-1.5708, clearance=0.3
    )
    world = World(room(canopy, lights=(Light(name="lamp", x=0.8, y=1.5),)))
    camera = world._camera
    middle = slice(WIDTH // 2 - 10, WIDTH // 2 + 10)
    front = camera.linear(0.9, 1.5, 0.0, [], 1.0, 1.0)[:3, middle]
    below = camera.linear(2.0, 1.5, 0.0, [], 1.0, 1.0)[:3, middle]
    assert below.max() < front.min() / 3


def test_a_black_carton_is_dark_however_it_is_lit() -> None:
    world = World(room(CARTON))
    world.bodies["r1"].place(CARTON.x - 1.0, CARTON.y, 0.0)
    light = linear(world, "r1")
    assert light[HORIZON, WIDTH // 2] < light[HEIGHT - 10, WIDTH // 2] / 5


def test_lamps_dim_and_the_picture_dims_with_them() -> None:
    world = World(room(SOFA, TABLE))
    camera, pose = world._camera, (1.0, 1.0, 0.5)
    full = camera.linear(*pose, [], 1.0, 1.0)
    assert np.allclose(camera.linear(*pose, [], 0.5, 1.0), full / 2, rtol=1e-3)
    assert np.allclose(camera.linear(*pose, [], 1.0, 0.2), full, rtol=1e-3)


def test_a_window_shines_itself_and_as_the_day_does() -> None:
    window = Light(name="window", x=0.0, y=1.5, z=1.5, width=1.2, depth=1.0, kind="window")
    camera = World(room(lights=(LAMP, window)))._camera
    night, day = (camera.linear(3.0, 1.5, math.pi, [], 1.0, share) for share in (0.0, 1.0))
    assert night.max() < 1.0
    shining = np.argwhere(day > 2.0)
    assert len(shining) > 500
    # Its lower edge, 1 m up, from 3 m away.
    assert shining[:, 0].max() == pytest.approx(HORIZON - (1.0 - EYE) / 3.0 * FOCAL, abs=3)


def test_windows_follow_the_day_and_lamps_do_not() -> None:
    window = Light(name="window", x=0.0, y=1.5, z=1.5, width=1.2, depth=1.0, kind="window")
    for lights, changes in (((window,), True), ((LAMP,), False)):
        noise = Noise(sensor=0, analog=0, flicker=0, daylight=0.9, daylight_period=10)
        world, gains = World(room(lights=lights, noise=noise)), []
        for _ in range(20):
            for _ in range(5):
                world.step(0.1)
            world.picture("r1")
            gains.append(world._sensors["r1"].gain)
        assert (max(gains) > 2 * min(gains)) == changes


@pytest.mark.slow
@pytest.mark.parametrize("looks", [range(53, 68), pytest.param(range(100), marks=pytest.mark.slow)])
def test_a_camera_that_stands_sees_what_one_does_that_has_just_come(looks: range) -> None:
    world, both, rng = World(shipped("office"), seed=3), 0, np.random.default_rng(4)
    names = list(world.bodies)
    for name in names:
        world.bodies[name].place(*world.random_start(rng))
    for number in range(looks.stop):
        for _ in range(5):
            world.step(0.1)
        if number not in looks:
            continue
        for name in names:
            pose, moving, light = world.bodies[name].pose, world._moving(name), rng.uniform(0.5, 1.5, 2)
            stands = world._camera.linear(*pose, moving, *light)
            world._camera._views.clear()
            comes = world._camera.linear(*pose, moving, *light)
            assert np.allclose(stands, comes, rtol=1e-5, atol=1e-6)
            world._camera.linear(*pose, moving, *light)
            both += world.crossing(name)
    assert both > 5


def test_of_views_the_last_looked_at_are_kept() -> None:
    camera = World(room(SOFA))._camera
    for number in range(3 * MAX_VIEWS):
        camera.linear(1.0, 1.0, 0.5, [], 1.0, 1.0)
        camera.linear(1.0, 1.0, number / 100, [], 1.0, 1.0)
    assert len(camera._views) == MAX_VIEWS
    assert camera._views[1.0, 1.0, 0.5].lit is not None


def test_another_robot_is_seen_and_shades_the_floor() -> None:
    world = World(room(robots=2))
    world.bodies["r1"].place(1.0, 1.5, 0.0)
    world.bodies["r2"].place(3.9, 2.9, 0.0)
    without = linear(world, "r1")
    world.bodies["r2"].place(1.5, 1.5, 0.0)
    changed = np.abs(linear(world, "r1") - without) > 0.01
    rows, columns = np.nonzero(changed[:, WIDTH // 2 - 40 : WIDTH // 2 + 40])
    assert 100 < len(rows) < 3000
    assert columns.mean() == pytest.approx(40, abs=2)
    assert rows.min() > HORIZON - 5
    # It stands on row 71; what is darker below is its shadow.
    assert rows.max() > 73


# The sensor


def even(light: float) -> Floats:
    return np.full((HEIGHT, WIDTH), light, np.float32)


def test_exposure_settles_slowly() -> None:
    sensor = Sensor(0.0, np.random.default_rng(0))
    sensor.expose(even(0.4), 0.0)
    bright = sensor.gain
    assert bright * 0.4 == pytest.approx(TARGET, rel=0.15)
    gains = []
    for step in range(1, 60):
        sensor.expose(even(0.1), step * 0.1)
        gains.append(sensor.gain)
    assert gains == sorted(gains)
    # After its time constant 1/e of the way, in stops, is left.
    after = gains[round(SETTLES / 0.1) - 1]
    assert math.log(gains[-1] / after) == pytest.approx(math.log(4) / math.e, rel=0.03)
    assert gains[-1] == pytest.approx(4 * bright, rel=0.02)
    for step in range(60, 200):
        sensor.expose(even(1e-4), step * 0.1)
    assert sensor.gain == pytest.approx(MOST_GAIN, rel=1e-3)


def test_grey_levels_are_light_with_gamma() -> None:
    ramp = np.tile(np.linspace(0, 0.5, WIDTH, dtype=np.float32), (HEIGHT, 1))
    sensor = Sensor(0.0, np.random.default_rng(0))
    picture = sensor.expose(ramp, 0.0)
    assert picture.dtype == np.uint8
    row = picture[HORIZON].astype(int)
    assert (np.diff(row) >= 0).all()
    back = (row[20:140] / 255) ** GAMMA / sensor.gain
    assert np.allclose(back, ramp[0, 20:140], rtol=0.1)


def test_noise_grows_where_it_is_dark_and_with_its_factor() -> None:
    def spread(light: float, factor: float) -> float:
        sensor = Sensor(factor, np.random.default_rng(1))
        return float(sensor.expose(even(light), 0.0)[40:80, 60:100].std())

    assert spread(0.3, 0.0) < 0.7
    assert spread(0.02, 1.0) > 1.5 * spread(0.3, 1.0) > 1
    assert spread(0.3, 3.0) == pytest.approx(3 * spread(0.3, 1.0), rel=0.2)


def test_lamps_that_flicker_are_seen_and_quiet_ones_are_not() -> None:
    for flicker in (0.0, 0.2):
        world = World(room(noise=Noise(sensor=0, analog=0, flicker=flicker, daylight=0)))
        levels = [float(world.picture("r1").mean()) for _ in range(10)]
        assert (np.ptp(levels) > 5) == (flicker > 0)


def test_a_picture_has_its_size_and_its_field_of_view() -> None:
    world = World(shipped("living_room"))
    picture = world.picture("scout33")
    assert picture.shape == (HEIGHT, WIDTH)
    assert picture.dtype == np.uint8
    assert math.atan(WIDTH / 2 / FOCAL) * 2 == pytest.approx(VIEW)
    assert 30 < picture.mean() < 200
    assert picture.std() > 15


def test_who_walks_is_counted_as_the_whole_picture_shows() -> None:
    world, some, hidden = World(shipped("living_room"), seed=3), 0, 0
    view = world._camera.caster
    for step in range(600):
        world.step(0.1)
        if step % 4:
            continue
        if not any(walker.here for walker in world.walkers):
            assert world.people_in_view("scout33") == 0
            continue
        for name, body in list(world.bodies.items())[:2]:
            shapes = world._moving(name)
            surface = cast(view, *body.pose, shapes).surface
            numbers = [view.first_moving + at for at, shape in enumerate(shapes) if shape.person]
            pixels = int(np.isin(surface, numbers).sum())
            assert world.people_in_view(name) == pixels
            assert world.crossing(name, 200) == (pixels >= 200)
            some, hidden = some + (pixels > 0), hidden + (pixels == 0)
    assert some > 5
    assert hidden > 5
