"""An ARC makes only the moves of the table; every reason has a text and stands in the protocol."""

from __future__ import annotations

import itertools
import re

import pytest

from tests.protocol_pages import read_page
from zscout.scheduling.model import TRANSITIONS, Arc, ArcRequest, ArcState
from zscout.scheduling.reason import Party, Reason, ReasonCode
from zscout.types import NO_TERM, SECOND, Place

PROTOCOL = read_page("messages")


def arc_in(state: ArcState) -> Arc:
    arc = Arc(ArcRequest("a", "h/c", {"robot/a": {}}, 1, SECOND), Place(NO_TERM, 1), 1)
    arc.state = state
    return arc


def test_a_move_that_is_not_in_the_table_raises() -> None:
    for before, after in itertools.product(ArcState, ArcState):
        arc = arc_in(before)
        if after in TRANSITIONS[before]:
            arc.move_to(after)
            assert arc.state is after
            continue
        with pytest.raises(ValueError, match=f"ARC a is {before} and can't become {after}"):
            arc.move_to(after)
        assert arc.state is before


def test_nothing_comes_back_from_its_end() -> None:
    assert not TRANSITIONS[ArcState.ENDED]
    assert TRANSITIONS.keys() == set(ArcState)


@pytest.mark.parametrize("code", ReasonCode)
def test_every_reason_has_a_text_and_is_documented(code: ReasonCode) -> None:
    reason = Reason(code, ("robot/a",), (Party("h/c/b", "b", 7),), detail="own words", number=1)
    assert re.fullmatch(r"[a-z].+[^.]", str(reason).replace("own words", "its own words"))
    if code not in (ReasonCode.HELD, ReasonCode.VETOED):
        assert str(reason._replace(pattern="robot/*")) == f"no robot/* is to be had: {reason}"
    section = PROTOCOL[PROTOCOL.index("### ReasonInfo") : PROTOCOL.index("### ReasonParty")]
    assert f"`{code}`" in section
