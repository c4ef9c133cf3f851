"""Who is in play, found by the index, against a look at everyone."""

from __future__ import annotations

import random
from collections import Counter

import pytest
from msgspec import structs

from tests.scheduling.test_patterns import workload as with_patterns
from tests.scheduling.test_waiting import changed
from tests.scheduling.test_waiting import workload as with_one_priority
from tests.thorough import times
from zscout.config.scheduling_policy import SchedulingPolicy, StrategyName
from zscout.scheduling.conflict_groups import undecided_arcs
from zscout.scheduling.model import Arc, ArcRequest
from zscout.scheduling.state import Actions, SchedulerState, Strategy
from zscout.scheduling.strategies import STRATEGIES
from zscout.scheduling.votes import Votes
from zscout.simulation.replay import replay
from zscout.simulation.workload import Workload
from zscout.types import SECOND, Ns


def everyone_looked_at(state: SchedulerState, votes: Votes, now: Ns) -> set[str]:
    """Ids of those in play, by the definition: from the top down, who has nobody in the way that stays."""
    movable: dict[str, Arc] = {}
    found: set[str] = set()
    for arc in sorted(state.queued.values(), key=lambda arc: arc.rank):
        if (arc.patterns and not arc.bound) or any(not rc.present for rc in arc.rcs):
            continue
        stays = {
            rc.name: [
                holder.id
                for holder in rc.holders.values()
                if holder.id not in movable and not holder.preemptible_by(arc, now)
            ]
            for rc in arc.rcs
        }
        answers = [votes.known(rc.name, frozenset((*stays[rc.name], arc.id))) for rc in arc.rcs if rc.sharable]
        refused = any(answer is not None and not answer.accept for answer in answers)
        if refused or any(stays[rc.name] for rc in arc.rcs if not rc.sharable):
            continue
        found.add(arc.id)
        for rc in arc.rcs:
            movable |= {one.id: one for one in rc.holders.values() if one.preemptible_by(arc, now)}
    return found | set(movable)


class Compared:
    """A strategy that checks before each pass."""

    def __init__(self, strategy: Strategy) -> None:
        self.name, self.strategy = strategy.name, strategy
        self.seen: Counter[int] = Counter()

    def log_line(self) -> str:
        return self.strategy.log_line()

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        indexed, _ = undecided_arcs(state) or ((), 0)
        for arc in state.by_pattern.values():
            assert arc.like is not None
            state.bind(arc, arc.like.bound(arc))
        assert {arc.id for arc in indexed} == everyone_looked_at(state, state.votes, state.now)
        self.seen[len(indexed)] += 1
        self.strategy.run_pass(state, actions)


def mixed(seed: int) -> Workload:
    """Priorities, kept holds, radios, and in every second one patterns."""
    draw = random.Random(seed)  # noqa: S311
    work = with_patterns(seed) if seed % 2 else with_one_priority(seed)
    return changed(work, lambda one: structs.replace(one, keep=draw.random() < 0.2, priority=draw.randint(1, 4)))


@pytest.mark.parametrize("strategy", ["priority", "optimal", "adaptive"])
@pytest.mark.parametrize("preempt", ["always", "after_min_runtime"])
def test_the_index_finds_who_is_in_play(strategy: StrategyName, preempt: str) -> None:
    seen: Counter[int] = Counter()
    for seed in range(times(40)):
        compared = Compared(STRATEGIES[strategy]())
        policy = SchedulingPolicy(preempt=preempt, operator_priority=4, patience=None)  # type: ignore[arg-type]
        replay(mixed(seed), strategy=compared, policy=policy)
        seen += compared.seen
    assert sum(count for size, count in seen.items() if size > 2) > 100, "hardly anything was ever in play"


def test_too_many_are_left_to_the_heuristic() -> None:
    state = SchedulerState()
    state.join("robot/a", sharable=False)
    for number in range(12):
        wanted = ArcRequest(f"a{number}", "h/c", {"robot/a": {}}, 1, SECOND)
        state.enqueue(Arc(wanted, (0, number), state.rc("robot/a").bit), 0)  # type: ignore[arg-type]
    assert undecided_arcs(state, limit=11) is None
    found = undecided_arcs(state, limit=12)
    assert found is not None
    assert len(found[0]) == 12
