"""Fleet time: the median of clocks, corrected in one step where most of them differ from it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zscout.services.bookings.fleet_clock import DIFFERENCE_LASTS, DIFFERS, REMEMBERED, FleetClock, agreed
from zscout.types import SECOND

NOON = 1_800_000_000 * SECOND
DAYS = 3 * 86_400 * SECOND
ROUND = 30 * SECOND
HOSTS = "xyzv"
AHEAD = st.one_of(st.integers(-3 * SECOND, 3 * SECOND), st.integers(-DAYS, DAYS))
ROUNDS = st.lists(st.dictionaries(st.sampled_from(HOSTS), AHEAD, min_size=1), max_size=8)


class Story:
    """Hosts' clocks, by how much they are ahead of fleet time as it began, are read every 30 s."""

    def __init__(self) -> None:
        self.clock, self.now = FleetClock(NOON, 0, 0), 0

    def read(self, kept: str = "", /, **ahead: int) -> int:
        """By how much fleet time is corrected. `kept`: hosts whose clocks are synchronised."""
        self.now += ROUND
        walls = {host: NOON + self.now + differs for host, differs in ahead.items()}
        return self.clock.correct(walls, self.now, frozenset(kept))

    @property
    def ahead(self) -> int:
        return self.clock.at(self.now) - NOON - self.now


@given(ROUNDS)
def test_it_moves_only_to_what_most_clocks_say_and_by_more_than_they_may_differ(rounds: list[dict[str, int]]) -> None:
    story, last = Story(), dict[str, int]()
    for ahead in rounds:
        before, last = story.ahead, last | ahead
        moved = story.read(**ahead)
        assert story.ahead == before + moved
        if moved:
            assert abs(moved) > DIFFERS * SECOND
            assert story.ahead in last.values()
            differ = [abs(one - before) > DIFFERS * SECOND for one in last.values()]
            assert 2 * sum(differ) > len(differ)


@given(st.dictionaries(st.sampled_from(HOSTS), AHEAD, min_size=1))
def test_it_comes_to_what_most_clocks_say_and_stays(ahead: dict[str, int]) -> None:
    story = Story()
    assert [story.read(**ahead) for _ in range(3)][:2] == [0, 0]
    assert abs(agreed(ahead.values(), story.ahead) - story.ahead) <= DIFFERS * SECOND
    assert [story.read(**ahead) for _ in range(5)] == [0] * 5


@pytest.mark.parametrize("by", [DAYS, -DAYS, 3 * SECOND], ids=["forward", "back", "3 s"])
def test_the_only_clock_that_is_set_corrects_it_at_once(by: int) -> None:
    story = Story()
    assert [story.read(x=0), story.read(x=by), story.read(x=by)] == [0, by, 0]


def test_one_clock_of_three_that_is_set_changes_nothing_and_two_do() -> None:
    story = Story()
    assert [story.read(x=0, y=0, z=0), story.read(x=0, y=DAYS, z=0)] == [0, 0]
    assert [story.read(x=0, y=DAYS, z=0) for _ in range(5)] == [0] * 5
    assert story.read(x=0, y=DAYS, z=DAYS) == DAYS
    assert story.read(x=DAYS, y=DAYS, z=DAYS) == 0


def test_clocks_that_were_right_all_along_are_waited_for_a_minute() -> None:
    story = Story()
    story.read(x=0)
    told = [story.read(x=0, y=DAYS, z=DAYS + SECOND) for _ in range(3)]
    assert (told, DIFFERENCE_LASTS) == ([0, 0, DAYS], 2 * ROUND)


def test_a_clock_that_is_set_away_from_what_others_say_hurries_nothing() -> None:
    story = Story()
    story.read(x=0, y=DAYS, z=DAYS)
    assert story.read(x=-DAYS, y=DAYS, z=DAYS) == 0


def test_the_minute_begins_anew_where_clocks_say_something_else() -> None:
    story = Story()
    told = [story.read(x=0, y=ahead, z=ahead) for ahead in (DAYS, 2 * DAYS, 2 * DAYS, 2 * DAYS)]
    assert told == [0, 2 * DAYS, 0, 0]  # they were set
    story = Story()
    later = dict.fromkeys("stuv", 2 * DAYS)
    told = [story.read(x=0), story.read(y=DAYS, z=DAYS), *(story.read(**later) for _ in range(3))]
    assert told == [0, 0, 0, 0, 2 * DAYS]


def test_who_is_alone_for_a_while_is_not_the_majority() -> None:
    story = Story()
    story.read(x=DAYS, y=0, z=0)
    for _ in range(REMEMBERED // ROUND - 1):
        assert story.read(x=DAYS) == 0
    assert [story.read(x=DAYS) for _ in range(3)] == [0, 0, DAYS]


def test_of_two_halves_the_one_counts_whose_clocks_are_synchronised() -> None:
    story = Story()
    assert [story.read("y", x=0, y=DAYS) for _ in range(4)] == [0, 0, DAYS, 0]
    assert [story.read("xy", x=0, y=DAYS) for _ in range(4)] == [0] * 4
    story = Story()
    assert [story.read("z", v=0, x=0, y=DAYS, z=DAYS) for _ in range(3)] == [0, 0, DAYS]
    # It is no majority: its time service may be wrong.
    story = Story()
    assert [story.read("x", x=0, y=DAYS, z=DAYS) for _ in range(3)] == [0, 0, DAYS]
    assert agreed([NOON, NOON + DAYS], kept=[NOON + DAYS]) == NOON + DAYS


def test_one_clock_of_three_that_is_wrong_changes_nothing_much() -> None:
    assert agreed([NOON, NOON + 1, NOON + 3_600 * SECOND]) == NOON + 1
    assert agreed([NOON, NOON + 10], current=NOON + 9) == NOON + 10
    assert agreed([NOON, NOON + 10], current=NOON + 1) == NOON
    assert agreed([NOON, NOON + 10]) == NOON
