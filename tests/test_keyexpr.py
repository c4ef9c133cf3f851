"""Needs by pattern are read as Zenoh reads key expressions."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from tests.surface import interfaces
from zscout.keyexpr import ACCESS, BadName, check_need, is_pattern, matcher

ROOT = Path(__file__).parent.parent

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
        "*", "**", "robot/**", "robot/*/x", "/*", "robot/", "robot/a*", "robot/*a", "robot/**a", "robot/*#0",
        "robot/*#", "robot/*#100", "robot/*#1#2", "robot/a#2", "robot/$*?", "robot/$*", "robot/$*$*", "robot/a$*$*",
        "$*/a", "robot/* ", "robot/$*\n", "robot/" + "a" * 65 + "$*",
    ],
)  # fmt: skip
def test_what_is_no_need(need: str) -> None:
    with pytest.raises(BadName):
        check_need(need)


def test_no_key_is_without_a_rule() -> None:
    """Whatever this fleet has as a key lies within a row of the access rules."""
    rows = [zenoh.KeyExpr("zscout/FLEET/" + row.key.format(by="*", at="*", rc="*/*")) for row in ACCESS]
    for key in interfaces.keys(closed=True):
        if not key.startswith("zscout/FLEET/alive/*") and key not in ("zscout/FLEET", "zscout/FLEET/**"):
            assert any(row.includes(zenoh.KeyExpr(key)) for row in rows), f"{key} has no rule in keyexpr.ACCESS"


def test_every_row_of_the_protocols_table_has_its_rule_and_no_other() -> None:
    document = (ROOT / "docs" / "protocol" / "keys.md").read_text()
    table = set(re.findall(r"^\| `zscout/<fleet>/([^`]*)` \|", document, re.MULTILINE))
    places = {"<kind>/<name>": "{rc}", "<host>": "*", "<client>": "*", "<role>": "*", "<instance>": "*"}
    told = set()
    for key in table - {"alive/<host>/<role>/<name>/<instance>"}:
        for word, place in places.items():
            key = key.replace(word, place)
        told.add(key)
    rules = {re.sub(r"\{(by|at)\}", "*", row.key) for row in ACCESS if not row.show}
    plain = {"host/*/component", "placer/component"}
    assert told - plain == rules
