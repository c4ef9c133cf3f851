"""The core, one promise at a time: what no transcript shows, and random runs would bury."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import TypeVar

import pytest

from tests.scheduling.validate import validate
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    QUANTUM,
    ArcRequest,
    Cancelled,
    Effect,
    Granted,
    HoldEnded,
    LeadTaken,
    Propose,
    RcJoined,
    RcLost,
    RcReported,
    RecoveredHold,
    Released,
    Requested,
    Tick,
    Vote,
    VoteOverdue,
    WakeAt,
)
from zscout.types import SECOND, Grant, Params, Place, Term

SomeEffect = TypeVar("SomeEffect", bound=Effect)
OVERDUE = SECOND // 4


def request(
    arc: str,
    *needs: str,
    priority: int = 0,
    seconds: int = 10,
    keep: bool = False,
    params: Mapping[str, Params] | None = None,
) -> ArcRequest:
    shares: dict[str, Params] = {need: {} for need in needs} | dict(params or {})
    return ArcRequest(arc, f"host/{arc}", shares, priority, seconds * SECOND, keep)


def core_with(*exclusive: str, sharable: Sequence[str] = ()) -> Core:
    core = Core()
    core.handle(0, *[RcJoined(rc, sharable=False) for rc in exclusive])
    core.handle(0, *[RcJoined(rc, sharable=True) for rc in sharable])
    return core


def only(kind: type[SomeEffect], effects: list[Effect]) -> list[SomeEffect]:
    return [effect for effect in effects if isinstance(effect, kind)]


def granted(effects: list[Effect]) -> list[str]:
    return [effect.arc for effect in only(Granted, effects)]


def question(effects: list[Effect]) -> int:
    """The number of the one proposal among the effects."""
    (proposal,) = only(Propose, effects)
    return proposal.proposal


# Slow voters


def test_while_one_rc_does_not_answer_another_is_asked() -> None:
    core = core_with("robot/a", "robot/c", sharable=["radio/slow", "radio/quick"])
    core.handle(0, Requested(request("important", "robot/a", "radio/slow", priority=9)))
    asked = core.handle(0, Requested(request("voted", "robot/c", "radio/quick")))
    assert granted(core.handle(0, Vote(question(asked), accept=True))) == ["voted"]


def test_an_rc_that_always_answers_late_is_heard_all_the_same() -> None:
    core = core_with(sharable=["radio/0"])
    first = question(core.handle(0, Requested(request("a", "radio/0"))))
    core.handle(OVERDUE, VoteOverdue(first))
    second = question(core.handle(OVERDUE + QUANTUM, Tick()))
    assert second != first
    assert granted(core.handle(OVERDUE + QUANTUM + 1, Vote(first, accept=True))) == ["a"]
    assert core.handle(OVERDUE + QUANTUM + 2, Vote(second, accept=True)) == []
    validate(core)


def test_a_silent_rc_is_asked_once_a_quantum() -> None:
    core = core_with(sharable=["radio/0"])
    core.handle(0, VoteOverdue(question(core.handle(0, Requested(request("a", "radio/0"))))))
    questions = sum(len(only(Propose, core.handle(step * QUANTUM // 10, Tick()))) for step in range(1, 51))
    assert questions == 5
    assert len(core._votes.proposals) <= 8


def test_who_is_blocked_only_by_what_an_open_visit_would_free_keeps_its_place() -> None:
    core = core_with("robot/a", "robot/b", "robot/c", sharable=["radio/0"])
    core.handle(0, Requested(request("v", "robot/a", "robot/b", priority=5)))
    asked = core.handle(1, Requested(request("top", "robot/a", "radio/0", priority=9)))
    core.handle(1, Requested(request("next", "robot/b", "robot/c", priority=5)))
    # Its equal must not take robot/c before it: equal priority would never give it back.
    assert granted(core.handle(1, Requested(request("last", "robot/c", priority=5)))) == []
    assert granted(core.handle(1, Vote(question(asked), accept=True))) == ["top", "next"]


# Votes


def test_what_was_accepted_stands_for_every_subset_and_is_not_asked_again() -> None:
    core = core_with(sharable=["radio/0"])
    asked = core.handle(0, Requested(request("a", "radio/0")))
    core.handle(0, Vote(question(asked), accept=True))
    asked = core.handle(0, Requested(request("b", "radio/0")))
    (proposal,) = only(Propose, asked)
    assert set(proposal.holders) == {"a", "b"}
    core.handle(0, Vote(proposal.proposal, accept=True))
    core.handle(1, RcReported("radio/0", ended=("a", "b")))
    assert sorted(core._state.running) == ["a", "b"], "queued again and granted without a question"
    # With a gone for good, what was accepted of both stands of b.
    core.handle(2, Released("a"))
    assert granted(core.handle(2, RcReported("radio/0", ended=("b",)))) == ["b"]


def test_an_answer_to_a_question_that_became_void_changes_nothing() -> None:
    core = core_with(sharable=["radio/0"])
    asked = core.handle(0, Requested(request("a", "radio/0")))
    core.handle(0, Cancelled("a"))
    assert core.handle(0, Vote(question(asked), accept=True)) == []
    asked = core.handle(0, Requested(request("b", "radio/0")))
    anew = core.handle(0, RcReported("radio/0", rules_changed=True))
    assert core.handle(0, Vote(question(asked), accept=True)) == []
    assert granted(core.handle(0, Vote(question(anew), accept=True))) == ["b"]


def test_the_same_name_asked_anew_with_other_parameters_is_voted_on_anew() -> None:
    core = core_with(sharable=["radio/0"])
    light, heavy = ({"radio/0": {"rate": Fraction(rate)}} for rate in (1, 9))
    core.handle(0, Vote(question(core.handle(0, Requested(request("a", params=light)))), accept=True))
    core.handle(1, Released("a"))
    (proposal,) = only(Propose, core.handle(2, Requested(request("a", params=heavy))))
    assert proposal.holders == {"a": {"rate": Fraction(9)}}


# Holds and time


def test_asking_again_and_releasing_the_unknown_change_nothing() -> None:
    core = core_with("robot/a")
    core.handle(0, Requested(request("a", "robot/a")))
    assert core.handle(0, Requested(request("a", "robot/a", priority=9))) == []
    assert core.handle(0, Released("nobody"), Cancelled("nobody"), VoteOverdue(7), Vote(8, accept=True)) == []
    assert core._state.running["a"].request.priority == 0


def test_time_must_not_go_backwards() -> None:
    core = core_with("robot/a")
    core.handle(5, Tick())
    with pytest.raises(ValueError, match="backwards"):
        core.handle(4, Tick())


def test_the_wake_up_is_the_end_of_a_hold_or_the_quantum_while_anything_waits() -> None:
    core = core_with("robot/a")
    assert [wake.at for wake in only(WakeAt, core.handle(0, Requested(request("a", "robot/a"))))] == [10 * SECOND]
    assert [wake.at for wake in only(WakeAt, core.handle(0, Requested(request("b", "robot/a"))))] == [QUANTUM]
    late = 10 * SECOND - QUANTUM // 2
    assert [wake.at for wake in only(WakeAt, core.handle(late, Tick()))] == [10 * SECOND]
    core.handle(late, Cancelled("a"), Cancelled("b"))
    assert [wake.at for wake in only(WakeAt, core.handle(late, RcLost("robot/a")))] == []


# Taking the lead

OLD, NEW = Term(1, "rcm/a"), Term(2, "rcm/b")


def standing(wanted: ArcRequest, seq: int, *, start: int = 0, place: int = 1) -> RecoveredHold:
    return RecoveredHold(wanted, Place(OLD, place), Grant(OLD, seq), start, start + wanted.min_runtime)


def test_of_two_that_claim_one_exclusive_rc_the_newer_grant_stands() -> None:
    core = Core()
    older = standing(request("older", "robot/a"), 3)
    newer = standing(request("newer", "robot/a"), 4, place=2)
    effects = core.handle(0, RcJoined("robot/a", sharable=False), LeadTaken(NEW, (older, newer)))
    assert [gone.arc for gone in only(HoldEnded, effects)] == ["older"]
    assert sorted(core._state.running) == ["newer"]
    validate(core)


def test_a_lead_is_only_taken_in_a_higher_term() -> None:
    core = Core()
    core.handle(0, LeadTaken(NEW))
    with pytest.raises(ValueError, match="not above"):
        core.handle(0, LeadTaken(OLD))
