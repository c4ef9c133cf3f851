"""Accounts from a list of holds, by their definitions."""

from __future__ import annotations

from collections.abc import Iterable

from tests.services.journal.kit import past
from zscout.messages import UNHEARD, PastHold
from zscout.services.journal.accounts import Account, accounts
from zscout.services.journal.merging import Span

WINDOW = Span(100.0, 200.0)


def by_arc(*holds: PastHold) -> list[Account]:
    return accounts(holds, lambda hold: [hold.arc], WINDOW)


def test_a_hold_within_the_window() -> None:
    held = past(1, 110.0, 140.0, "completed", rcs=["robot/a", "radio/b", "video/c"], waited=7.0)
    assert by_arc(held) == [Account("survey", 1, 30.0, 90.0, 7.0, used_unknown=1)]


def test_what_lies_outside_is_not_counted() -> None:
    before, after, standing = past(1, 80.0, 99.0, "lost"), past(2, 201.0), past(3, 150.0)
    across = past(4, 90.0, 130.0, "preempted", waited=50.0)
    (account,) = by_arc(before, after, standing, across)
    assert (account.holds, account.held, account.waited) == (2, 50.0 + 30.0, 0.0)
    assert (account.preempted, account.preempted_seconds, account.thrown_away) == (1, 30.0, 30.0)
    ends_later = past(5, 150.0, 210.0, "preempted", min_runtime=600.0)
    assert by_arc(ends_later) == [Account("survey", 1, 50.0, 50.0, 0.0, used_unknown=1)]


def test_thrown_away_is_what_was_taken_back_before_its_time() -> None:
    ends = ("preempted", "lost", "completed", "released", "cancelled", "client_lost", "handed_over", UNHEARD)
    for outcome in ends:
        (account,) = by_arc(past(1, 110.0, 150.0, outcome))
        assert account.thrown_away == (40.0 if outcome in ("preempted", "lost") else 0.0)
        assert account.preempted == (outcome == "preempted")
    (kept,) = by_arc(past(1, 110.0, 180.0, "lost"))
    assert kept.thrown_away == 0.0
    (command,) = by_arc(past(1, 110.0, 180.0, "preempted"))
    assert command.thrown_away == 70.0, "it was protected for longer than its minimum runtime"


def test_an_unheard_end_counts_what_is_known() -> None:
    assert by_arc(past(1, 110.0, 120.0, UNHEARD))[0].held == 10.0


def test_of_a_wait_that_is_not_told_nothing_is_counted() -> None:
    assert by_arc(past(1, 110.0, 120.0, "completed", waited=None))[0].waited == 0.0


def test_by_rc_and_by_several_keys() -> None:
    gang = past(1, 110.0, 120.0, "completed", rcs=["robot/a", "radio/b"])
    alone = past(2, 150.0, 151.0, "completed", rcs=["robot/a"])
    rows = accounts([gang, alone], lambda hold: hold.rcs, WINDOW, by_rc=True)
    assert [(row.key, row.holds, row.held, row.rc_seconds) for row in rows] == [
        ("robot/a", 2, 11.0, 11.0),
        ("radio/b", 1, 10.0, 10.0),
    ]

    def twice(_: PastHold) -> Iterable[str]:
        return ["arms", "arms", "legs"]

    assert [(row.key, row.holds) for row in accounts([gang], twice, WINDOW)] == [("arms", 1), ("legs", 1)]


def test_what_was_used_is_counted_by_rc_as_far_as_it_is_told() -> None:
    rcs = ["robot/a", "radio/b"]
    whole = past(1, 110.0, 120.0, "completed", rcs=rcs, used={"robot/a": 4.0, "radio/b": 2.5})
    some = past(2, 130.0, 140.0, "completed", rcs=rcs, used={"robot/a": 1.0})
    idle, unknown = past(3, 150.0, 160.0, used={"robot/a": 0.0}), past(4, 170.0, 180.0)
    (account,) = by_arc(whole, some, idle, unknown)
    assert (account.used, account.used_unknown) == (7.5, 2)
    rows = accounts([whole, some, idle, unknown], lambda hold: hold.rcs, WINDOW, by_rc=True)
    assert [(row.key, row.used, row.used_unknown) for row in rows] == [("robot/a", 5.0, 1), ("radio/b", 2.5, 1)]
    (nothing,) = by_arc(unknown)
    assert (nothing.used, nothing.used_unknown) == (None, 1)
    (none,) = by_arc(past(5, 150.0, 160.0, "completed", used={"robot/a": 0.0}))
    assert (none.used, none.used_unknown) == (0.0, 0)


def test_use_is_never_more_than_was_held_and_in_part_where_the_hold_is() -> None:
    absurd = past(1, 110.0, 120.0, "completed", used={"robot/a": 1e9, "robot/z": 5.0})
    half = past(2, 80.0, 120.0, "completed", used={"robot/a": 30.0})
    assert by_arc(absurd)[0].used == 10.0
    assert by_arc(half)[0].used == 15.0
    # What lies in one window or the next is all of it.
    before = accounts([half], lambda hold: [hold.arc], Span(0.0, 100.0))
    assert before[0].used == 15.0
    assert by_arc(past(3, 110.0, 110.0, "completed", used={"robot/a": 0.0}))[0].used == 0.0
