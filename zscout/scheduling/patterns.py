"""Needs by pattern: `framegrabber/*` is met by any one RC whose name it matches.

While an ARC waits, each check *binds* it: gives each of its patterns an RC of its own, the best choice of the instant.
So a bound ARC is like any other, and every strategy knows patterns. Where a bound RC keeps the ARC out, the check goes
on with the next best. A hold keeps its binding to its end.

The worst of an ARC's choices counts (`Fitness`): of two bindings, the one that gets by without the worse kind is taken,
by augmenting paths (Kuhn's algorithm), so that an ARC never waits where some choice of free RCs would let it run.
Between equals, the RC that is kept for the ARC's booking: others may be booked. Else the one that fewest wait for by
name: they have no other choice. Of sharable ones, the one that the ARC has already which it continues; else that of the
fewest holders.

Where holds have to end, the fewest and lowest-ranked do (`_least_ending`). Whoever holds an exclusive RC that the ARC
names ends anyway, and so all else that it holds is as good as free.

`optimal` is exact for the binding of the instant; it does not search all bindings of all ARCs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from operator import attrgetter
from typing import Final, NamedTuple

from zscout.scheduling.model import Arc, Rank, Rc, absences, union
from zscout.scheduling.reason import Reason, ReasonCode, of_rcs
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.state import SchedulerState
from zscout.types import Need


class Fitness(IntEnum):
    """How well an RC would do, the best first."""

    FREE = 0
    FREED = 1
    """Held by one that ends for it anyway."""
    CLAIMED = 2
    """Bound already to one that ranks before in this pass."""
    PREEMPTIBLE = 3
    """Held by one that is preempted for it."""
    RESERVED = 4
    """Reserved for another, or its vote is not known and it does not answer."""
    HELD = 5
    """Held by one that is not preempted for it, or it has refused."""


MAX_TRIED: Final = 200
"""Choices looked at for who has to end."""


class _Choice(NamedTuple):
    """An RC for a pattern. The least is the best."""

    fitness: Fitness
    tie: float
    """Decides between equals."""
    bit: int
    rc: Rc


def bind(state: SchedulerState, arc: Arc, reserved: Reservations | None, *, without: int = 0, claimed: int = 0) -> bool:
    """Binds `arc` to the best RCs there are but those of `without`; others are bound to those of `claimed` already (bit
    masks), and some its owner may not hold. False: there is no such binding; the old one stays."""
    taken = without | state.barred(arc) | arc.named_mask
    ending = set(_exclusive_victims(state, arc, arc.named_mask))
    options: dict[Need, list[_Choice]] = {}
    for need in arc.patterns:
        matching = (rc for rc in state.matching(need) if rc.present and not rc.bit & taken)
        options[need] = sorted(
            _Choice(*_fitness(state, arc, rc, reserved, claimed, ending), rc.bit, rc) for rc in matching
        )
    for worst in Fitness:
        allowed = {need: [one.rc for one in found if one.fitness <= worst] for need, found in options.items()}
        if all(allowed.values()) and (chosen := distinct(allowed)) is not None:
            if worst <= Fitness.PREEMPTIBLE and state.running:
                chosen = _least_ending(state, arc, chosen, options, claimed if worst < Fitness.CLAIMED else 0)
            state.bind(arc, {need: rc.name for need, rc in chosen.items()})
            return True
    return False


def _fitness(
    state: SchedulerState, arc: Arc, rc: Rc, reserved: Reservations | None, claimed: int, ending: Collection[Arc]
) -> tuple[Fitness, float]:
    """How well `rc` would do, where those who are `ending` do so anyway; and what decides between equals."""
    non_preemptible = rc.non_preemptible_holders(arc, state.now)
    closed = reserved is not None and reserved.reserves(rc, arc)
    kept = arc.claim is not None and bool(rc.bit & arc.claim.kept)
    if rc.sharable:
        answer = state.votes.known(rc.name, frozenset((*(holder.id for holder in non_preemptible), arc.id)))
        if closed or (answer is None and rc.name in state.votes.unresponsive):
            return Fitness.RESERVED, rc.demand
        if answer is not None and not answer.accept:
            return Fitness.HELD, rc.demand
        # What it continues ends for it; its device goes on only where it has the same RC.
        asked = arc.request
        goes_on = bool(asked.continues) and any(asked.goes_on_from(one.request) for one in rc.holders.values())
        return Fitness.FREE, -1 if goes_on or kept else len(rc.holders) + (answer is None)
    if non_preemptible:
        held_until = max(0 if one.hold is None else one.hold.end for one in non_preemptible)
        return Fitness.HELD, held_until
    if closed:
        return Fitness.RESERVED, rc.demand
    if others := [holder for holder in rc.holders.values() if holder not in ending]:
        return Fitness.PREEMPTIBLE, max(one.priority for one in others)
    if rc.bit & claimed:
        return Fitness.CLAIMED, rc.demand
    return Fitness.FREED if rc.holders else Fitness.FREE, -1 if kept else rc.demand


def _exclusive_victims(state: SchedulerState, arc: Arc, mask: int) -> Iterator[Arc]:
    """Who holds exclusive RCs of these, and is preempted for `arc`."""
    for rc in state.rcs_in(mask & ~state.sharable):
        yield from (one for one in rc.holders.values() if one.preemptible_by(arc, state.now))


def _victims(state: SchedulerState, arc: Arc, mask: int) -> set[Arc]:
    """Who ends if `arc` starts with these RCs, by steps 3b and 3c of `priority`. A vote that is not known counts as a
    yes: it is asked before anybody is preempted."""
    ending = set(_exclusive_victims(state, arc, mask))
    sharables, now = list(state.rcs_in(mask & state.sharable)), state.now
    kept = {rc: {arc.id, *(one.id for one in rc.non_preemptible_holders(arc, now))} for rc in sharables}
    sharers = {one for rc in sharables for one in rc.holders.values() if one.preemptible_by(arc, now)} - ending
    for sharer in sorted(sharers, key=attrgetter("rank")):
        shared = [rc for rc in sharables if sharer.id in rc.holders]
        answers = [state.votes.known(rc.name, frozenset((*kept[rc], sharer.id))) for rc in shared]
        if all(answer is None or answer.accept for answer in answers):
            for rc in shared:
                kept[rc].add(sharer.id)
        else:
            ending.add(sharer)
    return ending


def _least_ending(
    state: SchedulerState, arc: Arc, start: dict[Need, Rc], options: Mapping[Need, Sequence[_Choice]], claimed: int
) -> dict[Need, Rc]:
    """An RC of its own for each need, none of those `claimed`, so that the fewest holds end: first of those within
    their minimum runtimes, then of all, then the lowest-ranked. Branch and bound from `start`, the best of
    MAX_TRIED choices."""
    now, best = state.now, start

    def cost(ending: Collection[Arc]) -> tuple[int, int]:
        return sum(not one.past_min_runtime(now) for one in ending), len(ending)

    least = _victims(state, arc, arc.named_mask | union(rc.bit for rc in start.values()))
    if cost(least) == cost(set(_exclusive_victims(state, arc, arc.named_mask))):
        return start
    needs = sorted(options, key=lambda need: (len(options[need]), need))
    bits = {
        need: [(one.rc, one.bit) for one in found if one.fitness <= Fitness.PREEMPTIBLE and not one.bit & claimed]
        for need, found in options.items()
    }
    tried = 0

    def place(at: int, mask: int, chosen: dict[Need, Rc]) -> None:
        nonlocal best, least, tried
        if at == len(needs):
            ending = _victims(state, arc, mask)
            if (cost(ending), _ranks(least)) < (cost(least), _ranks(ending)):
                best, least = chosen, ending
            return
        for rc, bit in bits[needs[at]]:
            tried += 1
            if tried > MAX_TRIED:
                return
            if not bit & mask and cost(set(_exclusive_victims(state, arc, mask | bit))) <= cost(least):
                place(at + 1, mask | bit, {**chosen, needs[at]: rc})

    place(0, arc.named_mask, {})
    return best


def _ranks(arcs: Iterable[Arc]) -> list[Rank]:
    return sorted(arc.rank for arc in arcs)


def bind_all(state: SchedulerState, reserved: Reservations | None = None) -> None:
    """Binds all who wait by pattern, the best-ranked first, to different RCs as far as there are any."""
    claimed = 0
    for arc in sorted(state.by_pattern.values(), key=lambda arc: arc.rank):
        if bind(state, arc, reserved, claimed=claimed):
            claimed |= arc.mask & ~arc.named_mask
        else:
            state.bind(arc, {})


def no_match(state: SchedulerState, arc: Arc) -> Reason:
    """Which patterns keep an ARC from being bound at all."""
    there = {need: sum(rc.present for rc in state.matching(need)) for need in arc.patterns}
    # Those without any; else there are some for each, but not enough for all.
    short = sorted(need for need, count in there.items() if not count) or sorted(there)
    lost = [rc for need in short for rc in state.matching(need) if not rc.present]
    return of_rcs(ReasonCode.NO_MATCH, short, absences(dict.fromkeys(lost)))


def distinct(allowed: dict[Need, list[Rc]]) -> dict[Need, Rc] | None:
    """An RC of its own for each need, each the best that leaves one for the others; None: there is none."""
    owner: dict[int, Need] = {}
    chosen: dict[Need, Rc] = {}

    def place(need: Need, seen: set[int]) -> bool:
        for rc in allowed[need]:
            if rc.bit in seen:
                continue
            seen.add(rc.bit)
            if rc.bit not in owner or place(owner[rc.bit], seen):
                owner[rc.bit], chosen[need] = need, rc
                return True
        return False

    for need in sorted(allowed, key=lambda need: (len(allowed[need]), need)):
        if not place(need, set()):
            return None
    return chosen
