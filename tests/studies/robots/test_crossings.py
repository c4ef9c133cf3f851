"""Where crossings go: each is counted once, by the first that was in its way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from studies.robots.crossings import LOOK, Crossings, CrossingsOf, Fate
from studies.robots.watch import Case, hide_at_random, plan_of
from zscout.simulation.building.world import World

SECONDS = 60.0


def played(act: Callable[[World, Crossings, str, float | None], None], seconds: float = SECONDS) -> CrossingsOf:
    """One hidden robot; `act` is called each tenth of a second, with for how long somebody is in view."""
    world = World(plan_of(Case("living_room", 1.0, 3)), seed=3)
    robot = hide_at_random(world, np.random.default_rng(3))
    crossings = Crossings(world, [robot])
    crossings.hidden(robot)
    since = None
    while world.time < seconds:
        world.step(0.1)
        if not world.crossing(robot):
            since = None
        elif since is None:
            since = world.time
        act(world, crossings, robot, None if since is None else world.time - since)
        crossings.stepped()
    return crossings.found[robot]


def watching(crossings: Crossings, robot: str, *, alert: bool = False, learning: bool = False) -> None:
    crossings.looked(robot, watches=True, picture=True, learning=learning, alert=alert)


@pytest.fixture(scope="module")
def there() -> int:
    """Crossings of this place."""
    return played(lambda *_: None).all


def test_nobody_on_the_air(there: int) -> None:
    found = played(lambda *_: None)
    assert there > 1
    assert found.fates == {"off the air": there}
    assert found.could == 0


@pytest.mark.parametrize(
    ("told_after", "fate"), [(0.5, "in time"), (1.8, "told late"), (100.0, "not told")], ids=["soon", "late", "never"]
)
def test_who_watches_tells_in_time_late_or_not_at_all(there: int, told_after: float, fate: Fate) -> None:
    def act(world: World, crossings: Crossings, robot: str, seen_for: float | None) -> None:
        if world.bodies[robot].camera is None:
            world.bodies[robot].transmit(1, -60.0)
        watching(crossings, robot, alert=seen_for is not None and seen_for >= told_after)

    found = played(act)
    assert found.fates == {fate: there}
    assert (found.could, found.told) == (there, there * (fate == "in time"))


def test_a_camera_that_is_always_warming_up(there: int) -> None:
    def act(world: World, crossings: Crossings, robot: str, _: float | None) -> None:
        world.bodies[robot].transmit(None, world.time)
        world.bodies[robot].transmit(1, world.time)
        watching(crossings, robot)

    found = played(act)
    assert (found.fates, found.could) == ({"warming up": there}, 0)


def test_a_background_that_is_always_being_learned_could_have_been_known(there: int) -> None:
    def act(world: World, crossings: Crossings, robot: str, _: float | None) -> None:
        world.bodies[robot].transmit(1, -60.0)
        watching(crossings, robot, learning=True)

    found = played(act)
    assert (found.fates, found.could) == ({"learning": there}, there)


def test_a_robot_that_is_not_where_it_hid(there: int) -> None:
    def act(world: World, crossings: Crossings, robot: str, _: float | None) -> None:
        body = world.bodies[robot]
        body.transmit(1, -60.0)
        body.heading = body.heading if world.time > 0.15 else body.heading + 1.0
        watching(crossings, robot)

    assert played(act).fates["not hidden"] == there


def test_a_hold_that_ends_as_somebody_comes_could_not_have_told(there: int) -> None:
    def act(world: World, crossings: Crossings, robot: str, seen_for: float | None) -> None:
        if seen_for is None or seen_for < 0.35:
            world.bodies[robot].transmit(1, -60.0)
            watching(crossings, robot)
        elif world.bodies[robot].camera is not None:
            world.bodies[robot].transmit(None, world.time)
            crossings.ended(robot)

    found = played(act)
    assert found.fates == {"off the air": there}
    assert found.could == 0


def test_a_crossing_that_the_runs_end_cuts_is_none() -> None:
    within: list[float] = []

    def act(world: World, crossings: Crossings, robot: str, seen_for: float | None) -> None:
        world.bodies[robot].transmit(1, -60.0)
        watching(crossings, robot)
        if seen_for is not None and seen_for > 2 * LOOK:
            within.append(world.time)

    played(act)
    found = played(act, seconds=within[0])
    assert (found.all, found.could) == (0, 0)
