"""The core, one promise at a time: what the transcripts and the random runs would bury."""

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
    Outcome,
    Propose,
    Queued,
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


def vote_all(core: Core, effects: list[Effect]) -> list[Effect]:
    """Answers all questions at once, for RCs that carry two holders; returns all effects to the end."""
    told = list(effects)
    while questions := only(Propose, effects):
        votes = [Vote(one.proposal, accept=len(one.holders) <= 2) for one in questions]
        effects = core.handle(1, *votes)
        told += effects
    return told


# Slow voters


def test_one_slow_voter_never_stops_what_has_nothing_to_do_with_it() -> None:
    core = core_with("robot/a", "robot/b", "robot/c", sharable=["radio/slow", "radio/quick"])
    core.handle(0, Requested(request("important", "robot/a", "radio/slow", priority=9)))
    effects = core.handle(0, Requested(request("bystander", "robot/b")))
    assert granted(effects) == ["bystander"]
    asked = core.handle(0, Requested(request("voted", "robot/c", "radio/quick")))
    assert granted(core.handle(0, Vote(question(asked), accept=True))) == ["voted"]
    # What the open visit would take is off limits, and what waits for that stops lower ranks likewise.
    chained = core.handle(
        1, Requested(request("chained", "robot/a", "robot/d", priority=2)), RcJoined("robot/d", False)
    )
    behind = core.handle(1, Requested(request("behind", "robot/d", priority=1)))
    assert granted(chained) == granted(behind) == []
    validate(core)


def test_an_overdue_vote_frees_what_its_visit_kept_off_limits() -> None:
    core = core_with("robot/a", sharable=["radio/slow"])
    asked = core.handle(0, Requested(request("important", "robot/a", "radio/slow", priority=9)))
    assert granted(core.handle(0, Requested(request("modest", "robot/a")))) == []
    effects = core.handle(OVERDUE, VoteOverdue(question(asked)))
    assert granted(effects) == ["modest"]
    (wait,) = only(Queued, effects)
    assert (wait.arc, str(wait.reason)) == ("important", "radio/slow does not answer")
    # The late answer still counts.
    late = core.handle(2 * OVERDUE, Vote(question(asked), accept=True))
    assert granted(late) == ["important"]
    assert [gone.arc for gone in only(HoldEnded, late)] == ["modest"]


def test_a_lost_question_is_asked_anew_when_its_rc_answers_another() -> None:
    core = core_with(sharable=["radio/0"])
    first = core.handle(0, Requested(request("low", "radio/0")))
    core.handle(OVERDUE, VoteOverdue(question(first)))
    core.handle(OVERDUE, Requested(request("high", "radio/0", priority=1)))
    retry = core.handle(OVERDUE + QUANTUM, Tick())
    back = core.handle(OVERDUE + QUANTUM, Vote(question(retry), accept=False, reason="too much"))
    again = core.handle(OVERDUE + QUANTUM, Vote(question(back), accept=True))
    assert granted(again) == ["low"]


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


def test_what_an_open_visit_would_free_is_off_limits() -> None:
    """Were `b` let at robot/x while `a`'s votes are out, `low` would be kept where the steps evict it."""
    core = core_with("robot/x", sharable=["radio/0"])
    everybody = [
        request("mid", "robot/x", "radio/0", priority=2),
        request("low", "radio/0", priority=1),
        request("a", "radio/0", priority=9),
    ]
    # Any two of the three fit on the radio.
    out = [effect for one in everybody[:2] for effect in vote_all(core, core.handle(1, Requested(one)))]
    assert granted(out) == ["mid", "low"]
    asked = core.handle(1, Requested(everybody[2]))
    assert granted(core.handle(1, Requested(request("b", "robot/x", priority=5)))) == []
    effects = vote_all(core, asked)
    assert [(gone.arc, gone.by) for gone in only(HoldEnded, effects)] == [("low", "a"), ("mid", "b")]
    # Freed of `mid`, the radio has room again: preempted and started again in one pass.
    assert granted(effects) == ["a", "b", "low"]


