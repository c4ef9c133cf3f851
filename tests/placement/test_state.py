"""A component's states, and the moves between them."""

from __future__ import annotations

from itertools import product
from typing import get_args

import pytest

from zscout.messages import ComponentSpec, ComponentState
from zscout.placement.state import TRANSITIONS, ComponentRecord

STATES: tuple[ComponentState, ...] = get_args(ComponentState)


def test_a_move_that_the_table_lacks_is_an_error_and_changes_nothing() -> None:
    for before, after in product(STATES, STATES):
        record = ComponentRecord("counter", ComponentSpec("job"), before)
        if after is before or after in TRANSITIONS[before]:
            record.enter(after)
            assert record.state == after
            continue
        with pytest.raises(ValueError, match=f"counter can't go from {before} to {after}"):
            record.enter(after)
        assert record.state == before


def test_every_state_is_in_the_table_and_each_can_be_reached_and_left() -> None:
    assert set(TRANSITIONS) == set(STATES)
    assert frozenset().union(*TRANSITIONS.values()) == set(STATES)
    assert all(TRANSITIONS.values())


def test_nothing_runs_again_that_is_over_unless_it_is_placed_anew() -> None:
    assert TRANSITIONS["ended"] == {"waiting"}
    assert TRANSITIONS["given_up"] == {"waiting", "ended"}
