"""Records of bookings, merged one by one: in whatever order, and however often, all come to know the same."""

from __future__ import annotations

from decimal import Decimal
from itertools import permutations
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from zscout.messages import BookingRecord
from zscout.services.bookings.dates import DAY
from zscout.services.bookings.records import KEEP, Records, merged
from zscout.types import Grant, Term

START = 1_800_000_000
DATES = st.lists(st.sampled_from([START + day * DAY for day in range(4)]), unique=True).map(sorted)
GRANTS = st.builds(lambda counter, seq: Grant(Term(counter, "x"), seq), st.integers(0, 2), st.integers(0, 3))


def record(**changes: Any) -> BookingRecord:
    return BookingRecord("b", "b", {"robot/a": {}}, 0, START, Decimal(60), Decimal(60), **changes)


RECORDS = st.builds(
    record,
    made=GRANTS,
    changed=GRANTS,
    unbooked=st.booleans(),
    dropped=DATES,
    over=DATES,
    kept=st.dictionaries(st.just(START), st.fixed_dictionaries({"robot/*": st.sampled_from(["robot/a", "robot/b"])})),
)


@given(RECORDS, RECORDS, RECORDS)
def test_the_order_of_merging_does_not_matter(one: BookingRecord, two: BookingRecord, three: BookingRecord) -> None:
    assert merged(one, two) == merged(two, one)
    assert merged(merged(one, two), three) == merged(one, merged(two, three))
    assert merged(one, one) == one
    assert merged(merged(one, two), two) == merged(one, two)


@given(RECORDS, RECORDS)
def test_what_is_final_stays(one: BookingRecord, two: BookingRecord) -> None:
    both = merged(one, two)
    assert both.unbooked == (one.unbooked or two.unbooked)
    assert {*both.dropped} == {*one.dropped, *two.dropped}
    assert {*both.over} == {*one.over, *two.over}
    assert both.made == min(one.made, two.made)


@given(st.lists(RECORDS, max_size=3))
def test_who_heard_the_same_has_the_same_digest(told: list[BookingRecord]) -> None:
    digests = set()
    for order in permutations(told):
        records = Records()
        for one in (*order, *order):
            records.take([one])
        digests.add(records.digest())
    assert len(digests) == 1


def test_only_what_is_new_is_told_as_changed_and_what_is_long_over_is_forgotten() -> None:
    records = Records()
    assert records.take([record()]) == [record()]
    assert records.take([record()]) == []
    assert records.take([record(unbooked=True)]) == [record(unbooked=True)]
    assert records.take([record()]) == []
    assert not records.forget_old(START + 60 + KEEP)
    assert records.forget_old(START + 61 + KEEP)
    assert (len(records), records.size, records.digest()) == (0, 0, Records().digest())