def test_who_is_blocked_only_by_what_an_open_visit_would_free_keeps_its_place() -> None:
    core = core_with("robot/a", "robot/b", "robot/c", sharable=["radio/0"])
    core.handle(0, Requested(request("v", "robot/a", "robot/b", priority=5)))
    asked = core.handle(1, Requested(request("top", "robot/a", "radio/0", priority=9)))
    core.handle(1, Requested(request("next", "robot/b", "robot/c", priority=5)))
    # Its equal must not take robot/c before it: equal priority would never give it back.
    assert granted(core.handle(1, Requested(request("last", "robot/c", priority=5)))) == []
    assert granted(vote_all(core, asked)) == ["top", "next"]


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


def test_a_kept_hold_yields_to_its_equal_at_the_instant_its_minimum_runtime_is_over() -> None:
    core = core_with("robot/a")
    core.handle(0, Requested(request("operator", "robot/a", priority=5, keep=True)))
    core.handle(
        0, Requested(request("equal", "robot/a", priority=5)), Requested(request("lower", "robot/a", priority=4))
    )
    assert granted(core.handle(10 * SECOND - 1, Tick())) == []
    effects = core.handle(10 * SECOND, Tick())
    (gone,) = only(HoldEnded, effects)
    assert (gone.arc, gone.outcome, gone.requeued, gone.by) == ("operator", Outcome.COMPLETED, False, "equal")
    assert granted(effects) == ["equal"]


def test_a_kept_hold_given_back_after_its_time_is_completed() -> None:
    core = core_with("robot/a")
    core.handle(0, Requested(request("operator", "robot/a", keep=True)))
    core.handle(60 * SECOND, Tick())
    (gone,) = only(HoldEnded, core.handle(60 * SECOND, Released("operator")))
    assert gone.outcome is Outcome.COMPLETED


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


def test_a_hold_whose_time_ran_out_between_two_terms_is_completed_at_once() -> None:
    core = Core()
    now = 60 * SECOND
    over = standing(request("over", "robot/a"), 1)
    waits = Requested(request("next", "robot/a"), Place(OLD, 2))
    effects = core.handle(now, RcJoined("robot/a", sharable=False), LeadTaken(NEW, (over,), (waits,)))
    validate(core)
    assert [(gone.arc, gone.outcome) for gone in only(HoldEnded, effects)] == [("over", Outcome.COMPLETED)]
    assert granted(effects) == ["next"]


def test_two_arcs_that_claim_one_place_both_get_their_turn() -> None:
    core = core_with("robot/a")
    same = Place(OLD, 7)
    core.handle(0, Requested(request("holder", "robot/a")))
    core.handle(0, Requested(request("x", "robot/a"), same), Requested(request("y", "robot/a"), same))
    assert granted(core.handle(10 * SECOND, Tick())) == ["x"]
    assert granted(core.handle(20 * SECOND, Tick())) == ["y"]


def test_a_gang_with_an_absent_rc_is_revoked_whole_and_queued_with_its_place() -> None:
    core = Core()
    broken = standing(request("broken", "robot/a", "robot/gone"), 1, start=5)
    sound = standing(request("sound", "robot/b"), 2, start=5, place=2)
    joins = [RcJoined(rc, sharable=False) for rc in ("robot/a", "robot/b")]
    effects = core.handle(6, *joins, LeadTaken(NEW, (broken, sound)))
    (gone,) = only(HoldEnded, effects)
    assert (gone.arc, gone.grant, gone.requeued, gone.outcome) == ("broken", Grant(OLD, 1), True, Outcome.LOST)
    assert core._state.queued["broken"].place == Place(OLD, 1)
    assert core._state.running["sound"].hold is not None
    assert core._state.running["sound"].hold.grant == Grant(OLD, 2)
    validate(core)


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
