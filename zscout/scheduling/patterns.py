"""Needs by pattern: `framegrabber/*` is met by any one RC whose name it matches.

While an ARC waits, each check *binds* its patterns to separate RCs, the best at that instant. A bound ARC is like any
other, so every strategy supports patterns. Where a bound RC keeps the ARC out, the check tries the next best. A hold
keeps its binding to its end.

The worst of an ARC's choices counts (`Fitness`): the binding without the worse kind wins, found by augmenting paths
(Kuhn's algorithm), so an ARC never waits where some choice of free RCs would let it run. Ties: the RC kept for the
ARC's booking, then the RC that fewest ARCs wait for by name. Of sharable RCs: the RC of the ARC that it continues, then
the fewest holders.

Where holds have to end, the fewest and lowest-ranked do (`_least_ending`). Holders of named exclusive RCs end anyway,
so their other RCs count as free.

`optimal` is exact for the binding of the instant; it does not search all bindings of all ARCs."""

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
    """Its holder ends for the ARC anyway."""
    CLAIMED = 2
    """Bound already to a higher rank in this pass."""
    PREEMPTIBLE = 3
    RESERVED = 4
    """Reserved for another, or unresponsive with an unknown vote."""
    HELD = 5
    """Its holder stays, or it has refused."""


MAX_TRIED: Final = 200
"""Choices tried to minimise victims."""


class _Choice(NamedTuple):
    """An RC for a pattern. The least is the best."""

    fitness: Fitness
    tie: float
    bit: int
    rc: Rc


def bind(state: SchedulerState, arc: Arc, reserved: Reservations | None, *, without: int = 0, claimed: int = 0) -> bool:
    """Bind `arc` to the best RCs outside `without`, where `claimed` RCs are bound to others (bit masks). False: no
    binding exists; the old one stays."""
    taken = without | state.barred(arc) | arc.named_mask
    ending = set(_exclusive_victims(state, arc, arc.named_mask))
    options: dict[Need, list[_Choice]] = {}
    for need in arc.patterns:
        matching = (rc for rc in state.matching(need) if rc.present and not rc.bit & taken)
        options[need] = sorted(
            _Choice(*_fitness(state, arc, rc, reserved, claimed, ending), rc.bit, rc) for rc in matching
        )
    for worst in Fitness:
        allowed = {need: [choice.rc for choice in found if choice.fitness <= worst] for need, found in options.items()}
        if all(allowed.values()) and (chosen := distinct(allowed)) is not None:
            if worst <= Fitness.PREEMPTIBLE and state.running:
                chosen = _least_ending(state, arc, chosen, options, claimed if worst < Fitness.CLAIMED else 0)
            state.bind(arc, {need: rc.name for need, rc in chosen.items()})
            return True
    return False


def _fitness(
    state: SchedulerState, arc: Arc, rc: Rc, reserved: Reservations | None, claimed: int, ending: Collection[Arc]
) -> tuple[Fitness, float]:
    """The fitness of `rc` where the holders `ending` end anyway, and a tie-breaker."""
    non_preemptible = rc.non_preemptible_holders(arc, state.now)
    closed = reserved is not None and reserved.reserves(rc, arc)
    kept = arc.claim is not None and bool(rc.bit & arc.claim.kept)
    if rc.sharable:
        answer = state.votes.known(rc.name, frozenset((*(holder.id for holder in non_preemptible), arc.id)))
        if closed or (answer is None and rc.name in state.votes.unresponsive):
            return Fitness.RESERVED, rc.demand
        if answer is not None and not answer.accept:
            return Fitness.HELD, rc.demand
        # The ARC that it continues ends for it; its device continues only on the same RC.
        asked = arc.request
        continues_here = bool(asked.continues) and any(
            asked.continues_from(holder.request) for holder in rc.holders.values()
        )
        return Fitness.FREE, -1 if continues_here or kept else len(rc.holders) + (answer is None)
    if non_preemptible:
        held_until = max(0 if holder.hold is None else holder.hold.end for holder in non_preemptible)
        return Fitness.HELD, held_until
    if closed:
        return Fitness.RESERVED, rc.demand
    if others := [holder for holder in rc.holders.values() if holder not in ending]:
        return Fitness.PREEMPTIBLE, max(holder.priority for holder in others)
    if rc.bit & claimed:
        return Fitness.CLAIMED, rc.demand
    return Fitness.FREED if rc.holders else Fitness.FREE, -1 if kept else rc.demand


def _exclusive_victims(state: SchedulerState, arc: Arc, mask: int) -> Iterator[Arc]:
    for rc in state.rcs_in(mask & ~state.sharable):
        yield from (holder for holder in rc.holders.values() if holder.preemptible_by(arc, state.now))


def _victims(state: SchedulerState, arc: Arc, mask: int) -> set[Arc]:
    """The victims if `arc` starts with these RCs, by steps 3b and 3c of `priority`. Unknown votes count as yes: they
    are asked before a preemption."""
    ending = set(_exclusive_victims(state, arc, mask))
    sharables, now = list(state.rcs_in(mask & state.sharable)), state.now
    kept = {rc: {arc.id, *(holder.id for holder in rc.non_preemptible_holders(arc, now))} for rc in sharables}
    sharers = {holder for rc in sharables for holder in rc.holders.values() if holder.preemptible_by(arc, now)} - ending
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
    """Separate RCs for all needs, none of `claimed`, with the fewest victims: first within their minimum runtimes,
    then of all, then the lowest-ranked. Branch and bound from `start`, the best of MAX_TRIED choices."""
    now, best = state.now, start

    def cost(ending: Collection[Arc]) -> tuple[int, int]:
        return sum(not victim.past_min_runtime(now) for victim in ending), len(ending)

    least = _victims(state, arc, arc.named_mask | union(rc.bit for rc in start.values()))
    if cost(least) == cost(set(_exclusive_victims(state, arc, arc.named_mask))):
        return start
    needs = sorted(options, key=lambda need: (len(options[need]), need))
    bits = {
        need: [
            (choice.rc, choice.bit)
            for choice in found
            if choice.fitness <= Fitness.PREEMPTIBLE and not choice.bit & claimed
        ]
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
    """Bind all queued ARCs with patterns, best-ranked first, to different RCs as far as possible."""
    claimed = 0
    for arc in sorted(state.by_pattern.values(), key=lambda arc: arc.rank):
        if bind(state, arc, reserved, claimed=claimed):
            claimed |= arc.mask & ~arc.named_mask
        else:
            state.bind(arc, {})


def no_match(state: SchedulerState, arc: Arc) -> Reason:
    there = {need: sum(rc.present for rc in state.matching(need)) for need in arc.patterns}
    # Patterns without any RC; else all, as there are too few for all.
    short = sorted(need for need, count in there.items() if not count) or sorted(there)
    lost = [rc for need in short for rc in state.matching(need) if not rc.present]
    return of_rcs(ReasonCode.NO_MATCH, short, absences(dict.fromkeys(lost)))


def distinct(allowed: dict[Need, list[Rc]]) -> dict[Need, Rc] | None:
    """Separate RCs for all needs, each the best that leaves one for the others; None: impossible."""
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
