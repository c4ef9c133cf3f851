"""A component's states, and the moves between them."""

from __future__ import annotations

import pytest

from zscout.placement.events import ComponentState, PlacementSpec
from zscout.placement.state import TRANSITIONS, ComponentRecord

ALL = [(before, after) for before in ComponentState for after in ComponentState]


@pytest.mark.parametrize(("before", "after"), ALL)
def test_a_move_that_the_table_lacks_is_an_error_and_changes_nothing(
    before: ComponentState, after: ComponentState
) -> None:
    record = ComponentRecord("counter", PlacementSpec("job"), before)
    if after is before or after in TRANSITIONS[before]:
        record.enter(after)
        assert record.state is after
    else:
        with pytest.raises(ValueError, match=f"counter: from {before} to {after}"):
            record.enter(after)
        assert record.state is before


def test_every_state_is_in_the_table_and_each_can_be_reached_and_left() -> None:
    assert set(TRANSITIONS) == set(ComponentState)
    assert frozenset().union(*TRANSITIONS.values()) == set(ComponentState)
    assert all(TRANSITIONS.values())


def test_nothing_runs_again_that_is_over_unless_it_is_placed_anew() -> None:
    assert TRANSITIONS[ComponentState.ENDED] == {ComponentState.WAITING}
    assert TRANSITIONS[ComponentState.GIVEN_UP] == {ComponentState.WAITING, ComponentState.ENDED}
