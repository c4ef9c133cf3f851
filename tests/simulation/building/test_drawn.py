"""Buildings drawn at random: each one sensible, and with places to hide in."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.simulation.building.rooms import room, shipped
from zscout.config.strict import Where
from zscout.simulation.building import drawn
from zscout.simulation.building.bodies import RADIUS
from zscout.simulation.building.drawn import DOOR, HIDE_AREA, HIDES, STRIDE, drawn_plan, hiding_places, with_robots
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.plan_file import check_plan, check_starts
from zscout.simulation.building.solids import Cuboids, cuboids_of, parts
from zscout.simulation.building.world import World

SEEDS = range(4)


def gaps(boxes: Cuboids, x: float, y: float) -> list[float]:
    """Metres from a place to the footprint of each box; below 0 within."""
    dx, dy = x - boxes.x, y - boxes.y
    across = np.abs(dx * boxes.cos + dy * boxes.sin) - boxes.half_width
    along = np.abs(dy * boxes.cos - dx * boxes.sin) - boxes.half_depth
    outside = np.hypot(np.maximum(across, 0), np.maximum(along, 0))
    return [float(one) for one in outside + np.minimum(np.maximum(across, along), 0)]


@pytest.fixture(scope="module", params=SEEDS)
def plan(request: pytest.FixtureRequest) -> Plan:
    seed: int = request.param
    return drawn_plan(seed)


def test_a_drawn_building_is_one_that_could_be_in_a_file(plan: Plan) -> None:
    top = Where("drawn")
    check_plan(plan, top)
    check_starts(plan, top)
    assert [robot.name for robot in plan.robots] == ["scout33", "scout35", "scout37", "scout39"]
    assert plan.people


def test_there_are_places_to_hide_within_reach_of_every_robot(plan: Plan) -> None:
    areas = hiding_places(plan)
    assert len(areas) >= HIDES
    assert min(areas) >= HIDE_AREA
    truth = World(plan).truth
    for robot in plan.robots:
        within_reach = np.count_nonzero(truth.dark & truth.reachable(robot.x, robot.y)) * truth.cell**2
        assert within_reach >= sum(areas) - 1e-6


def test_robots_start_on_open_lit_floor(plan: Plan) -> None:
    world = World(plan)
    for robot in plan.robots:
        assert world.obstacles.gap(robot.x, robot.y) >= RADIUS
        assert not world.is_dark(robot.name)
        assert min(gaps(cuboids_of(plan), robot.x, robot.y)) > 0


def test_furniture_stands_in_the_room_and_clear_of_itself(plan: Plan) -> None:
    for number, piece in enumerate(plan.furniture):
        own = cuboids_of(Plan("one", plan.width, plan.depth, furniture=(piece,)))
        corners = own.corners().reshape(-1, 2)
        if piece.name != "door":
            assert corners.min() >= -1e-3
            assert (corners <= np.array([plan.width, plan.depth]) + 1e-3).all()
        for other in plan.furniture[:number]:
            apart = cuboids_of(Plan("one", plan.width, plan.depth, furniture=(other,)))
            assert min(min(gaps(apart, x, y)) for x, y in corners) > RADIUS


def test_nobody_walks_through_furniture(plan: Plan) -> None:
    door = next(piece for piece in plan.furniture if piece.name == "door")
    others = cuboids_of(plan)
    # The door's box comes first: whoever comes in passes it.
    others = others.where(np.arange(len(others)) >= len(parts(door)))
    for person in plan.people:
        assert math.dist(person.path[0], (door.x, 0)) < DOOR
        assert person.path[0] == person.path[-1]
        for start, end in zip(person.path, person.path[1:], strict=False):
            for share in np.linspace(0, 1, max(2, round(math.dist(start, end) / 0.02))):
                x, y = (a + (b - a) * float(share) for a, b in zip(start, end, strict=True))
                assert min(gaps(others, x, y)) > STRIDE - 0.06


def test_the_same_seed_draws_the_same_building() -> None:
    assert drawn_plan(1) == drawn_plan(1)
    assert drawn_plan(1).furniture != drawn_plan(2).furniture
    more = drawn_plan(1, robots=8)
    assert len(more.robots) == 8
    assert more.furniture == drawn_plan(1).furniture


def test_drawn_buildings_are_not_all_alike() -> None:
    plans = [drawn_plan(seed) for seed in SEEDS]
    assert len({plan.width for plan in plans}) == len(plans)
    assert len({piece.kind for plan in plans for piece in plan.furniture}) >= 5
    assert len({plan.covering for plan in plans}) >= 2


def test_a_building_gets_as_many_robots_as_are_asked_for() -> None:
    plan = with_robots(shipped("living_room"), 8, seed=1)
    assert len({robot.id for robot in plan.robots}) == 8
    check_starts(plan, Where("plan"))
    assert with_robots(plan, 8, seed=1) == plan
    assert with_robots(plan, 8, seed=2) != plan


def test_a_bare_room_has_nowhere_to_hide() -> None:
    assert hiding_places(room()) == []
    assert len(hiding_places(shipped("living_room"))) >= HIDES
    assert len(hiding_places(shipped("office"))) >= HIDES


def test_rooms_are_drawn_until_one_has_what_it_must(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = drawn_plan(3)
    assert len(hiding_places(usual)) == 2
    monkeypatch.setattr(drawn, "HIDES", 3)
    again = drawn_plan(3)
    assert again != usual
    assert len(hiding_places(again)) >= 3
    monkeypatch.setattr(drawn, "HIDES", 100)
    monkeypatch.setattr(drawn, "TRIES", 2)
    with pytest.raises(ValueError, match="no room of 2 drawn from seed 3 had 100 places"):
        drawn_plan(3)
