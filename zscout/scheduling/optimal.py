"""Strategy `optimal`: in each pass the best set of ARCs that could hold their RCs together.

A pass:

1. Take the candidates, in groups that have no RC in common (`conflict_groups.py`).
2. Find the best set of each group as if every vote that is not known were a yes: by branch and bound where
   that is quick, else by CP-SAT if OR-tools is installed (the extra `optimal`), else by local search.
3. Ask the votes that the set needs and that are not known; until they are in, the group is off limits. A veto
   rules out that set of holders and every larger one: then back to 2.
4. Take the set: preempt who has to end, start who is to start.
5. Run a pass of `priority` over the rest: it starts nobody, and reports what they wait for.

The set's value is the vector of (ARC, RC) pairs in use by priority, highest first (`packing.py`).
"""

from __future__ import annotations

from typing import Final

from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling import cpsat, priority
from zscout.scheduling.conflict_groups import ConflictGroup, conflict_groups
from zscout.scheduling.local_search import LocalSearch
from zscout.scheduling.packing import PackingProblem, pack
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.strategy import Actions

WORK: Final = 200_000
"""Steps of branch and bound, times items, before a group counts as large: some 20 ms. What is not proven by
then seldom is soon after."""
MAX_PACKED: Final = 80
"""Larger groups are not even tried by branch and bound: at 30x60 it takes 11 ms and CP-SAT 18, at 40x80 it
seldom comes to a proof."""
STEPS: Final = 6_000
"""Steps of local search for a large group."""


MAX_VETOES: Final = 256
"""Vetoes on one group. A voter gives no reason that could be reckoned with, so a proof may take a question
for each of very many sets; beyond so many vetoes `priority` decides the group."""


class Optimal:
    """The strategy; it keeps nothing from pass to pass."""

    name: StrategyName = "optimal"

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        held = 0
        for group in conflict_groups(state):
            if not decide(group, actions):
                held |= group.mask
        # Nothing is left for it to start; it reports to those who wait what they wait for.
        priority.run_pass(state, actions, off_limits=held)

    def news(self) -> str:
        return ""


def decide(group: ConflictGroup, actions: Actions) -> bool:
    """Takes the best set of a group, or leaves it to `priority`. False: votes are out; nothing changes
    yet."""
    questions = None
    while questions is None:
        if len(group.nogoods) > MAX_VETOES:
            return True
        # None: a veto that was known ruled it out, and each round bars at least one more set.
        questions = group.ask(chosen := best(group.problem()))
    if questions:
        for rc, holders in questions:
            actions.propose(rc, holders)
        return False
    group.take(chosen, actions)
    return True


def best(problem: PackingProblem) -> int:
    """The best set, or the best that was found within the budget: never less than the heuristic finds."""
    size = len(problem.items)
    packing = pack(problem, WORK // max(1, size) if size <= MAX_PACKED else 0)
    if packing.exact:
        return packing.chosen
    search = LocalSearch(problem, packing.chosen)
    search.run(STEPS)
    found = max(packing.chosen, search.best, key=problem.key)
    return cpsat.improve(problem, found) if cpsat.available() else found
