"""Preemption has a budget, and patience follows the runtimes: rule 19 (docs/scheduling.md), strategy `adaptive`."""

from __future__ import annotations

import random
from collections.abc import Sequence

import pytest
from msgspec import structs

from tests.scheduling.seeds import in_parts
from tests.scheduling.test_waiting import of_classes
from tests.thorough import times
from zscout.config.scheduling_policy import PATIENCE, SchedulingPolicy, StrategyName
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import ArcRequest, HoldEnded, LeadTaken, Outcome, RcJoined, Requested, Tick
from zscout.scheduling.patience import (
    GRANTS_PER_OWNER,
    MAX_COUNTED_RUNTIME,
    MAX_PATIENCE,
    PATIENCE_IN_RUNTIMES,
    RuntimeMean,
)
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.replay import replay
from zscout.types import SECOND, ArcId, Need, Ns, Params, Term

SHORT = 30 * SECOND
POLICY = SchedulingPolicy(patience=SHORT)


def fleet(policy: SchedulingPolicy = POLICY, strategy: StrategyName = "adaptive") -> Core:
    core = Core(STRATEGIES[strategy](), policy)
    core.handle(0, *(RcJoined(f"robot/{name}", sharable=False) for name in "ab"))
    return core


def ask(
    name: str, priority: int = 1, seconds: int = 100, rcs: str = "a", *, host: str = "", keep: bool = False
) -> Requested:
    needs: dict[Need, Params] = {f"robot/{rc}": {} for rc in rcs}
    return Requested(ArcRequest(name, f"{host or name}/c", needs, priority, seconds * SECOND, keep))


def running(core: Core) -> set[ArcId]:
    return {arc for arc in core.arcs() if core.is_running(arc)}


def at(core: Core, second: float, *events: object) -> set[ArcId]:
    core.handle(round(second * SECOND), *(events or (Tick(),)))  # type: ignore[arg-type]
    return running(core)


@pytest.mark.parametrize(("second", "preempts"), [(24.9, True), (25, False), (99, False)])
def test_who_has_had_a_quarter_of_its_minimum_runtime_is_protected(second: float, preempts: bool) -> None:
    core = fleet()
    at(core, 0, ask("low"))
    assert at(core, second, ask("high", 2)) == {"high" if preempts else "low"}
    assert at(core, 99.5, ask("operator", 10)) == {"operator"}, "nothing keeps operators waiting"


@pytest.mark.parametrize("strategy", ["priority", "optimal"])
def test_the_other_strategies_have_no_budget(strategy: StrategyName) -> None:
    core = fleet(strategy=strategy)
    at(core, 0, ask("low"))
    assert at(core, 99, ask("high", 2)) == {"high"}


def test_what_was_lost_before_counts() -> None:
    core = fleet()
    at(core, 0, ask("low"))
    at(core, 20, ask("first", 2, 1))
    assert at(core, 21) == {"low"}
    assert at(core, 25.9, ask("second", 2, 1)) == {"second"}
    assert at(core, 26.9) == {"low"}
    assert at(core, 27, ask("third", 2, 1)) == {"low"}, "24.9 s are lost already"


def test_what_its_own_owner_takes_protects_from_nobody() -> None:
    core = fleet()
    at(core, 0, ask("low", host="h"))
    at(core, 20, ask("own", 2, 1, host="h"))
    assert at(core, 21) == {"low"}
    assert at(core, 45.9, ask("other", 2, 1)) == {"other"}


def test_who_has_waited_its_patience_in_all_is_protected_from_the_start() -> None:
    core = fleet()
    at(core, 0, ask("before", 1, 20))
    at(core, 0, ask("low"))
    assert at(core, 20) == {"low"}
    assert at(core, 21, ask("high", 2, 10)) == {"high"}
    assert at(core, 31) == {"low"}, "it has waited 20 s and 10"
    assert at(core, 31, ask("next", 2, 10)) == {"low"}


