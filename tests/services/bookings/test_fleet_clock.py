"""Fleet time: the median of clocks, slewed and never set."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from zscout.services.bookings.fleet_clock import SLEW, FleetClock, agreed
from zscout.types import SECOND

NOON = 1_800_000_000 * SECOND
STEPS = st.lists(st.tuples(st.integers(0, 1_000 * SECOND), st.integers(-10_000 * SECOND, 10_000 * SECOND)), max_size=8)


@given(STEPS)
def test_it_is_slewed_by_one_percent_at_most(steps: list[tuple[int, int]]) -> None:
    clock, now = FleetClock(NOON, 0, 0), 0
    time = clock.at(now)
    for span, off in steps:
        clock.aim(NOON + now + off, now)
        assert clock.at(now) == time
        for _ in range(3):
            now += span
            assert abs(clock.at(now) - time - span) <= span // SLEW + 1
            time = clock.at(now)


@given(st.integers(-10_000 * SECOND, 10_000 * SECOND))
def test_it_comes_to_what_it_aims_at_and_stays(off: int) -> None:
    clock = FleetClock(NOON, 0, 0)
    clock.aim(NOON + off, 0)
    arrives = abs(off) * SLEW
    assert clock.at(arrives) == NOON + off + arrives
    assert clock.at(2 * arrives + SECOND) == NOON + off + 2 * arrives + SECOND


def test_one_clock_of_three_that_is_wrong_changes_nothing_much() -> None:
    assert agreed([NOON, NOON + 1, NOON + 3_600 * SECOND]) == NOON + 1
    assert agreed([NOON, NOON + 10], goes_on=NOON + 9) == NOON + 10
    assert agreed([NOON, NOON + 10], goes_on=NOON + 1) == NOON
    assert agreed([NOON, NOON + 10]) == NOON
