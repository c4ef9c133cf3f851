"""Times of day beside spans, and whose a hold is and until when, as people read them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import datetime, timedelta, tzinfo
from decimal import Decimal
from typing import Self
from zoneinfo import ZoneInfo

import msgspec
import pytest

from zscout import terminal
from zscout.cli import journals
from zscout.cli.dates import date_words
from zscout.cli.ownership import User
from zscout.cli.requests.waiting import hold_text, reason_text, whose
from zscout.messages import HoldView, ReasonInfo, ReasonParty, Who
from zscout.terminal import NEAR_S, clock
from zscout.types import Grant, Place, Term

NOW = datetime(2026, 3, 9, 14, 2, 30, 500_000)  # noqa: DTZ001 - this host's own clock
TERM = Term(1, "rcm")
DAY = 86_400


def stop_at(monkeypatch: pytest.MonkeyPatch, at: datetime) -> None:
    """Make `clock` read this time."""

    class StoppedThere(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> Self:
            return cls.fromtimestamp(at.timestamp(), tz)

    monkeypatch.setattr(terminal, "datetime", StoppedThere)


class Stopped(datetime):
    """A clock that stands."""

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> Stopped:
        return cls.fromtimestamp(NOW.timestamp(), tz)


@pytest.fixture(autouse=True)
def stopped(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Europe/Berlin")
        time.tzset()
        patch.setattr(terminal, "datetime", Stopped)
        yield
    time.tzset()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "14:02:31"),
        (-30, "14:02:01"),
        (119, "14:04:30"),
        (1800, "14:32"),
        (-600, "13:52"),
        (149.5, "14:05"),
        (149.499, "14:05"),
        (148.9, "14:04"),
        (DAY, "Mar 10 14:02"),
        (-DAY * 30, "Feb 7 14:02"),
        (DAY * 300, "2027-01-03 14:02"),
        # In between the clocks are put forward.
        (DAY * 30, "Apr 8 15:02"),
        (float("inf"), "2057-11-15 15:49"),
    ],
)
def test_a_time_of_day_by_the_readers_clock(seconds: float, text: str) -> None:
    assert clock(seconds) == text


@pytest.mark.parametrize("away", [3600, 600, 130, 119.9, 10, 0, -10, -300, -3600])
@pytest.mark.parametrize("delay", [-0.2, -0.002, 0, 0.002, 0.2])
def test_an_instant_has_one_time_before_and_after_it(
    monkeypatch: pytest.MonkeyPatch, away: float, delay: float
) -> None:
    """With hours and minutes from afar, with seconds from near, and whatever a message took on its way."""
    instant = datetime(2026, 3, 9, 14, 12)  # noqa: DTZ001 - this host's own clock
    stop_at(monkeypatch, instant - timedelta(seconds=away))
    assert clock(away + delay) == ("14:12:00" if abs(away + delay) < NEAR_S else "14:12")


@pytest.mark.parametrize("late", [-0.6, -0.2, 0, 0.2, 0.6])
def test_a_past_date_has_the_time_that_the_clock_had(late: float) -> None:
    """In the journals, in a zone and as a time of day: rounded alike."""
    ago = 1950 - late
    at = NOW.timestamp() - ago
    journal, there, here = journals.local(at), date_words(at, ZoneInfo("Europe/Berlin")), clock(-ago)
    assert journal.split()[1][:5] == there.split()[2][:5] == here


def hold(*, keep: bool, remaining: float, priority: int = 1, who: Who | None = None) -> HoldView:
    grant, place = Grant(TERM, 1), Place(TERM, 1)
    return HoldView(
        "a1", "survey", "ws1/c1", priority, grant, place, {"robot/a": {}}, Decimal(60), 600, remaining, keep, who=who
    )


ALICE = Who("alice", "", "survey.py", "night\x1b run")


@pytest.mark.parametrize(
    ("view", "priority", "text"),
    [
        (
            hold(keep=False, remaining=1800, who=ALICE),
            0,
            "survey (alice@ws1), priority 1, since 13:52 (10 min), until 14:32 (30 min) at the latest: night  run",
        ),
        (
            hold(keep=True, remaining=1800),
            1,
            "survey (ws1/c1), priority 1, since 13:52 (10 min), until 14:32 (30 min) at the latest",
        ),
        (
            hold(keep=True, remaining=1800),
            0,
            (
                "survey (ws1/c1), priority 1, since 13:52 (10 min), until 14:32 (30 min) at least, "
                "and kept for as long as it wants"
            ),
        ),
        (
            hold(keep=True, remaining=-5),
            0,
            "survey (ws1/c1), priority 1, since 13:52 (10 min), kept for as long as it wants",
        ),
        (
            hold(keep=True, remaining=-5),
            2,
            "survey (ws1/c1), priority 1, since 13:52 (10 min), its minimum runtime is over",
        ),
    ],
)
def test_whose_a_hold_is_since_and_until_when(view: HoldView, priority: int, text: str) -> None:
    assert hold_text(view, priority) == text


def test_a_reason_is_told_with_times_of_day_where_the_rcm_gave_durations() -> None:
    party = ReasonParty("a1", "survey", "ws1/c1", 1, ALICE, 1830)
    why = ReasonInfo("held", ["framegrabber/fg1"], [party], count=1)
    assert whose(party) == "alice@ws1 (survey.py)"
    assert reason_text("in words", why, age=30) == (
        "waits for survey (alice@ws1): framegrabber/fg1, until 14:32 at the latest"
    )
    # An RCM that tells less, or more than is known here.
    assert reason_text("in words", None) == "in words"
    assert reason_text("in words", ReasonInfo("another", ["robot/a"])) == "in words"
    assert reason_text("in words", ReasonInfo("held", ["robot/a", "robot/b"], [party])) == (
        "waits for survey (alice@ws1): robot/a, until 14:33 at the latest"
    )


def test_own_holds_in_the_way_are_called_so() -> None:
    me, other = User("ada", "desk"), User("bob", "desk")
    party = ReasonParty(client="desk/request-1", id="i", arc="train", priority=0, who=Who("ada", "desk", "x"))
    why = ReasonInfo(code="held", rcs=["robot/a"], by=[party], count=1)
    assert reason_text("", why, me=me) == "waits for your own request train: robot/a"
    assert reason_text("", why, me=other) == "waits for train (ada@desk): robot/a"
    assert (
        reason_text("", msgspec.structs.replace(why, code="maintenance"), me=me)
        == "maintenance of robot/a by train (ada@desk)"
    )