def test_waiting_counts_through_preemption() -> None:
    core = fleet()
    at(core, 0, ask("before", 1, 20))
    at(core, 0, ask("low"))
    at(core, 20)
    at(core, 21, ask("high", 2, 10))
    status = core.arc("low")
    assert status is not None
    assert status.since == SECOND


def test_what_its_client_tells_of_its_wait_protects_from_nobody() -> None:
    core = fleet()
    request = ask("low").request
    core.handle(100 * SECOND, Requested(request, None, 0))
    assert running(core) == {"low"}
    assert at(core, 101, ask("high", 2, 10)) == {"high"}


def test_a_hold_goes_on_as_protected_under_the_next_leader_and_a_queued_one_forgets_its_losses() -> None:
    core = fleet()
    at(core, 0, ask("low"))
    at(core, 20, ask("first", 2, 1))
    at(core, 21, ask("lost", 1, 100, "b"))
    at(core, 22, ask("other", 2, 20, "b"))
    joined, lead = core.as_events(Term(1, "next"))
    lead = structs.replace(lead, waiting=tuple(structs.replace(asked, past=None) for asked in lead.waiting))
    then = Core(STRATEGIES["adaptive"](), POLICY)
    then.handle(22 * SECOND, *joined, lead)
    assert at(then, 25.9, ask("second", 2, 1)) == {"second", "other"}
    assert at(then, 26.9) == {"low", "other"}
    assert at(then, 27, ask("third", 2, 1)) == {"low", "other"}
    at(then, 42)
    assert running(then) == {"low", "lost"}
    assert at(then, 66, ask("last", 2, 1, "b")) == {"low", "last"}, (
        "24 s of its hold, and what it lost before is forgotten"
    )


def test_kept_past_its_minimum_runtime_a_hold_yields_to_its_equals() -> None:
    core = fleet()
    at(core, 0, ask("kept", 2, keep=True))
    assert at(core, 99, ask("equal", 2)) == {"kept"}
    assert at(core, 100) == {"equal"}


def test_a_place_is_kept_for_the_time_at_which_nobody_is_protected() -> None:
    """`high` needs both. `first` is over at 40 s; `second`, which yields until 25 s, is protected then, to 110 s."""
    core = fleet()
    at(core, 0, ask("first", 1, 40), ask("second", 1, 100, "b"))
    at(core, 11, ask("high", 2, 10, "ab"))
    assert at(core, 41) == {"second"}
    assert at(core, 42, ask("long", 1, 60)) == {"second"}, "it would not be over by 100 s"
    assert at(core, 42, ask("brief", 1, 58)) == {"second", "brief"}
    assert at(core, 100) == {"high"}


def test_an_estimate_knows_who_is_protected() -> None:
    core = fleet()
    at(core, 0, ask("low"))
    at(core, 10)
    asked = ask("high", 2, 10).request
    assert forecast(core, 10 * SECOND, asked).starts["high"] == 10 * SECOND
    assert forecast(core, 30 * SECOND, asked).starts["high"] == 100 * SECOND


@pytest.mark.parametrize("seeds", in_parts(range(times(1_000)), quick=60, size=465))
def test_nobody_loses_more_than_the_budget_to_others(seeds: Sequence[int]) -> None:
    preempted = 0
    for seed in seeds:
        draw, work = random.Random(seed), of_classes(seed)  # noqa: S311
        budget, lost = draw.choice((0.1, 0.25, 1.0)), dict[ArcId, Ns]()
        known = {one.request.arc: one.request for one in work.arrivals}
        starts: dict[ArcId, Ns] = {}

        def watch(
            now: Ns,
            core: Core,
            effects: Sequence[object],
            known: dict[ArcId, ArcRequest] = known,
            lost: dict[ArcId, Ns] = lost,
            starts: dict[ArcId, Ns] = starts,
        ) -> None:
            for effect in effects:
                if isinstance(effect, HoldEnded) and effect.outcome is Outcome.PREEMPTED and effect.by is not None:
                    own = known[effect.by].owner == known[effect.arc].owner
                    lost[effect.arc] = lost.get(effect.arc, 0) + (0 if own else now - starts[effect.arc])
            starts |= {arc.id: arc.hold.start for arc in core._state.running.values() if arc.hold is not None}

        replay(work, watch, strategy=STRATEGIES["adaptive"](), policy=SchedulingPolicy(preempt_budget=budget))
        assert all(had <= round(budget * known[arc].min_runtime) for arc, had in lost.items()), seed
        preempted += sum(had > 0 for had in lost.values())
    assert preempted > len(seeds) // 2


