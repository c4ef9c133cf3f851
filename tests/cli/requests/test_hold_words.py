"""Until when a hold stays, as a request of some priority is told of it."""

from __future__ import annotations

import re
from decimal import Decimal

import pytest

from tests.cli.tools import CLOCK
from zscout.cli.requests.waiting import hold_json, hold_text
from zscout.messages import HoldView
from zscout.types import Grant, Place, Term


def hold(protected_from: float | None) -> HoldView:
    term = Term(1, "a")
    return HoldView(
        id="1",
        arc="survey",
        client="desk/c",
        priority=1,
        place=Place(term, 1),
        grant=Grant(term, 1),
        needs={"robot/a": {}},
        min_runtime=Decimal(100),
        held=40.0,
        remaining=60.0,
        protected_from=protected_from,
    )


@pytest.mark.parametrize(
    ("protected_from", "priority", "protected"),
    [(75.0, 2, True), (75.0, 1, False), (60.0, 2, True), (30.0, 2, False), (None, 2, False)],
)
def test_who_could_preempt_it_is_told_that_it_is_protected(
    protected_from: float | None, priority: int, *, protected: bool
) -> None:
    end = rf"until {CLOCK} \(1 min\)"
    until = f"protected from preemption {end}" if protected else f"{end} at the latest"
    assert re.search(rf"priority 1, since {CLOCK} \(40 s\), {until}$", hold_text(hold(protected_from), priority))
    assert hold_json(hold(protected_from))["protected_from"] == protected_from
