"""Strategy `optimal`: in each pass the best set of ARCs that could hold their RCs together.

The set's value is the vector of (ARC, RC) pairs in use by priority, highest first (`packing.py`). Each part
in play (`parts.py`) is decided for itself: by branch and bound where that is quick, else by CP-SAT if
OR-tools is installed (the extra `optimal`), else by local search.

Votes are asked as late as can be: the best set is sought as if every vote that is not known were a yes, and
only what that set needs is asked. A veto rules that set of holders out, and every larger one; then the next
best is sought. While votes are out nothing changes in that part.
"""

from __future__ import annotations

from typing import Final

from zscout.scheduling import cpsat, priority
from zscout.scheduling.floor import Floor
from zscout.scheduling.local_search import LocalSearch
from zscout.scheduling.model import Ns
from zscout.scheduling.packing import Problem, pack
from zscout.scheduling.parts import Part, parts_in_play
from zscout.scheduling.priority import Actions
from zscout.scheduling.votes import Votes

WORK: Final = 200_000
"""Steps of branch and bound, times items, before a part counts as large: some 20 ms. What is not proven by
then seldom is soon after."""
MAX_PACKED: Final = 80
"""Larger parts are not even tried by branch and bound: at 30x60 it takes 11 ms and CP-SAT 18, at 40x80 it
seldom comes to a proof."""
STEPS: Final = 6_000
"""Steps of local search for a large part."""


MAX_VETOES: Final = 256
"""Vetoes on one part. A voter gives no reason that could be reckoned with, so a proof may take a question for
each of very many sets; beyond so many vetoes `priority` decides the part."""


def run_pass(floor: Floor, votes: Votes, now: Ns, actions: Actions) -> None:
    """One pass at `now`."""
    held = 0
    for part in parts_in_play(floor, votes, now):
        if not decide(part, actions):
            held |= part.mask
    # Nothing is left for it to start; it tells those who wait what they wait for.
    priority.run_pass(floor, votes, now, actions, off_limits=held)


def decide(part: Part, actions: Actions) -> bool:
    """Takes the best set of a part, or leaves it to `priority`. False: votes are out; nothing changes yet."""
    questions = None
    while questions is None:
        if len(part.barred) > MAX_VETOES:
            return True
        # None: a veto that was known ruled it out, and each round bars at least one more set.
        questions = part.ask(chosen := best(part.problem()))
    if questions:
        for rc, holders in questions:
            actions.propose(rc, holders)
        return False
    part.take(chosen, actions)
    return True


def best(problem: Problem) -> int:
    """The best set, or the best that was found within the budget: never less than the heuristic finds."""
    size = len(problem.items)
    packing = pack(problem, WORK // max(1, size) if size <= MAX_PACKED else 0)
    if packing.exact:
        return packing.chosen
    search = LocalSearch(problem, packing.chosen)
    search.run(STEPS)
    found = max(packing.chosen, search.best, key=problem.key)
    return cpsat.improve(problem, found) if cpsat.available() else found