def reckoned(*grants: tuple[str, Ns], before: Ns | None = None) -> Ns:
    mean = RuntimeMean()
    if before is not None:
        mean.restore(before)
    for owner, runtime in grants:
        mean.count(owner, runtime)
    return mean.patience(0)


def test_patience_follows_the_minimum_runtimes_that_are_granted() -> None:
    hour = 3_600 * SECOND
    assert reckoned() == PATIENCE
    assert reckoned(("a", SECOND)) == PATIENCE
    assert reckoned(("a", 600 * SECOND), ("a", 1_200 * SECOND)) == PATIENCE_IN_RUNTIMES * 900 * SECOND
    assert reckoned(("a", 600 * SECOND), ("b", 1_200 * SECOND)) == PATIENCE_IN_RUNTIMES * 600 * SECOND, (
        "of two the shorter"
    )
    assert reckoned(("a", 100 * hour)) == MAX_PATIENCE
    assert reckoned(("a", 100 * MAX_COUNTED_RUNTIME), *[("a", SECOND)] * 9) == min(
        MAX_PATIENCE, round(PATIENCE_IN_RUNTIMES * (MAX_COUNTED_RUNTIME + 9 * SECOND) / 10)
    )


def test_one_owner_does_not_move_the_patience() -> None:
    others = [(name, runtime * SECOND) for name, runtime in (("a", 300), ("b", 400), ("c", 500)) for _ in range(9)]
    for runtime in (SECOND, MAX_COUNTED_RUNTIME):
        moved = reckoned(*others, *[("greedy", runtime)] * 10_000)
        assert PATIENCE_IN_RUNTIMES * 300 * SECOND <= moved <= PATIENCE_IN_RUNTIMES * 500 * SECOND


def test_the_patience_of_the_leader_before_counts_less_and_less() -> None:
    before = 4 * 3_600 * SECOND
    assert reckoned(before=before) == before
    few, many = (reckoned(*[("a", 10 * SECOND)] * count, before=before) for count in (10, GRANTS_PER_OWNER))
    assert before > few > many == PATIENCE_IN_RUNTIMES * 10 * SECOND


def test_it_is_fixed_when_an_arc_is_queued() -> None:
    core = fleet(SchedulingPolicy())
    at(core, 0, ask("long", seconds=1_000))
    at(core, 61, ask("waits"))
    assert core._state.queued["waits"].patience == core.patience == PATIENCE_IN_RUNTIMES * 1_000 * SECOND
    at(core, 62, *(ask(f"n{number}", 1, 1, "b") for number in range(3)))
    at(core, 200)
    assert core.patience < PATIENCE_IN_RUNTIMES * 1_000 * SECOND
    assert core._state.queued["waits"].patience == PATIENCE_IN_RUNTIMES * 1_000 * SECOND


def test_a_number_in_the_fleet_file_stands() -> None:
    core = fleet()
    at(core, 0, ask("long", seconds=1_000))
    assert core.patience == SHORT
    core.policy = SchedulingPolicy(patience=5 * SECOND)
    at(core, 1, ask("waits"))
    core.policy = SchedulingPolicy(patience=7 * SECOND)
    assert core._state.queued["waits"].patience == core.patience == 7 * SECOND
    core.policy = SchedulingPolicy(patience=None)
    assert core.patience == 0


def test_the_patience_goes_on_under_the_next_leader() -> None:
    core = fleet(SchedulingPolicy())
    core.handle(SECOND, LeadTaken(Term(1, "next"), patience=1_000 * SECOND))
    assert core.patience == 1_000 * SECOND
