"""Handing over in the core: what goes along, what does not, and what a change of RCM leaves behind."""

from __future__ import annotations

from fractions import Fraction

import pytest

from tests.scheduling.test_core import core_with, granted, only, question, request
from tests.scheduling.validate import validate
from zscout.scheduling.model import (
    HandedOver,
    HoldEnded,
    LeadTaken,
    Outcome,
    Propose,
    RecoveredHold,
    Released,
    Requested,
    Tick,
    Vote,
)
from zscout.types import SECOND, Grant, Params, Place, Term


def test_votes_go_with_an_arc_that_is_handed_over() -> None:
    core = core_with(sharable=["radio/0"])
    shares: dict[str, Params] = {"radio/0": {"rate": Fraction(1)}}
    first = core.handle(0, Requested(request("one", params=shares)))
    core.handle(0, Vote(question(first), accept=True))
    asked = core.handle(0, Requested(request("two", params=shares)))
    # While the vote on both is out, both move. No question is asked anew, and the answer still counts.
    moved = core.handle(1, HandedOver("one", "host/new", "one-2"), HandedOver("two", "host/new", "two-2"))
    assert not only(Propose, moved)
    answered = core.handle(2, Vote(question(asked), accept=False, reason="full"))
    assert not granted(answered)
    assert str(core.status().queued[0].reason) == "waits for one-2: radio/0 refuses more: full"
    # So does the veto after another move: what frees the way is the end of the one beside it.
    again = core.handle(3, HandedOver("one-2", "host/third", "one-3"), HandedOver("two-2", "host/third", "2"))
    assert not only(Propose, again)
    ended = core.handle(4, Released("one-3"))
    assert [sorted(proposal.holders) for proposal in only(Propose, ended)] == [["2"]]
    assert granted(core.handle(4, Vote(question(ended), accept=True))) == ["2"]
    validate(core)


def test_one_arc_that_two_clients_tell_of_is_one_again_after_the_hand_over() -> None:
    """A change of RCM in the middle: it hears of the ARC from both clients, once or twice as a hold."""
    shared = Place(Term(1, "old"), 7)
    for old_runs, new_runs in ((False, False), (True, False), (False, True), (True, True)):
        core = core_with("robot/a" if old_runs else "robot/b", sharable=["radio/0"])
        standing, waiting = [], []
        for arc, runs, seq in (("old/x", old_runs, 1), ("new/x", new_runs, 2)):
            wanted = request(arc, "radio/0" if runs else "robot/absent")
            if runs:
                standing.append(RecoveredHold(wanted, shared, Grant(Term(1, "old"), seq), 0, 10 * SECOND))
            else:
                waiting.append(Requested(wanted, shared))
        core.handle(0, LeadTaken(Term(2, "now"), tuple(standing), tuple(waiting)))
        core.handle(1, HandedOver("old/x", "new", "new/x"))
        validate(core)
        arcs = {**core._state.running, **core._state.queued}
        assert list(arcs) == ["new/x"], (old_runs, new_runs)
        assert (arcs["new/x"].hold is not None) == (old_runs or new_runs)
        assert arcs["new/x"].place == shared


def test_a_hand_over_takes_nothing_from_another_arc_of_that_name() -> None:
    core = core_with("robot/a", "robot/b")
    core.handle(0, Requested(request("mine", "robot/a")), Requested(request("theirs", "robot/b")))
    assert not only(HoldEnded, core.handle(1, HandedOver("mine", "host/theirs", "theirs")))
    assert core._state.running.keys() == {"mine", "theirs"}


@pytest.mark.parametrize("keep", [False, True])
def test_what_is_handed_over_ends_when_it_would_have(keep: bool) -> None:
    core = core_with("robot/a")
    core.handle(0, Requested(request("one", "robot/a", keep=keep)), Requested(request("two", "robot/a")))
    at = 9 * SECOND
    core.handle(at, HandedOver("one", "host/b", "one-b"))
    core.handle(at, HandedOver("one-b", "host/a", "one"))
    ended = core.handle(10 * SECOND, Tick())
    assert [(one.arc, one.outcome) for one in only(HoldEnded, ended)] == [("one", Outcome.COMPLETED)]
    assert granted(ended) == ["two"]
