"""Strategy `adaptive`: never less than `priority`, the best where that is found, and nobody waits long."""

from __future__ import annotations

import copy
import random
from collections import Counter
from itertools import islice

import pytest
from hypothesis import given, settings

from tests.scheduling.invariants import Ledger, check_settled
from tests.scheduling.test_optimal import arc, proposed
from tests.scheduling.validate import validate
from tests.scheduling.workloads import voter, workloads
from tests.services.recorder.paper_run import table1
from tests.thorough import times
from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling.adaptive import MAX_SLICES, SLICE_STEPS, Adaptive, steps_for
from zscout.scheduling.conflict_groups import density
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import (
    ArcRequest,
    Cancelled,
    Effect,
    Event,
    Granted,
    HoldEnded,
    Propose,
    Queued,
    RcJoined,
    Released,
    Requested,
    Tick,
    Vote,
    VoteOverdue,
    WakeAt,
)
from zscout.scheduling.priority import Priority
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.replay import replay
from zscout.simulation.workload import Workload
from zscout.types import SECOND, Ns

MANY_PASSES = 500
"""Far more than any instant takes."""


def experiment(seed: int, rcs: int, arcs: int) -> list[ArcRequest]:
    """The paper's: ARCs of one priority that need 1 to 5 RCs each."""
    draw = random.Random(seed)  # noqa: S311
    return [
        ArcRequest(f"a{number}", "host/a", {f"rc/{rc}": {} for rc in needs}, 1, SECOND)
        for number in range(arcs)
        for needs in [draw.sample(range(rcs), draw.randint(1, 5))]
    ]


def free(rcs: int, strategy: StrategyName = "adaptive") -> Core:
    core = Core(STRATEGIES[strategy]())
    core.handle(0, *(RcJoined(f"rc/{number}", False) for number in range(rcs)))
    return core


def wants_more(now: Ns, effects: list[Effect]) -> bool:
    """Whether another pass is asked for at once."""
    return any(isinstance(effect, WakeAt) and effect.at == now for effect in effects)


def instant(core: Core, now: Ns, workload: Workload, events: list[Event]) -> None:
    """One instant to its end: votes are answered, and passes asked for are given."""
    passes = play_instant(core, now, events, voter(workload))
    assert sum(1 for _ in islice(passes, MANY_PASSES)) < MANY_PASSES, "the instant never ends"


def searched(core: Core, *events: Event) -> list[Effect]:
    """All effects of an instant in which no RC votes."""
    passes = islice(play_instant(core, 0, events or [Tick()], unasked), MANY_PASSES)
    return [effect for effects in passes for effect in effects]


def unasked(question: Propose) -> Vote:
    raise AssertionError(question)


def in_use(core: Core, now: Ns) -> Counter[int]:
    """(ARC, RC) pairs by priority, the shorter the more, but for those past their minimum runtime."""
    pairs: Counter[int] = Counter()
    for one in core._state.running.values():
        if not one.past_min_runtime(now):
            pairs[one.request.priority] += density(one.request.min_runtime) * one.mask.bit_count()
    return pairs


@pytest.mark.parametrize("seeds", [range(start, start + 25) for start in range(0, 100, 25)])
def test_the_papers_experiment_is_decided_as_by_optimal(seeds: range) -> None:
    for seed in seeds:
        used = {}
        for name in ("adaptive", "optimal"):
            core = free(10, name)
            core.handle(0, *map(Requested, experiment(seed, 10, 20)))
            used[name] = core._state.busy.bit_count()
        assert used["adaptive"] == used["optimal"], seed


def test_table_1_is_served_as_by_priority() -> None:
    adaptive, first = (replay(table1(), strategy=strategy) for strategy in (Adaptive(), Priority()))
    starts = {(hold.arc, hold.outcome): hold.start for hold in first.holds}
    assert all(hold.start <= starts[hold.arc, hold.outcome] for hold in adaptive.holds)
    assert [hold for hold in adaptive.holds if hold.arc == "arc4"] == [
        hold for hold in first.holds if hold.arc == "arc4"
    ]
    assert adaptive.unserved == first.unserved == ()


@settings(max_examples=times(28))
@given(workloads())
def test_promises_hold_in_replay(workload: Workload) -> None:
    strategy = Adaptive()
    ledger = Ledger(workload.rcs, [arrival.request for arrival in workload.arrivals])

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        ledger.take(now, core, effects)
        if not wants_more(now, effects):
            check_settled(now, core, workload.rcs)

    replay(workload, watch, strategy=strategy)
    assert not ledger.open


@settings(max_examples=times(28))
@given(workloads())
def test_no_instant_ends_with_less_than_priority_would_give(workload: Workload) -> None:
    core = Core(Adaptive())
    instant(core, 0, workload, [RcJoined(rc.name, rc.sharable) for rc in workload.rcs])
    arrivals = sorted(workload.arrivals, key=lambda arrival: arrival.at)
    for now in sorted({arrival.at for arrival in arrivals} | {second * SECOND for second in range(12)}):
        events: list[Event] = [Requested(one.request) for one in arrivals if one.at == now]
        other = copy.deepcopy(core)
        other.strategy = Priority()
        instant(core, now, workload, events or [Tick()])
        instant(other, now, workload, events or [Tick()])
        got, least = in_use(core, now), in_use(other, now)
        levels = sorted({*got, *least}, reverse=True)
        assert [got[level] for level in levels] >= [least[level] for level in levels]


