"""What several journals tell, as one: holds once, and only what none of them knows is unknown."""

from __future__ import annotations

from tests.services.journal.kit import past
from zscout.messages import UNHEARD, History, JournalGap
from zscout.services.journal.merging import Span, enough, merged, unknown_to, unknown_to_all

WINDOW = Span(100.0, 200.0)


def journal(since: float | None, *gaps: JournalGap) -> History:
    return History("x", 200.0, since, gaps=[*gaps])


def test_a_hold_is_told_once_by_who_knows_most() -> None:
    whole = past(1, 100.0, 110.0, "completed")
    for worse in (
        past(1, 90.0, 95.0, UNHEARD),
        past(1, 100.0),
        past(1, 100.0, 110.0, "completed", late=True),
        past(1, 100.0, 110.0, "completed", waited=None),
    ):
        assert merged([[worse], [whole]]) == merged([[whole], [worse]]) == [whole]
    # Who hears that it stands knows more than who was away.
    assert merged([[past(1, 100.0, 105.0, UNHEARD)], [past(1, 100.0)]]) == [past(1, 100.0)]


def test_of_what_was_used_the_most_is_told_whoever_heard_it() -> None:
    one = past(1, 100.0, 110.0, "completed", used={"robot/a": 3.0, "robot/b": 1.0})
    other = past(1, 100.5, 105.0, UNHEARD, used={"robot/a": 2.0, "robot/c": 0.0})
    told = past(1, 100.0, 110.0, "completed", used={"robot/a": 3.0, "robot/b": 1.0, "robot/c": 0.0})
    assert merged([[one], [other]]) == merged([[other], [one]]) == [told]
    assert merged([[past(1, 100.0)], [past(1, 100.0)]])[0].used == {}


def test_holds_stand_in_the_order_in_which_they_began() -> None:
    first, second, third = past(3, 100.0), past(1, 101.0), past(2, 102.0)
    assert merged([[third, first], [second]]) == [first, second, third]


def test_what_a_journal_does_not_know() -> None:
    off, silent = JournalGap(120.0, 130.0, "off"), JournalGap(125.0, 140.0, "silent")
    assert unknown_to(journal(None), WINDOW) == [WINDOW]
    assert unknown_to(journal(50.0), WINDOW) == []
    assert unknown_to(journal(110.0, off, silent), WINDOW) == [Span(100.0, 110.0), Span(120.0, 140.0)]
    assert unknown_to(journal(0.0, JournalGap(10.0, 20.0, "off"), JournalGap(190.0, None, "silent")), WINDOW) == [
        Span(190.0, 200.0)
    ]


def test_only_what_all_missed_is_unknown() -> None:
    one = journal(50.0, JournalGap(120.0, 140.0, "off"))
    other = journal(110.0, JournalGap(130.0, 150.0, "off"))
    assert unknown_to_all([one, other], WINDOW) == [Span(130.0, 140.0)]
    assert unknown_to_all([], WINDOW) == [WINDOW]


def test_no_more_journals_are_read_than_know_anything_more() -> None:
    whole, worse = journal(50.0), journal(150.0)
    assert enough({"a": worse, "b": whole, "c": whole}, WINDOW) == ["b"]
    left, right = journal(50.0, JournalGap(150.0, 200.0, "off")), journal(140.0)
    assert enough({"a": worse, "left": left, "right": right}, WINDOW) == ["right", "left"]
    assert enough({"a": journal(None)}, WINDOW) == ["a"]
