"""What people ask journals for, and how what they tell is shown."""

from __future__ import annotations

import sys

import pytest

from tests.services.journal.kit import past
from zscout.cli import journals
from zscout.config.strict import BadInput
from zscout.messages import UNHEARD, History, JournalGap, ReasonParty, Who
from zscout.services.journal.asking import FleetHistory
from zscout.services.journal.merging import Span


def test_times_ago_are_durations_or_dates() -> None:
    assert journals.parse_past("7d", "--since") == 7 * 86_400
    assert journals.parse_past("2020-01-01T00:00:00+00:00", "--since") > 5 * 365 * 86_400
    assert journals.parse_past("2999-01-01", "--until") == 0
    with pytest.raises(BadInput, match="too far back"):
        journals.parse_past("1900-01-01", "--since")


def test_a_user_is_what_is_proven_or_what_was_told() -> None:
    hold = past(1, 10.0, client="ada/one", who=Who("alice"))
    assert journals.person(hold, proven=False) == "alice"
    assert journals.person(hold, proven=True) == "ada"
    assert journals.person(past(1, 10.0, client="ada/one"), proven=False) == "ada"


def test_yesterday_is_the_midnight_before_today() -> None:
    today, yesterday = journals.parse_past("today", "--since"), journals.parse_past("yesterday", "--since")
    assert 0 <= today <= 25 * 3600
    assert 23 * 3600 <= yesterday - today <= 25 * 3600 + 1


def test_an_end_in_words() -> None:
    by = ReasonParty("i", "take", "desk/two", 10, Who("bob"))
    assert journals.ending(past(1, 10.0)) == "in force"
    assert journals.ending(past(1, 10.0, 20.0, UNHEARD)) == "end not seen"
    assert journals.ending(past(1, 10.0, 20.0, "preempted", by=by)) == "preempted by take of bob"
    nameless = ReasonParty("i", "take", "desk/two", 10, Who())
    assert journals.ending(past(1, 10.0, 20.0, "preempted", by=nameless)) == "preempted by take of desk"


def test_what_is_not_known_is_told_with_why() -> None:
    anvil = History("anvil", 200.0, 50.0, gaps=[JournalGap(120.0, 140.0, "off"), JournalGap(130.0, 135.0, "silent")])
    bellows = History("bellows", 200.0, 130.0)
    told = FleetHistory(Span(100.0, 200.0), [], False, {"anvil": anvil, "bellows": bellows}, ["forge"])
    assert told.unknown == [Span(120.0, 130.0)]
    first, second = journals.remarks(told)
    assert first.endswith("the journals are incomplete: anvil did not run; bellows has no entries of that time")
    assert second == "no journal of forge: off, older than 0.3.0, or too slow"


def test_no_spreadsheet_computes_what_others_wrote(capsys: pytest.CaptureFixture[str]) -> None:
    journals.print_csv(["arc", "held"], [["=cmd()", 1.5], ["two\nlines", -1.0]])
    sys.stdout.flush()
    assert capsys.readouterr().out == "arc,held\n'=cmd(),1.5\ntwo lines,-1.0\n"
