"""Strategy `adaptive`: the heuristic, and a search for the better set only where there may be one.

Each part in play (`parts.py`) is looked at before the heuristic acts, as if every vote that is not known
were a yes. Where the heuristic's own set reaches the bound, nothing can be gained: `priority` decides, at
its own cost. Elsewhere branch and bound looks for the best set, and local search where that takes too long.
If something better is found, its votes are asked for, and it is taken; otherwise `priority` decides.

Nobody waits long for a search. Its time is counted in steps, a pass takes one slice of them, and another
pass is asked for at once, so that the RCM answers between two slices. While a part is searched or its votes
are out, it is off limits and all others go on. A search works on a snapshot: when the part has changed, it
starts again from what is left of the best set. A part has only so many slices and rounds of votes, whatever
happens meanwhile; then the best set that needs no more votes is taken, or `priority` decides.

In each pass the outcome is worth at least what that of `priority` is, among those whom no reservation
against starving (`reservations.py`) holds back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from zscout.scheduling import priority
from zscout.scheduling.floor import Floor
from zscout.scheduling.local_search import LocalSearch
from zscout.scheduling.model import ArcId, Ns, RcName
from zscout.scheduling.packing import Item, Problem, numbers, pack
from zscout.scheduling.parts import Part, parts_in_play
from zscout.scheduling.priority import Actions
from zscout.scheduling.reservations import Reservations, reservations
from zscout.scheduling.votes import HolderSet, Votes

WORK: Final = 20_000
"""Steps of branch and bound, times items: some 3 ms."""
MAX_PACKED: Final = 60
"""Larger parts go to local search at once."""
SLICE: Final = 150
"""Steps of local search in one pass: some 3 ms."""
MAX_IN_PLAY: Final = 1_000
"""Where more ARCs than that could start at one instant, `priority` decides."""
MAX_STEPS: Final = 6_500
MAX_SLICES: Final = 48
"""Passes for which one part is searched at most, begun anew or not."""
MAX_ROUNDS: Final = 16
"""Rounds of votes likewise."""

_Asked: TypeAlias = Literal["yes", "no", "open"]
YES: Final = "yes"
NO: Final = "no"
OPEN: Final = "open"

SEARCHING: Final = "a better schedule is sought"


def steps_for(size: int) -> int:
    """Steps that a part of so many ARCs is worth: 246 for 100, 5,480 for 600."""
    return min(MAX_STEPS, size * (85 + size) // 75)


@dataclass(slots=True)
class Gain:
    """A better set that was taken: pairs in use at each priority, there and by the heuristic."""

    at: Ns
    pairs: dict[int, int]
    heuristic: dict[int, int]
    steps: int

    def __str__(self) -> str:
        changed = [
            f"{self.heuristic[level]} to {self.pairs[level]} at priority {level}"
            for level in sorted(self.pairs, reverse=True)
            if self.pairs[level] != self.heuristic[level]
        ]
        return f"pairs in use from {', '.join(changed)}, in {self.steps} steps"


@dataclass(slots=True)
class Statistics:
    """What the strategy did so far, and what it cost."""

    passes: int = 0
    searches: int = 0
    """Parts for which the bound left something."""
    steps: int = 0
    gains: int = 0
    given_up: int = 0
    """Searches that used up their slices or rounds of votes."""
    last: Gain | None = None


@dataclass(slots=True)
class _Search:
    """The search in one part, kept from pass to pass."""

    items: list[Item]
    arcs: list[ArcId]
    barred: set[int]
    problem: Problem
    heuristic: int
    best: int
    begun: bool = False
    loose: bool = False
    """Its best may not be the best of all. The heuristic's set then has to be one that votes allow: what
    they make of it otherwise might be worth more than the best."""
    local: LocalSearch | None = None
    """None before it begins, and once there is nothing more to look for."""
    steps: int = 0
    slices: int = 0
    rounds: int = 0
    asked: list[tuple[RcName, HolderSet]] | None = None
    """The last round."""
    over: bool = False
    """The part has had its time: it is `priority`'s from now on."""

    def fits(self, part: Part) -> bool:
        return (
            self.items == part.items
            and self.arcs == [arc.id for arc in part.arcs]
            and self.barred == part.barred
        )

    @property
    def gains(self) -> bool:
        return self.problem.value(self.best) > self.problem.value(self.heuristic)


