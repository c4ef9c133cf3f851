"""What becomes of what a candidate hears: holds, their ends, and what it missed."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

from tests.services.journal.kit import LATER, TERM, grant, heard, holder, over, published
from zscout.messages import HoldView, JournalGap, RcmState, ReasonInfo, ReasonParty
from zscout.services.journal.follower import (
    MAX_EARLY,
    Change,
    ClockSet,
    EndMissed,
    Follower,
    GapSeen,
    HoldOver,
    HoldSeen,
    HoldUsed,
    Observation,
    StateRead,
    UseReported,
)
from zscout.types import Grant, Place, Term

SILENT = 2.0


def told(follower: Follower, *events: Observation) -> list[Change]:
    return [change for event in events for change in follower.take(event)]


def state(seq: int, *grants: Grant, term: Term = TERM) -> RcmState:
    place, needs = Place(term, 1), {"robot/a": dict[str, Decimal]()}
    views = [HoldView(f"id-{one.seq}", "x", "desk/one", 5, one, place, needs, Decimal(60), 7.0, 1.0) for one in grants]
    return RcmState(term, seq, "anvil", views)


def reads(follower: Follower) -> bool:
    return follower.must_read


def gaps(changes: list[Change]) -> list[JournalGap]:
    return [change.gap for change in changes if isinstance(change, GapSeen)]


def test_a_hold_from_its_grant_to_its_end() -> None:
    follower = Follower(SILENT)
    gang = holder(1, "radio/rf0", "robot/a")
    by = ReasonParty("id-take", "take", "desk/two", 10)
    why = ReasonInfo("preempted", by=[by])
    ended = over(1, "preempted", "radio/rf0", "robot/a", by="desk/two/id-take", why=why)
    seen, end = told(
        follower, heard(100.0, published(1, [gang], begun={1: 3.5})), heard(107.0, published(2, revoked=[ended]))
    )
    assert isinstance(seen, HoldSeen)
    assert isinstance(end, HoldOver)
    assert (seen.hold.began, seen.hold.late, seen.hold.waited, seen.hold.priority) == (100.0, False, 3.5, 5)
    assert (seen.hold.rcs, seen.hold.min_runtime) == (["radio/rf0", "robot/a"], 60.0)
    assert seen.hold.who is not None
    assert (seen.hold.who.user, seen.hold.who.command) == ("alice", "./survey.py")
    assert (end.hold.grant, end.hold.ended, end.hold.outcome, end.hold.by) == (grant(1), 107.0, "preempted", by)
    assert (end.hold.code, end.hold.own) == ("preempted", False)


def test_an_rcm_that_does_not_tell_of_waits_is_heard_all_the_same() -> None:
    (seen,) = told(Follower(SILENT), heard(100.0, published(1, [holder(1, "robot/a")])))
    assert isinstance(seen, HoldSeen)
    assert (seen.hold.waited, seen.hold.late) == (None, False)


def test_who_is_named_again_beside_another_is_no_new_hold() -> None:
    follower = Follower(SILENT)
    first, second = holder(1, "radio/rf0"), holder(2, "radio/rf0", arc="map")
    changes = told(follower, heard(100.0, published(1, [first])), heard(101.0, published(2, [first, second])))
    assert [change.hold.grant.seq for change in changes if isinstance(change, HoldSeen)] == [1, 2]


def test_a_hold_of_before_is_known_to_be_older() -> None:
    (seen,) = told(Follower(SILENT), heard(100.0, published(9, [holder(3, "robot/a")])))
    assert isinstance(seen, HoldSeen)
    assert seen.hold.late


def test_numbers_that_are_missing_are_a_gap_and_the_state_is_read() -> None:
    follower = Follower(SILENT)
    told(follower, heard(100.0, published(1, [holder(1, "robot/a"), holder(1, "robot/b", arc="b")])))
    told(follower, StateRead(100.1, state(1, grant(1))))
    assert not reads(follower)
    changes = told(follower, heard(105.0, published(5, [holder(5, "robot/c", arc="c")], prev=4), 0.4))
    assert gaps(changes) == [JournalGap(104.6, 105.0, "missed", 3)]
    assert reads(follower)
    # Of before the publication that was heard: read again.
    assert told(follower, StateRead(105.1, state(4))) == []
    assert reads(follower)
    ended, seen = told(follower, StateRead(106.0, state(6, grant(5), grant(6))))
    assert ended == EndMissed(grant(1), 104.6)
    assert isinstance(seen, HoldSeen)
    assert (seen.hold.grant, seen.hold.began, seen.hold.waited) == (grant(6), 99.0, None)
    assert not reads(follower)
    # What was published before the state was read is heard behind it: it corrects.
    (late,) = told(follower, heard(106.1, published(6, revoked=[over(1, "released", "robot/a")], prev=5)))
    assert isinstance(late, HoldOver)


def test_silence_is_a_gap_and_a_takeover_within_a_lease_is_none() -> None:
    follower = Follower(SILENT)
    told(follower, heard(100.0, published(7)), StateRead(100.1, state(7)))
    assert gaps(told(follower, heard(101.5, published(0, prev=0, term=LATER), 1.5))) == []
    assert reads(follower)
    told(follower, StateRead(101.6, state(0, term=LATER)))
    assert gaps(told(follower, heard(111.5, published(1, term=LATER), 10.0))) == [JournalGap(101.5, 111.5, "silent")]
    assert reads(follower)


def test_a_new_term_whose_first_words_were_not_heard_is_a_gap() -> None:
    follower = Follower(SILENT)
    told(follower, heard(100.0, published(7)))
    assert gaps(told(follower, heard(101.5, published(4, term=LATER), 1.5))) == [JournalGap(100.0, 101.5, "missed", 3)]


def test_what_a_former_rcm_says_is_nothing() -> None:
    follower = Follower(SILENT)
    told(follower, heard(100.0, published(1, term=LATER)))
    assert told(follower, heard(101.0, published(9, [holder(9, "robot/a")]))) == []
    assert told(follower, StateRead(101.0, state(9, grant(9)))) == []


def test_a_restart_is_a_gap_and_what_stood_then_may_be_over() -> None:
    follower = Follower(SILENT, [grant(1), grant(2)], heard=90.0)
    changes = told(follower, heard(100.0, published(8)))
    assert gaps(changes) == [JournalGap(90.0, 100.0, "off")]
    assert told(follower, StateRead(100.5, state(8, grant(2)))) == [EndMissed(grant(1), 90.0)]
    assert gaps(told(follower, heard(100.6, published(9)))) == []


def test_a_new_journal_begins_without_a_gap() -> None:
    follower = Follower(SILENT)
    assert told(follower, heard(100.0, published(50))) == []
    assert reads(follower)


def test_what_was_dropped_is_a_gap() -> None:
    follower, gap = Follower(SILENT), JournalGap(100.0, 101.0, "dropped", 7)
    assert [*follower.lost(gap)] == [GapSeen(gap)]
    assert reads(follower)


def test_hostile_publications_are_cut_or_ignored() -> None:
    follower = Follower(SILENT)
    assert told(follower, heard(1.0, published(2**70))) == []
    assert told(follower, heard(1.0, published(1, [holder(2**64, "robot/a")]))) == []
    evil = holder(2, *(f"robot/{number}\n" for number in range(5_000)), arc="x\x1b[2J" + "y" * 10_000)
    (seen,) = told(follower, heard(1.0, published(2, [evil])))
    assert isinstance(seen, HoldSeen)
    assert len(seen.hold.arc) == 200
    assert seen.hold.arc.isprintable()
    assert len(seen.hold.rcs) == 1_000
    assert all(rc.isprintable() for rc in seen.hold.rcs)
    far: Any = published(2**60, prev=2**60 - 1)
    (gap,) = gaps(told(follower, heard(2.0, far)))
    assert gap.count == 10**9


def test_use_of_a_hold_that_is_followed_and_of_one_that_is_over() -> None:
    follower = Follower(SILENT)
    told(follower, heard(100.0, published(1, [holder(1, "robot/a")])))
    assert told(follower, UseReported([("robot/a", grant(1), 2.5)])) == [HoldUsed(grant(1), "robot/a", 2.5)]
    told(follower, heard(107.0, published(2, revoked=[over(1, "released", "robot/a")])))
    assert told(follower, UseReported([("robot/a", grant(1), 4.0)])) == [HoldUsed(grant(1), "robot/a", 4.0)]


def test_use_that_is_heard_before_its_hold_is_told_again_behind_it() -> None:
    follower = Follower(SILENT)
    told(follower, heard(100.0, published(1)), StateRead(100.1, state(1)))
    words = [("robot/a", grant(number), float(number)) for number in (2, 3, 4)]
    told(follower, UseReported([*words, ("robot/b", grant(2), 9.0)]))
    _, used = told(follower, heard(101.0, published(2, [holder(2, "robot/a")])))
    assert used == HoldUsed(grant(2), "robot/a", 2.0)
    over_too = over(3, "released", "robot/a")
    assert told(follower, heard(102.0, published(4, revoked=[over_too], prev=2)))[1:] == [
        HoldUsed(grant(3), "robot/a", 3.0)
    ]
    told(follower, heard(103.0, published(9, prev=8)))
    assert told(follower, StateRead(104.0, state(9, grant(2), grant(4))))[1:] == [HoldUsed(grant(4), "robot/a", 4.0)]
    # Once it is known, nothing of it is kept.
    assert told(follower, heard(105.0, published(10, revoked=[over(4, "released", "robot/a")], prev=9)))[1:] == []


def test_absurd_words_on_use_are_nothing_and_early_ones_are_bounded() -> None:
    follower = Follower(SILENT)
    for seconds in (-1.0, float("nan"), float("inf"), 1e12):
        assert told(follower, UseReported([("robot/a", grant(1), seconds)])) == []
    assert told(follower, UseReported([("robot/a", grant(2**64), 1.0)])) == []
    told(follower, UseReported([("robot/a", grant(number), 1.0) for number in range(MAX_EARLY + 1)]))
    assert len(told(follower, heard(100.0, published(1, [holder(0, "robot/a")])))) == 1
    assert len(told(follower, heard(100.1, published(2, [holder(1, "robot/a")])))) == 2


def test_what_is_in_doubt_moves_with_the_clock() -> None:
    follower = Follower(SILENT)
    told(follower, heard(100.0, published(1, [holder(1, "robot/a")])), heard(105.0, published(3), silence=5.0))
    assert told(follower, ClockSet(259_200.0)) == [ClockSet(259_200.0)]
    assert told(follower, StateRead(259_306.0, state(3))) == [EndMissed(grant(1), 259_300.0)]
