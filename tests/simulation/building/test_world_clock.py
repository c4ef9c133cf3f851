"""The building's clock, and when frames are due."""

from __future__ import annotations

import pytest

from zscout.simulation.building.world_clock import MAX_BEHIND, STEP, FramePace, WorldClock


@pytest.mark.parametrize("speed", [0.5, 1.0, 7.0])
def test_the_clock_goes_as_fast_as_it_was_told(speed: float) -> None:
    clock, now = WorldClock(speed, 50.0), 50.0
    while now < 60.0:
        now += clock.until_next(now) + 1e-6
        assert clock.due(now) == 1
    assert clock.time == pytest.approx(10 * speed, abs=2 * STEP)
    assert clock.slipped == 0
    assert clock.true_speed(now) == pytest.approx(speed, rel=0.02)


def test_a_short_pause_is_caught_up_and_a_long_one_is_not() -> None:
    clock = WorldClock(2.0, 0.0)
    assert clock.due(0.1) * STEP == pytest.approx(0.2)
    assert clock.due(10.0) * STEP == pytest.approx(MAX_BEHIND, abs=STEP)
    assert clock.slipped == pytest.approx(20 - 0.2 - MAX_BEHIND)
    # From there on at its usual speed.
    assert clock.due(10.0) == 0
    assert clock.due(10.1) * STEP == pytest.approx(0.2, abs=STEP)


def test_a_machine_that_is_too_slow_is_seen() -> None:
    clock = WorldClock(10.0, 0.0)
    for number in range(1, 41):
        clock.due(number * 0.1)
    assert clock.true_speed(4.0) == pytest.approx(MAX_BEHIND / 0.1, rel=0.05)


def test_frames_are_due_evenly_on_all_channels() -> None:
    pace, drawn = FramePace(4, 10.0), [0, 0, 0, 0]
    for step in range(500):
        while (number := pace.next(step * STEP, [0, 1, 2, 3])) is not None:
            drawn[number] += 1
    assert drawn == [100, 100, 100, 100]
    assert pace.late == 0


def test_frames_that_there_was_no_time_for_are_left_out_evenly() -> None:
    pace, drawn = FramePace(3, 10.0), [0, 0, 0]
    # One frame every 0.1 s, where 0.1 s ask for three.
    for step in range(300):
        number = pace.next(step * 0.1, [0, 1, 2])
        assert number is not None
        drawn[number] += 1
    assert max(drawn) - min(drawn) <= 1
    assert pace.late == pytest.approx(600, abs=10)


def test_frames_that_nobody_wanted_are_not_late() -> None:
    pace = FramePace(2, 10.0)
    pace.skip(100.0, [0, 1])
    assert pace.next(100.0, [0]) is None
    assert pace.next(100.1, [0]) == 0
    assert pace.late == 0
