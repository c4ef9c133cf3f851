"""Strategy `adaptive`: the heuristic, and a search only where a better set may exist.

A pass:

1. Reserve RCs for ARCs that have waited too long (`reservations.py`).
2. Find the undecided ARCs, in groups without a common RC (`conflict_groups.py`).
3. Compute each group's set by the heuristic, counting unknown votes as yes. If its value is the upper bound, it can't
   be improved, and the group is left to step 6.
4. For the other groups search the best set: by branch and bound, or by local search where that takes too long.
5. Ask for the votes that a better set needs, and take the set once they are in. While a group is searched or its votes
   are out, it is off limits; the other groups continue.
6. Run a pass of `priority` over the rest.

Search time is counted in steps. A pass takes one slice and requests another pass at once, so the RCM answers between
slices. A search works on a snapshot: when the group has changed, it restarts from the rest of its best set. Slices and
rounds of votes of a group are bounded; beyond them the group is left to `priority`.

The shorter an ARC's minimum runtime, the more each of its RCs is worth (`conflict_groups.density`). Each pass is worth
at least as much as a pass of `priority`, among the ARCs that no reservation holds back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling import priority
from zscout.scheduling.conflict_groups import ConflictGroup, Decision, conflict_groups, take_all
from zscout.scheduling.local_search import LocalSearch
from zscout.scheduling.model import Rc
from zscout.scheduling.packing import PackingItem, PackingProblem, numbers, pack
from zscout.scheduling.plan import dry_run
from zscout.scheduling.reason import Reason, ReasonCode
from zscout.scheduling.reservations import Reservations, reservations
from zscout.scheduling.state import Actions, SchedulerState, Strategy
from zscout.scheduling.votes import HolderSet
from zscout.types import ArcId

PACKING_WORK: Final = 20_000
"""The budget of a pass for branch and bound, in steps times items: some 3 ms."""
MAX_PACKED: Final = 60
"""Larger groups go to local search at once."""
SLICE_STEPS: Final = 150
"""Steps of local search in one pass: some 3 ms."""
MAX_STARTABLE: Final = 1_000
"""If more ARCs could start at one instant, `priority` decides."""
MAX_STEPS: Final = 6_500
MAX_SLICES: Final = 48
"""Passes that search one group, restarts included."""
MAX_ROUNDS: Final = 16
"""Rounds of votes on one group."""

SEARCHING: Final = Reason(ReasonCode.SEARCHING)


def steps_for(size: int) -> int:
    """Steps of local search for a group of `size` ARCs: 246 for 100, 5,480 for 600."""
    return min(MAX_STEPS, size * (85 + size) // 75)


@dataclass(slots=True)
class _Search:
    items: list[PackingItem]
    arcs: list[ArcId]
    nogoods: set[int]
    problem: PackingProblem
    heuristic: int
    best: int
    begun: bool = False
    inexact: bool = False  # not proven optimal: votes must first accept the heuristic's set, the baseline
    local: LocalSearch | None = None  # None before the search begins, and after it has ended
    steps: int = 0
    slices: int = 0
    rounds: int = 0
    last_proposals: list[tuple[Rc, HolderSet]] | None = None

    @property
    def exhausted(self) -> bool:
        return self.slices >= MAX_SLICES or self.rounds >= MAX_ROUNDS

    def fits(self, group: ConflictGroup) -> bool:
        return (
            self.items == group.items
            and self.arcs == [arc.id for arc in group.arcs]
            and self.nogoods == group.nogoods
            and group.planned in {None, self.heuristic}
        )

    @property
    def gains(self) -> bool:
        return self.problem.value(self.best) > self.problem.value(self.heuristic)


class Adaptive(Strategy):
    name: StrategyName = "adaptive"

    def __init__(self) -> None:
        self._log_line = ""
        self._reserved: Reservations | None = None
        self._searches: dict[ArcId, _Search] = {}
        self._work = 0  # the rest of `PACKING_WORK` in this pass
        self._steps = 0  # the rest of `SLICE_STEPS` in this pass
        self._unfinished: list[_Search] = []
        self._seen: tuple[int, ...] = ()  # the `_situation` of the unfinished searches

    def log_line(self) -> str:
        line, self._log_line = self._log_line, ""
        return line

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        if self._reserved is None and not state.claims and not self._searches and _is_single_without_choice(state):
            priority.run_pass(state, actions)
            return
        self._work, self._steps = PACKING_WORK, SLICE_STEPS
        if self._unfinished and self._nothing_new(state) and not any(map(self._advance, self._unfinished)):
            actions.run_again()
            return
        before, self._searches, self._unfinished = self._searches, {}, []
        reserved = self._reserve(state)
        plan = dry_run(state, reserved)
        groups = conflict_groups(state, reserved, MAX_STARTABLE, plan)
        decided = [(group, self._decide(group, before, actions)) for group in groups]
        held, plan = take_all(state, reserved, plan, decided, actions)
        priority.run_pass(state, actions, off_limits=held, reserved=reserved, plan=plan)
        if state.queued and reserved is not None and reserved.starving and not reserved.current:
            actions.run_again()  # reservations may have changed, and no longer hold back some ARCs
        self._seen = _situation(state)

    def _reserve(self, state: SchedulerState) -> Reservations | None:
        """Reserve for the starving ARCs. ARCs that an ended or changed reservation held back are checked again."""
        if state.policy.patience is None and not state.claims and self._reserved is None:
            return None
        before = self._reserved
        reserved = reservations(state, before)
        self._reserved = reserved if reserved.bits else None
        if before is not None and before is not reserved:
            state.index.freed |= reserved.changed(before)
        return reserved

    def _nothing_new(self, state: SchedulerState) -> bool:
        index, votes = state.index, state.votes
        changed = index.freed or index.touched or votes.answered or votes.invalidated or votes.due(state.now)
        return not changed and self._seen == _situation(state)

    def _decide(self, group: ConflictGroup, before: dict[ArcId, _Search], actions: Actions) -> Decision:
        earlier = list({id(known): known for arc in group.arcs if (known := before.get(arc.id))}.values())
        if group.waits:
            return "left"
        while (search := self._search(group, earlier)) is not None:
            self._searches.update(dict.fromkeys(search.arcs, search))
            if search.exhausted:
                return "left"
            if not search.begun and self._work > 0:
                self._begin(search)
            outcome = self._propose_missing(group, search, search.heuristic, actions) if search.inexact else "yes"
            if outcome == "yes":
                if not self._advance(search):
                    for arc in group.arcs:
                        if arc.hold is None:
                            actions.wait(arc, SEARCHING, settled=False)
                    self._unfinished.append(search)
                    actions.run_again()
                    return "open"
                if not search.gains:
                    return "left"
                outcome = self._propose_missing(group, search, search.best, actions)
            if outcome == "yes":
                if group.flickers(search.best):
                    return "left"
                self._report_gain(group, search)
                return search.best
            if outcome == "open":
                return "open"
            earlier = [search]
        return "left"

    def _propose_missing(
        self, group: ConflictGroup, search: _Search, chosen: int, actions: Actions
    ) -> Literal["yes", "no", "open"]:
        """Ask for the unknown votes on a set. `no`: a veto or a silent RC rules the set out, and it is barred now."""
        proposals = group.missing_votes(chosen)
        if proposals == []:
            return "yes"
        if proposals is None or proposals != search.last_proposals:
            search.rounds += 1
            search.last_proposals = proposals
        if proposals is None:
            return "no"
        for rc, holders in proposals:
            actions.propose(rc, holders)
        return "open"

    def _search(self, group: ConflictGroup, earlier: list[_Search]) -> _Search | None:
        if len(earlier) == 1 and earlier[0].fits(group):
            return earlier[0]
        problem = group.problem()
        heuristic = problem.complete() if group.planned is None else group.planned
        if group.moves or problem.value(heuristic) >= problem.upper_bound_of_all():
            return None
        arcs = [arc.id for arc in group.arcs]
        preferred = problem.complete(_warm_start(earlier, arcs)) if earlier else heuristic
        best = max(heuristic, preferred, key=problem.key)
        search = _Search(list(group.items), arcs, set(group.nogoods), problem, heuristic, best)
        for known in earlier:
            search.steps = max(search.steps, known.steps)
            search.slices = max(search.slices, known.slices)
            search.rounds = max(search.rounds, known.rounds)
        return search

    def _advance(self, search: _Search) -> bool:
        """Continue a search with the steps left in this pass. Return True if it has ended."""
        if search.exhausted or not search.begun:
            return search.exhausted
        local = search.local
        if local is None:
            return True
        limit = steps_for(len(search.items))
        search.slices += self._steps > 0
        took = local.run(min(self._steps, limit - local.steps))
        self._steps -= took
        search.steps += took
        search.best = max(search.best, local.best, key=search.problem.key)
        if local.done or local.steps >= limit:
            search.local = None
        return search.local is None

    def _begin(self, search: _Search) -> None:
        search.begun = True
        problem, size = search.problem, len(search.items)
        if size <= MAX_PACKED:
            packing = pack(problem, PACKING_WORK // size)
            self._work -= packing.nodes * size
            search.steps += packing.nodes
            if packing.exact:
                search.best = packing.chosen
                return
            search.best = max(search.best, packing.chosen, key=problem.key)
        search.inexact = True
        search.local = LocalSearch(problem, search.best)

    def _report_gain(self, group: ConflictGroup, search: _Search) -> None:
        was, found = _pairs(group, search.heuristic), _pairs(group, search.best)
        changed = [
            f"at priority {level}: {was[level]} -> {found[level]}" for level in found if found[level] != was[level]
        ]
        self._log_line = f"adaptive: RC assignments {', '.join(changed)}, in {search.steps} steps"


def _is_single_without_choice(state: SchedulerState) -> bool:
    """Return True for the usual case of one waiting ARC whose victims are obvious: `priority` is enough."""
    if len(state.queued) != 1 or state.policy.promise != "equals":
        return False
    (arc,) = state.queued.values()
    shared = (holder for rc in arc.rcs if rc.sharable for holder in rc.holders.values())
    return not arc.patterns and not any(holder.preemptible_by(arc, state.now) for holder in shared)


def _situation(state: SchedulerState) -> tuple[int, ...]:
    return (state.entries, len(state.queued), len(state.running), state.present, state.sharable)


def _warm_start(earlier: list[_Search], arcs: list[ArcId]) -> int:
    wanted = {search.arcs[number] for search in earlier for number in numbers(search.best)}
    return sum(1 << number for number, arc in enumerate(arcs) if arc in wanted)


def _pairs(group: ConflictGroup, chosen: int) -> dict[int, int]:
    pairs = dict.fromkeys(sorted({arc.priority for arc in group.arcs}, reverse=True), 0)
    for number in numbers(chosen):
        item = group.items[number]
        if not item.past_min_runtime:
            pairs[group.arcs[number].priority] += item.width
    return pairs
