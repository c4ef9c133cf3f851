"""Strategy `optimal`: in each pass the best set of ARCs that could hold their RCs together.

A pass:

1. Take the candidates, in groups without a common RC (`conflict_groups.py`).
2. Find each group's best set, counting unknown votes as yes: by branch and bound where quick, else by CP-SAT if
   OR-tools is installed (the extra `optimal`), else by local search. With patterns, a group whose planned set is as
   good is left to step 5.
3. Ask for the unknown votes that the set needs; until they are in, the group is off limits. A veto rules out that set
   of holders and every larger set: back to 2.
4. Take the set: preempt its victims, start its ARCs.
5. Run a pass of `priority` over the rest, for ARCs with patterns and for the reasons to wait. It starts no ARC that
   names all its RCs.

A set's value is the vector of (ARC, RC) pairs in use by priority, highest first (`packing.py`). OR-tools is imported
at first use, because it is large. The solver has a deterministic clock and one worker: the same problem always gives
the same set."""

from __future__ import annotations

import functools
import importlib.util
from typing import TYPE_CHECKING, Any, Final

from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling import priority
from zscout.scheduling.conflict_groups import ConflictGroup, Decision, conflict_groups, take_all
from zscout.scheduling.local_search import LocalSearch
from zscout.scheduling.packing import PackingProblem, numbers, pack
from zscout.scheduling.plan import dry_run
from zscout.scheduling.state import Actions, SchedulerState, Strategy

if TYPE_CHECKING:
    from ortools.sat.python import cp_model

SOLVER_BUDGET: Final = 0.3
"""Deterministic time of all stages together: about half a second. A stage leaves its unused time to the next."""
MIN_STAGE_TIME: Final = 0.01
RANKS_PER_STAGE: Final = 40
"""Items whose ranks a stage weighs: their weights are powers of two."""
PACKING_WORK: Final = 200_000
"""The budget of a group for branch and bound, in steps times items: some 20 ms. More would seldom prove more."""
MAX_PACKED: Final = 80
"""Larger groups skip branch and bound: at 30x60 it takes 11 ms and CP-SAT 18, at 40x80 it seldom finds a proof."""
LOCAL_SEARCH_STEPS: Final = 6_000
MAX_VETOES: Final = 256
"""After more vetoes on a group `priority` decides it: a proof may need a question for each of very many sets."""


@functools.cache
def solver_available() -> bool:
    return importlib.util.find_spec("ortools") is not None


def improve(problem: PackingProblem, start: int, budget: float = SOLVER_BUDGET) -> int:
    """A feasible set at least as good as the feasible `start`; the best set, if time allows."""
    found = _Solver(problem, start, budget).solve()
    best = max((problem.complete(found), found), key=problem.key)
    # Without a proof, a set of equal worth doesn't replace the start.
    return best if problem.key(best) > problem.key(start) or best == found else start


