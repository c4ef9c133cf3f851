"""When people walk, and where."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from zscout.simulation.building.people import FOOT, STRIDE, Walker
from zscout.simulation.building.plan import Person

ADA = Person(name="ada", path=((0.0, 1.0), (2.0, 1.0), (2.0, 3.0)), speed=2.0, first=10.0, every=5.0, jitter=0.0)


def walker(person: Person, seed: int = 0) -> Walker:
    return Walker(person, np.random.default_rng(seed))


def spells(person: Person, seconds: float, *, seed: int = 0) -> list[tuple[float, float]]:
    """From when to when somebody was there."""
    one, found = walker(person, seed), []
    since: float | None = None
    for step in range(round(seconds / 0.1)):
        one.at(step * 0.1)
        if one.here and since is None:
            since = step * 0.1
        if not one.here and since is not None:
            found.append((since, step * 0.1))
            since = None
    return found


def test_a_walk_begins_ends_and_comes_again() -> None:
    # 4 m at 2 m/s take 2 s.
    assert spells(ADA, 30.0) == [pytest.approx(pair, abs=0.11) for pair in ((10, 12), (17, 19), (24, 26))]
    assert len(spells(replace(ADA, walks=2), 60.0)) == 2


def test_walks_come_irregularly_and_by_seed() -> None:
    irregular = replace(ADA, jitter=0.5)
    begins = [start for start, _ in spells(irregular, 300.0)]
    waits = np.diff(begins) - 2.0
    assert len(waits) > 20
    assert waits.min() > 2.3
    assert waits.max() < 7.7
    assert waits.std() > 0.5
    assert spells(irregular, 60.0, seed=1) == spells(irregular, 60.0, seed=1)
    assert spells(irregular, 60.0, seed=1) != spells(irregular, 60.0, seed=2)


def test_a_walker_follows_the_path_at_its_speed() -> None:
    one = walker(ADA)
    for time, place in ((10.5, (1.0, 1.0)), (11.0, (2.0, 1.0)), (11.25, (2.0, 1.5)), (11.9, (2.0, 2.8))):
        one.at(time)
        assert (one.x, one.y) == pytest.approx(place)


def test_a_long_pause_of_ours_skips_walks_and_loses_none_after() -> None:
    one = walker(ADA)
    one.at(10.0 + 7 * 1000 + 1.0)
    assert one.here
    assert (one.x, one.y) == pytest.approx((2.0, 1.0))


def test_feet_step_along_beside_the_way() -> None:
    one, ahead = walker(ADA), []
    for step in range(1, 100):
        one.at(10.0 + step * 0.01)
        feet = one.feet()
        assert len(feet) == 2
        for x, y, radius in feet:
            assert radius == FOOT
            assert abs(x - one.x) <= STRIDE / 2 + 1e-9
            assert 0.05 < abs(y - one.y) < 0.15
        ahead.append(feet[0][0] - feet[1][0])
    # The one before the other, by turns.
    assert min(ahead) < -STRIDE / 2
    assert max(ahead) > STRIDE / 2


def test_from_the_floor_somebody_is_two_legs_and_a_trunk_above() -> None:
    one = walker(ADA)
    one.at(5.0)
    assert one.feet() == []
    assert one.shapes(0.5) == []
    one.at(10.5)
    *legs, trunk = one.shapes(0.5)
    assert [leg.low for leg in legs] == [0.0, 0.0]
    assert trunk.low == legs[0].high
    assert trunk.high > 1.5
    assert all(shape.person and shape.light == 0.5 for shape in (*legs, trunk))
    assert math.dist((trunk.x, trunk.y), (one.x, one.y)) == 0.0