class Adaptive:
    """One run of the strategy. It keeps unfinished searches, so each core has its own."""

    def __init__(self) -> None:
        self.statistics = Statistics()
        self._reserved: Reservations | None = None
        self._searches: dict[ArcId, _Search] = {}
        self._work = 0
        """What this pass may still spend on branch and bound."""
        self._steps = 0
        """Steps of local search likewise."""
        self._unfinished: list[_Search] = []
        self._seen: tuple[int, ...] = ()
        """The situation in which they are unfinished."""

    def __call__(self, floor: Floor, votes: Votes, now: Ns, actions: Actions) -> None:
        """One pass at `now`."""
        self.statistics.passes += 1
        if self._reserved is None and not self._searches and _one_without_choice(floor, now):
            priority.run_pass(floor, votes, now, actions)
            return
        self._work, self._steps = WORK, SLICE
        if self._unfinished and self._nothing_new(floor, votes, now) and self._go_on():
            actions.again()
            return
        before, self._searches, self._unfinished = self._searches, {}, []
        held = 0
        reserved = self._reserve(floor, votes, now)
        for part in parts_in_play(floor, votes, now, reserved, MAX_IN_PLAY):
            if not self._decide(part, before, actions):
                held |= part.mask
        priority.run_pass(floor, votes, now, actions, off_limits=held, reserved=reserved)
        self._seen = _situation(floor)

    def _reserve(self, floor: Floor, votes: Votes, now: Ns) -> Reservations | None:
        """What is kept for the owed in this pass; those who were held back by what is kept no more are
        looked at again."""
        patience = floor.policy.patience
        if patience is None:
            return None
        before = self._reserved
        reserved = reservations(floor, votes, now, patience, before)
        self._reserved = reserved if reserved.bits else None
        if before is not None and before is not reserved:
            floor.waits.freed |= reserved.changed(before)
        return reserved

    def _nothing_new(self, floor: Floor, votes: Votes, now: Ns) -> bool:
        """Whether a whole pass would only find everything as the last one left it."""
        waits = floor.waits
        stirred = waits.freed or waits.stirred or votes.heard or votes.forgotten or votes.due(now)
        return not stirred and self._seen == _situation(floor)

    def _go_on(self) -> bool:
        """Goes on with what is unfinished. False: something has come to its end."""
        return not any(self._bounded(search).over or self._look(search) for search in self._unfinished)

    def _decide(self, part: Part, before: dict[ArcId, _Search], actions: Actions) -> bool:
        """Takes the better set of a part, or leaves it to `priority`. False: it is off limits for now."""
        earlier = list({id(one): one for arc in part.arcs if (one := before.get(arc.id))}.values())
        while (search := self._search(part, earlier)) is not None:
            self._searches.update(dict.fromkeys(search.arcs, search))
            if search.over:
                return True
            if not search.begun and self._work > 0:
                self._begin(search)
            asked = self._ask(part, search, search.heuristic, actions) if search.loose else YES
            if asked == YES:
                if not self._look(search):
                    for arc in part.arcs:
                        if arc.hold is None:
                            actions.wait(arc, SEARCHING, settled=False)
                    self._unfinished.append(search)
                    actions.again()
                    return False
                if not search.gains:
                    return True
                asked = self._ask(part, search, search.best, actions)
            if asked == YES:
                self._note(part, search)
                part.take(search.best, actions)
                return True
            if asked == OPEN:
                return False
            earlier = [search]
        return True

    def _ask(self, part: Part, search: _Search, chosen: int, actions: Actions) -> _Asked:
        """Asks what is not known yet about a set. NO: a silent RC rules it out; that is barred now."""
        questions = part.ask(chosen)
        if questions == []:
            return YES
        sets = None if questions is None else [(rc.name, holders) for rc, holders in questions]
        if sets is None or sets != search.asked:
            search.rounds += 1
            search.asked = sets
        if questions is None:
            return NO
        for rc, holders in questions:
            actions.propose(rc, holders)
        return OPEN

    def _search(self, part: Part, earlier: list[_Search]) -> _Search | None:
        """The search in this part, as far as it has come; None where nothing can be gained."""
        if len(earlier) == 1 and earlier[0].fits(part):
            return self._bounded(earlier[0])
        problem = part.problem()
        heuristic = problem.complete()
        if problem.value(heuristic) >= problem.bound_of_all():
            return None
        arcs = [arc.id for arc in part.arcs]
        wish = problem.complete(_wish(earlier, arcs)) if earlier else heuristic
        best = max(heuristic, wish, key=problem.key)
        search = _Search(list(part.items), arcs, set(part.barred), problem, heuristic, best)
        for one in earlier:
            search.steps = max(search.steps, one.steps)
            search.slices = max(search.slices, one.slices)
            search.rounds = max(search.rounds, one.rounds)
            search.over |= one.over
        self.statistics.searches += not earlier
        return self._bounded(search)

    def _bounded(self, search: _Search) -> _Search:
        if not search.over and (search.slices >= MAX_SLICES or search.rounds >= MAX_ROUNDS):
            search.over, search.local = True, None
            self.statistics.given_up += 1
        return search

    def _look(self, search: _Search) -> bool:
        """Goes on with a search for as long as this pass has time. True: it is over."""
        if not search.begun:
            return False
        local = search.local
        if local is None:
            return True
        limit = steps_for(len(search.items))
        search.slices += self._steps > 0
        took = local.run(min(self._steps, limit - local.steps))
        self._steps -= took
        search.steps += took
        self.statistics.steps += took
        search.best = max(search.best, local.best, key=search.problem.key)
        if local.done or local.steps >= limit:
            search.local = None
        return search.local is None

    def _begin(self, search: _Search) -> None:
        search.begun = True
        problem, size = search.problem, len(search.items)
        if size <= MAX_PACKED:
            packing = pack(problem, WORK // size)
            self._work -= packing.nodes * size
            search.steps += packing.nodes
            self.statistics.steps += packing.nodes
            if packing.exact:
                search.best = packing.chosen
                return
            search.best = max(search.best, packing.chosen, key=problem.key)
        search.loose = True
        search.local = LocalSearch(problem, search.best)

    def _note(self, part: Part, search: _Search) -> None:
        self.statistics.gains += 1
        self.statistics.last = Gain(
            part.now, _pairs(part, search.best), _pairs(part, search.heuristic), search.steps
        )


def _one_without_choice(floor: Floor, now: Ns) -> bool:
    """Whether one ARC waits alone, and who would have to end for it is plain: the usual case where nothing is
    scarce, at the cost of `priority`."""
    if len(floor.queued) != 1 or floor.policy.promise != "equals":
        return False
    (arc,) = floor.queued.values()
    return not arc.slots and not any(
        holder.yields_to(arc, now) for rc in arc.rcs if rc.sharable for holder in rc.holders.values()
    )


def _situation(floor: Floor) -> tuple[int, ...]:
    """Differs when an ARC came, went, started or ended, or an RC came or went."""
    return (floor.turns, len(floor.queued), len(floor.running), floor.present, floor.sharable)


def _wish(earlier: list[_Search], arcs: list[ArcId]) -> int:
    """What earlier searches would have chosen, as far as it is still there."""
    wanted = {search.arcs[number] for search in earlier for number in numbers(search.best)}
    return sum(1 << number for number, arc in enumerate(arcs) if arc in wanted)


def _pairs(part: Part, chosen: int) -> dict[int, int]:
    pairs = dict.fromkeys(sorted({arc.priority for arc in part.arcs}, reverse=True), 0)
    for number in numbers(chosen):
        item = part.items[number]
        if not item.spent:
            pairs[part.arcs[number].priority] += item.width
    return pairs