class _Solver:
    def __init__(self, problem: PackingProblem, start: int, budget: float) -> None:
        from ortools.sat.python import cp_model

        self.problem, self.found, self.left = problem, start, budget
        self.cp = cp_model
        self.model = cp_model.CpModel()
        self.takes = [self.model.new_bool_var(f"x{number}") for number in range(len(problem.items))]
        self._exclusive()
        self._vetoes()
        self._keep_running()

    def solve(self) -> int:
        """The best set found, stage by stage: pairs by level, preemptions, ranks."""
        problem, takes = self.problem, self.takes
        for level in range(problem.levels):
            pairs = sum(
                item.width * take
                for item, take in zip(problem.items, takes, strict=True)
                if item.level == level and not item.past_min_runtime
            )
            if not isinstance(pairs, int) and not self._stage(pairs):
                return self.found
        kept = sum(take for item, take in zip(problem.items, takes, strict=True) if item.in_min_runtime)
        if not isinstance(kept, int) and not self._stage(kept):
            return self.found
        for begin in range(0, len(takes), RANKS_PER_STAGE):
            chunk = takes[begin : begin + RANKS_PER_STAGE]
            ranks = sum((1 << len(chunk) - 1 - at) * take for at, take in enumerate(chunk))
            if not self._stage(ranks):
                return self.found
        return self.found

    def _stage(self, goal: Any) -> bool:
        """Maximise `goal` and fix its value. Return False if it is not proven optimal."""
        if self.left < MIN_STAGE_TIME:
            return False
        self.model.clear_hints()  # type: ignore[no-untyped-call]
        for number, take in enumerate(self.takes):
            self.model.add_hint(take, self.found >> number & 1)
        self.model.maximize(goal)
        solver = self.cp.CpSolver()
        solver.parameters.num_workers = 1
        solver.parameters.max_deterministic_time = self.left
        status = solver.solve(self.model)
        if status in (self.cp.OPTIMAL, self.cp.FEASIBLE):
            found = sum(1 << number for number, take in enumerate(self.takes) if solver.value(take))
            if status == self.cp.OPTIMAL or self.problem.key(found) > self.problem.key(self.found):
                self.found = found
        self.left -= solver.response_proto.deterministic_time
        if status != self.cp.OPTIMAL:
            return False
        self.model.add(goal == round(solver.objective_value))
        return True

    def _exclusive(self) -> None:
        covers: dict[int, list[cp_model.IntVar]] = {}
        for mask, take in zip(self.problem.masks, self.takes, strict=True):
            for rc in numbers(mask):
                covers.setdefault(rc, []).append(take)
        for cover in covers.values():
            if len(cover) > 1:
                self.model.add_at_most_one(cover)

    def _vetoes(self) -> None:
        for nogood in {nogood for nogoods in self.problem.nogoods for nogood in nogoods}:
            self.model.add_bool_or(~self.takes[number] for number in numbers(nogood))

    def _keep_running(self) -> None:
        """Keep each running item unless chosen items that outrank it take its RCs or, by a veto, rule it out."""
        problem = self.problem
        for running in problem.running:
            mask = problem.masks[running]
            excuses = [
                take
                for other, take in enumerate(self.takes)
                if other != running and problem.masks[other] & mask and problem.outranks(other, running)
            ]
            for nogood in problem.nogoods[running]:
                others = [other for other in numbers(nogood) if other != running]
                if all(problem.outranks(other, running) for other in others):
                    vetoed = self.model.new_bool_var("")
                    self.model.add_bool_and(self.takes[other] for other in others).only_enforce_if(vetoed)
                    excuses.append(vetoed)
            self.model.add_bool_or([self.takes[running], *excuses])


class Optimal(Strategy):
    name: StrategyName = "optimal"

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        plan = dry_run(state, None)
        decided = [(group, decide(group, actions)) for group in conflict_groups(state, plan=plan)]
        held, plan = take_all(state, None, plan, decided, actions)
        # It starts no ARC that names all its RCs, but reports the reasons to wait.
        priority.run_pass(state, actions, off_limits=held, plan=plan)


def decide(group: ConflictGroup, actions: Actions) -> Decision:
    """The best set of a group, unless the set that `priority` plans is as good."""
    proposals = None
    while proposals is None:
        if group.moves or group.waits or len(group.nogoods) > MAX_VETOES:
            return "left"
        # None: a known veto rules the set out; each round bars at least one more set.
        problem = group.problem()
        chosen = best(problem)
        if group.planned is not None and problem.key(chosen) <= problem.key(group.planned):
            return "left"
        proposals = group.missing_votes(chosen)
    if proposals:
        for rc, holders in proposals:
            actions.propose(rc, holders)
        return "open"
    return "left" if group.flickers(chosen) else chosen


def best(problem: PackingProblem) -> int:
    size = len(problem.items)
    packing = pack(problem, PACKING_WORK // max(1, size) if size <= MAX_PACKED else 0)
    if packing.exact:
        return packing.chosen
    search = LocalSearch(problem, packing.chosen)
    search.run(LOCAL_SEARCH_STEPS)
    found = max(packing.chosen, search.best, key=problem.key)
    return improve(problem, found) if solver_available() else found
