"""Dark places: gaps are found where they are, dark faces are not, whatever the exposure."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.behaviors.perception.rooms import carton, room, seen_from, sofa
from zscout.behaviors.perception.darkness import analyse
from zscout.behaviors.perception.hiding.compass import brighter, floor_strip, strip_and_tones, turned
from zscout.behaviors.perception.lens import FIELD, GAMMA, bearing, linear
from zscout.simulation.building.plan import Rug


@pytest.mark.parametrize("distance", [0.5, 0.8, 1.2, 1.8])
def test_the_gap_beneath_a_sofa_is_found_where_it_is(distance: float) -> None:
    picture = seen_from(room(sofa(4.0)), 4.0 - distance, 2.0, 0.0)
    widest = max(analyse(picture).places, key=lambda place: place.width)
    assert widest.distance == pytest.approx(distance, rel=0.25, abs=0.05)
    assert widest.height == pytest.approx(0.12, abs=0.05)
    seen = min(2.0, 2 * distance * math.tan(FIELD / 2))
    assert widest.width == pytest.approx(seen, rel=0.35)
    assert widest.darkness < 0.1
    assert abs(widest.bearing) < 0.15


@pytest.mark.parametrize("distance", [0.4, 0.8, 1.3])
def test_a_black_carton_is_no_place_to_hide(distance: float) -> None:
    assert analyse(seen_from(room(carton(4.0)), 4.0 - distance, 2.0, 0.0)).places == ()


def test_an_empty_room_has_no_dark_place() -> None:
    for turn in range(8):
        assert analyse(seen_from(room(), 2.5, 2.0, turn * math.pi / 4)).places == ()


def test_exposure_changes_nothing() -> None:
    picture = seen_from(room(sofa(4.0)), 3.0, 2.0, 0.0)
    darker = np.round(255 * (linear(picture) * 0.5) ** (1 / GAMMA)).astype(np.uint8)
    (one,), (other,) = analyse(picture).places, analyse(darker).places
    assert other.distance == pytest.approx(one.distance, rel=0.1)
    assert other.width == pytest.approx(one.width, rel=0.15)
    assert analyse(darker).lit == pytest.approx(analyse(picture).lit / 2, rel=0.1)


def test_out_of_the_dark_the_light_stands_out() -> None:
    plan = room(sofa(4.0))
    inside = analyse(seen_from(plan, 4.3, 2.0, math.pi))
    assert inside.near < 0.1 * inside.outside
    assert float(np.mean(inside.contrast >= 4)) > 0.9
    assert inside.above < 0.2 * inside.outside
    away = analyse(seen_from(plan, 4.3, 2.0, 0.0))
    assert float(away.contrast.mean()) < 0.3 * float(inside.contrast.mean())


def test_a_dark_rug_has_no_roof() -> None:
    plan = room(rugs=(Rug(x=2.5, y=2.0, width=0.8, depth=0.8, shade=0.04),))
    view = analyse(seen_from(plan, 2.5, 2.0, 0.0))
    assert view.near < 0.3 * view.outside
    assert view.above > 0.4 * view.outside


def test_bearings_are_positive_to_the_left() -> None:
    assert bearing(0) == pytest.approx(math.radians(32.4), abs=0.01)
    assert bearing(79.5) == 0 > bearing(159)


# Turns are measured in pictures alone; a floor that does not pass is a robot that is stuck

PLAN = room(sofa(4.0), carton(1.2))


@pytest.mark.parametrize("degrees", [-40, -20, -5, 0, 3, 15, 36])
@pytest.mark.parametrize("heading", [0.3, 2.0, 4.1])
def test_a_turn_is_measured(degrees: float, heading: float) -> None:
    angle, before = math.radians(degrees), seen_from(PLAN, 2.4, 1.6, heading, seed=1)
    after = seen_from(PLAN, 2.4, 1.6, heading + angle, seed=2)
    # The wheels were told otherwise: they slipped.
    turn = turned(strip_and_tones(before)[0], strip_and_tones(after)[0], angle * 0.85)
    assert turn.angle == pytest.approx(angle, abs=math.radians(1.5))
    assert turn.likeness > 0.3


def test_a_turn_that_did_not_happen_is_none() -> None:
    before, after = (strip_and_tones(seen_from(PLAN, 2.4, 1.6, 0.3, seed=seed))[0] for seed in (1, 2))
    assert turned(before, after, math.radians(36)).angle == pytest.approx(0, abs=math.radians(1))


def test_the_camera_opening_is_measured() -> None:
    one = seen_from(PLAN, 2.4, 1.6, 0.3)
    bright = strip_and_tones(one)[1]
    half = np.round(255 * ((one / 255.0) ** 2.2 / 2) ** (1 / 2.2)).astype(np.uint8)
    assert brighter(strip_and_tones(half)[1], bright, 0.0) == pytest.approx(2, rel=0.03)
    assert brighter(bright, bright, 10.0) == 1.0


def test_the_floor_tells_whether_the_robot_moves() -> None:
    def floor(x: float, heading: float, seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.int8]]:
        return floor_strip(seen_from(PLAN, x, 2.0, heading, seed=seed))

    for x in (2.0, 2.4, 2.8):
        here = floor(x, 0.0, 1)
        assert turned(here, floor(x, 0.05, 2), 0.0, 0.3).likeness > 0.5
        assert turned(here, floor(x + 0.1, 0.0, 2), 0.0, 0.3).likeness < 0.45
