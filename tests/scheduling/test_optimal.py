"""Strategy `optimal` in the core: the best set by the brief, its votes asked as late as can be."""

from __future__ import annotations

from fractions import Fraction

from hypothesis import given, settings

from tests.scheduling.exhaustive import best_set
from tests.scheduling.workloads import voter, workloads
from tests.thorough import times
from zscout.scheduling import optimal
from zscout.scheduling.capacity import excess
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import (
    ArcRequest,
    Effect,
    Granted,
    HoldEnded,
    Outcome,
    Propose,
    RcJoined,
    Requested,
    Tick,
    Vote,
    VoteOverdue,
)
from zscout.scheduling.packing import PackingItem
from zscout.simulation.workload import Workload, WorkloadRc
from zscout.types import SECOND, ArcId


def arc(name: ArcId, needs: str, priority: int = 0, runtime: int = 5, rate: int = 1) -> ArcRequest:
    """`needs`: RCs by letter; capitals are sharable."""
    shares = {"rate": Fraction(rate)}
    return ArcRequest(name, "host/a", {rc: shares if rc.isupper() else {} for rc in needs}, priority, runtime * SECOND)


def core_of(rcs: str, *requests: ArcRequest) -> tuple[Core, list[Effect]]:
    core = Core(optimal.Optimal())
    core.handle(0, *(RcJoined(rc, rc.isupper()) for rc in rcs))
    return core, core.handle(0, *map(Requested, requests))


def proposed(effects: list[Effect]) -> list[Propose]:
    return [effect for effect in effects if isinstance(effect, Propose)]


def test_two_that_use_more_go_before_one_of_better_rank() -> None:
    core, _ = core_of("abcd", arc("narrow", "bc", runtime=1), arc("left", "ab"), arc("right", "cd"))
    assert core._state.running.keys() == {"left", "right"}
    assert str(core._state.queued["narrow"].reason) == "waits for left: b; for right: c"


def test_who_runs_is_not_ended_for_more_pairs_of_its_own_priority() -> None:
    core, _ = core_of("abc", arc("runs", "b"))
    core.handle(SECOND, Requested(arc("wide", "abc")))
    assert core._state.running.keys() == {"runs"}


def test_a_higher_priority_takes_the_place_that_costs_least() -> None:
    """Both hold what the operator could do with; the one that uses less has to go."""
    core, effects = core_of("R", arc("small", "R", rate=2), arc("great", "R", priority=1, rate=3))
    effects = core.handle(0, Vote(proposed(effects)[0].proposal, True))
    assert core._state.running.keys() == {"small", "great"}
    effects = core.handle(SECOND, Requested(arc("operator", "R", priority=10, rate=3)))
    asked = proposed(effects)
    assert [set(one.holders) for one in asked] == [{"small", "great", "operator"}]
    effects = core.handle(SECOND, Vote(asked[0].proposal, False, "full"))
    asked = proposed(effects)
    assert [set(one.holders) for one in asked] == [{"great", "operator"}]
    effects = core.handle(SECOND, Vote(asked[0].proposal, True))
    ended = [effect for effect in effects if isinstance(effect, HoldEnded)]
    assert [(effect.arc, effect.outcome, effect.by) for effect in ended] == [("small", Outcome.PREEMPTED, "operator")]


def test_a_slow_voter_stops_nobody_who_has_nothing_to_do_with_it() -> None:
    core, effects = core_of("Rab", arc("waits", "Ra", priority=5), arc("beside", "a"), arc("apart", "b"))
    assert core._state.running.keys() == {"apart"}
    (question,) = proposed(effects)
    core.handle(SECOND, VoteOverdue(question.proposal))
    assert core._state.running.keys() == {"apart", "beside"}
    assert core._state.queued["waits"].reason
    effects = core.handle(SECOND, Vote(question.proposal, True))
    assert core._state.running.keys() == {"apart", "waits"}


def test_one_question_settles_a_set_that_an_rc_accepts() -> None:
    _, effects = core_of("R", *(arc(f"a{number}", "R") for number in range(8)))
    assert [len(one.holders) for one in proposed(effects)] == [8]


@settings(max_examples=times(18))
@given(workloads(keep=False))
def test_free_rcs_are_shared_out_as_by_trying_all(workload: Workload) -> None:
    """All ask at once; the RCs' own sums, not their votes, say which sets are ruled out."""
    requests = sorted(
        (arrival.request for arrival in workload.arrivals), key=lambda one: (-one.priority, one.min_runtime)
    )
    there = {rc.name: rc for rc in workload.rcs}
    able = [one for one in requests if one.needs.keys() <= there.keys()]
    core = Core(optimal.Optimal())
    core.handle(0, *(RcJoined(rc.name, rc.sharable) for rc in workload.rcs))
    for _ in play_instant(core, 0, map(Requested, requests), voter(workload)):
        pass
    assert core._state.running.keys() == {able[one].arc for one in expected(able, there)}


def expected(requests: list[ArcRequest], there: dict[str, WorkloadRc]) -> frozenset[int]:
    exclusive = [name for name, rc in there.items() if not rc.sharable]
    levels = sorted({request.priority for request in requests}, reverse=True)
    items = [
        PackingItem(
            sum(1 << exclusive.index(name) for name in request.needs if name in exclusive),
            len(request.needs),
            levels.index(request.priority),
        )
        for request in requests
    ]
    vetoes = []
    for chosen in range(1, 1 << len(requests)):
        holders = [number for number in range(len(requests)) if chosen >> number & 1]
        for name, rc in there.items():
            shares = [(requests[one].arc, requests[one].needs.get(name, {})) for one in holders]
            if rc.sharable and excess(rc.capacity, shares):
                vetoes.append(frozenset(holders))
                break
    smallest = [veto for veto in vetoes if not any(other < veto for other in vetoes)]
    return best_set(items, smallest)


def test_nothing_new_is_asked_or_done_by_a_tick() -> None:
    core, effects = core_of("Rab", arc("x", "Ra"), arc("y", "Rb"), arc("z", "ab"))
    core.handle(0, *(Vote(one.proposal, True) for one in proposed(effects)))
    assert core._state.running.keys() == {"x", "y"}
    assert not [one for one in core.handle(SECOND, Tick()) if isinstance(one, (Granted, HoldEnded, Propose))]
