"""The groups of a fleet with fair shares, as `zscout status` shows them."""

from __future__ import annotations

from zscout.cli.fleet.status import shares, shares_table


def test_the_group_that_goes_first_stands_first() -> None:
    found = shares({"legs": 300.0, "arms": 1500.0, "bob": 200.0}, {"arms": 10.0})
    assert [one["group"] for one in found] == ["arms", "bob", "legs"]
    assert shares_table(found).lines() == [
        "Shares",
        "GROUP  DEVICE-SECONDS  PART    WEIGHT",
        "arms   1,500           75.0 %  10",
        "bob    200             10.0 %  1",
        "legs   300             15.0 %  1",
    ]


def test_without_fair_shares_there_is_nothing_to_show() -> None:
    assert shares_table(shares({}, {})).rows == []
