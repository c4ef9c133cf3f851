"""What an operator's hands ask of a robot."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zscout.behaviors.teleop import FIRST, NEXT, STICK_TIMEOUT, TURN, Pilot, Way

WAYS: tuple[Way, ...] = ("forward", "back", "left", "right")


def test_a_key_held_down_drives_without_a_gap_and_stops_after_it_is_let_go() -> None:
    """As terminals do it: the press, nothing for half a second, then 30 repetitions a second."""
    pilot, came = Pilot(0.5), [0.0] + [0.5 + number / 30 for number in range(30)]
    for step in range(400):
        now = step / 100
        while came and came[0] <= now:
            pilot.press(came.pop(0), "forward")
        wheels = pilot.wheels(now)
        if now <= 1.46:
            assert (wheels.left, wheels.right) == (0.5, 0.5)
        elif now > 1.47 + NEXT:
            assert wheels.still


def test_one_tap_is_a_short_drive() -> None:
    pilot = Pilot(1.0)
    pilot.press(10.0, "left")
    wheels = pilot.wheels(10.0)
    assert (wheels.left, wheels.right) == (-TURN, TURN)
    assert wheels.lasts == pytest.approx(FIRST)
    assert pilot.wheels(10.0 + FIRST).still


def test_two_keys_drive_a_curve_and_opposite_ones_replace_each_other() -> None:
    pilot = Pilot(1.0)
    pilot.press(0.0, "forward")
    pilot.press(0.0, "right")
    wheels = pilot.wheels(0.1)
    assert wheels.left == 1.0
    assert 0 < wheels.right < 1.0
    pilot.press(0.2, "back")
    wheels = pilot.wheels(0.2)
    assert wheels.right == -1.0
    assert -1.0 < wheels.left < 0


def test_a_stick_counts_until_it_is_let_go_or_silent() -> None:
    pilot = Pilot(0.5)
    pilot.stick(0.0, 1.0, 0.0)
    assert pilot.wheels(0.5).left == 0.5
    assert pilot.wheels(STICK_TIMEOUT).still
    pilot.stick(2.0, 0.02, -0.05)
    assert pilot.wheels(2.0).still
    pilot.stick(3.0, math.nan, 7.0)
    assert pilot.wheels(3.0).left == pytest.approx(0.5 * TURN)


def test_stop_stops_and_speed_keeps_its_bounds() -> None:
    pilot = Pilot(0.5)
    pilot.press(0.0, "forward")
    pilot.stick(0.0, 1.0, 1.0)
    pilot.stop()
    assert pilot.wheels(0.0).still
    pilot.faster(100)
    assert pilot.speed == 1.0
    pilot.faster(-100)
    assert pilot.speed == 0.1
    with pytest.raises(ValueError, match="speed"):
        Pilot(0.0)


@given(st.lists(st.tuples(st.floats(0, 0.4), st.sampled_from(WAYS)), max_size=30), st.floats(0.1, 1.0))
def test_no_wheel_turns_faster_than_asked_or_without_end(hands: list[tuple[float, Way]], speed: float) -> None:
    pilot, now = Pilot(speed), 0.0
    for pause, way in hands:
        now += pause
        pilot.press(now, way)
        wheels = pilot.wheels(now)
        assert abs(wheels.left) <= speed + 1e-9
        assert abs(wheels.right) <= speed + 1e-9
        assert 0 <= wheels.lasts <= FIRST + 1e-9
    assert pilot.wheels(now + FIRST + 0.01).still