def test_where_nothing_is_to_gain_priority_decides_at_once() -> None:
    strategy = Adaptive()
    core = Core(strategy)
    core.handle(0, RcJoined("a", False), RcJoined("b", False))
    core.handle(0, Requested(arc("x", "a")), Requested(arc("y", "b")))
    core.handle(0, Requested(arc("z", "ab")))
    assert core._state.running.keys() == {"x", "y"}
    assert not strategy._searches


def test_a_gain_is_told_in_words() -> None:
    strategy = Adaptive()
    core = Core(strategy)
    core.handle(0, *(RcJoined(rc, False) for rc in "abcd"))
    core.handle(
        0, Requested(arc("narrow", "bc", 3, 4)), Requested(arc("left", "ab", 3)), Requested(arc("right", "cd", 3))
    )
    assert core._state.running.keys() == {"left", "right"}
    assert strategy.log_line().startswith("adaptive: RC assignments at priority 3: 2 -> 4, in ")
    assert not strategy.log_line()


def steps(strategy: Adaptive) -> int:
    """Of all searches that are under way."""
    return sum(search.steps for search in {id(one): one for one in strategy._searches.values()}.values())


def test_a_large_search_is_cut_into_slices_and_others_go_on() -> None:
    strategy = Adaptive()
    core = Core(strategy)
    core.handle(0, *(RcJoined(f"rc/{number}", False) for number in range(300)), RcJoined("apart", False))
    effects = core.handle(0, *map(Requested, experiment(0, 300, 600)))
    assert wants_more(0, effects)
    assert not core._state.running
    assert all(not effect.settled for effect in effects if isinstance(effect, Queued))
    before = steps(strategy)
    effects = core.handle(0, Requested(ArcRequest("other", "host/b", {"apart": {}}, 0, SECOND)))
    assert core._state.running.keys() == {"other"}
    passes = 2
    while wants_more(0, effects):
        assert steps(strategy) - before <= SLICE_STEPS
        before = steps(strategy)
        effects = core.handle(0, Tick())
        passes += 1
    assert passes <= steps_for(600) / SLICE_STEPS + 3
    validate(core)
    plain = free(300, "priority")
    plain.handle(0, *map(Requested, experiment(0, 300, 600)))
    assert core._state.busy.bit_count() >= 1.15 * plain._state.busy.bit_count()


def test_a_part_that_keeps_changing_is_decided_all_the_same() -> None:
    core = free(300)
    requests = experiment(1, 300, 700)
    core.handle(0, *map(Requested, requests[:600]))
    for number, newcomer in enumerate(requests[600:]):
        core.handle(0, Requested(newcomer), Cancelled(f"a{number}"))
        validate(core)
        if core._state.running:
            break
    assert core._state.running
    assert number <= MAX_SLICES


def test_an_arc_that_ends_during_the_search_is_not_started() -> None:
    core = free(300)
    core.handle(0, *map(Requested, experiment(2, 300, 600)))
    core.handle(0, Tick())
    core.handle(0, *(Cancelled(f"a{number}") for number in range(0, 600, 2)))
    searched(core)
    validate(core)
    assert core._state.running
    assert all(int(one[1:]) % 2 for one in core._state.running)


def test_a_slow_voter_stops_nobody_who_has_nothing_to_do_with_it() -> None:
    core = Core(Adaptive())
    core.handle(0, *(RcJoined(rc, rc.isupper()) for rc in "Rabcd"))
    # The better set needs the radio's word; `apart` shares nothing with it.
    effects = core.handle(
        0,
        Requested(arc("narrow", "ab", runtime=4)),
        Requested(arc("left", "Ra")),
        Requested(arc("right", "Rb")),
        Requested(arc("apart", "d")),
    )
    assert core._state.running.keys() == {"apart"}
    (question,) = proposed(effects)
    assert set(question.holders) == {"left", "right"}
    # Nobody waits for it any longer: what can do without it goes first.
    core.handle(SECOND, VoteOverdue(question.proposal))
    assert core._state.running.keys() == {"apart", "narrow"}
    core.handle(SECOND, Vote(question.proposal, True), Released("narrow"))
    assert core._state.running.keys() == {"apart", "left", "right"}


def test_a_veto_brings_the_next_best() -> None:
    core = Core(Adaptive())
    core.handle(0, *(RcJoined(rc, rc.isupper()) for rc in "Rabc"))
    effects = core.handle(
        0, Requested(arc("narrow", "ab", runtime=4)), Requested(arc("left", "Ra")), Requested(arc("right", "Rbc"))
    )
    for _ in range(MANY_PASSES):
        asked = proposed(effects)
        if not asked:
            break
        effects = core.handle(0, *(Vote(one.proposal, len(one.holders) == 1, "full") for one in asked))
    assert core._state.running.keys() == {"right"}


def test_the_outcome_is_the_same_every_time() -> None:
    def run() -> list[Effect]:
        core = free(100)
        told = searched(core, *map(Requested, experiment(5, 100, 200)))
        return [effect for effect in told if isinstance(effect, (Granted, HoldEnded, Propose))]

    assert run() == run()
