"""Turns are measured in pictures alone; a floor that does not pass is a robot that is stuck."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.behaviors.perception.rooms import carton, room, seen_from, sofa
from zscout.behaviors.perception.hiding.compass import brighter, floor_strip, strip_and_tones, turned

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
