"""Needs by pattern are read as Zenoh reads key expressions."""

from __future__ import annotations

import re

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from zscout.keyexpr import BadName, check_need, is_pattern, matcher

RCS = ["robot/a", "robot/ab", "robot/aab", "robot/b", "radio/a", "a/a", "a.b/a-b", "aa/b_1"]
CHUNKS = st.lists(st.sampled_from(["a", "b", "aa", "$*", "robot", ".", "-"]), min_size=1, max_size=4).map(
    # Zenoh itself panics at two in a row.
    lambda parts: re.sub(r"(\$\*)+", "$*", "".join(parts))
)
PATTERNS = (
    st.tuples(CHUNKS | st.just("*"), CHUNKS | st.just("*"))
    .map("/".join)
    .filter(lambda text: is_pattern(text) and "$*" not in text.split("/"))
)


@given(PATTERNS, st.sampled_from(RCS))
def test_a_pattern_is_met_by_what_zenoh_says(pattern: str, rc: str) -> None:
    check_need(pattern)
    assert matcher(pattern)(rc) == zenoh.KeyExpr.autocanonize(pattern).includes(zenoh.KeyExpr(rc))


def test_a_pattern_of_many_parts_is_matched_at_once() -> None:
    """A regular expression would never come back: any client could stop the RCM."""
    assert not matcher("fg/" + "$*a" * 21)("fg/" + "a" * 63 + "b")


def test_a_number_only_tells_one_need_from_another() -> None:
    assert check_need("framegrabber/*#2") == "framegrabber/*#2"
    assert matcher("framegrabber/*#2")("framegrabber/fgrab1")


@pytest.mark.parametrize(
    "need",
    [
        "*",
        "**",
        "robot/**",
        "robot/*/x",
        "/*",
        "robot/",
        "robot/a*",
        "robot/*a",
        "robot/**a",
        "robot/*#0",
        "robot/*#",
        "robot/*#100",
        "robot/*#1#2",
        "robot/a#2",
        "robot/$*?",
        "robot/$*",
        "robot/$*$*",
        "robot/a$*$*",
        "$*/a",
        "robot/* ",
        "robot/$*\n",
        "robot/" + "a" * 65 + "$*",
    ],
)
def test_what_is_no_need(need: str) -> None:
    with pytest.raises(BadName):
        check_need(need)
