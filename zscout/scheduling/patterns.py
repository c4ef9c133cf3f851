"""Needs by pattern: `framegrabber/*` is met by any one RC whose name it matches.

While an ARC waits, each check *binds* it: gives each of its patterns an RC of its own, the best choice of the instant.
So a bound ARC is like any other, and every strategy knows patterns. Where a bound RC keeps the ARC out, the check goes
on with the next best. A hold keeps its binding to its end.

The worst of an ARC's choices counts (`Fitness`): of two bindings, the one that gets by without the worse kind is taken,
by augmenting paths (Kuhn's algorithm), so that an ARC never waits where some choice of free RCs would let it run.
Between equals, the RC that fewest wait for by name: they have no other choice.

`optimal` is exact for the binding of the instant; it does not search all bindings of all ARCs.
"""

from __future__ import annotations

from enum import IntEnum

from zscout.scheduling.model import Arc, Rc, absences
from zscout.scheduling.reason import Reason, ReasonCode, of_rcs
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.state import SchedulerState
from zscout.types import Need


class Fitness(IntEnum):
    """How well an RC would do, the best first."""

    FREE = 0
    CLAIMED = 1
    """Bound already to one that ranks before in this pass."""
    PREEMPTIBLE = 2
    """Held by one that is preempted for it."""
    RESERVED = 3
    """Reserved for another, or its vote is not known and it does not answer."""
    HELD = 4
    """Held by one that is not preempted for it, or it has refused."""


def bind(state: SchedulerState, arc: Arc, reserved: Reservations | None, *, without: int = 0, claimed: int = 0) -> bool:
    """Binds `arc` to the best RCs there are but those of `without`; others are bound to those of `claimed` already (bit
    masks), and some its owner may not hold. False: there is no such binding; the old one stays."""
    taken = without | state.barred(arc) | arc.named_mask
    options: dict[Need, list[tuple[int, float, int, Rc]]] = {}
    for need in arc.patterns:
        matching = (rc for rc in state.matching(need) if rc.present and not rc.bit & taken)
        options[need] = sorted((*_fitness(state, arc, rc, reserved, claimed), rc.bit, rc) for rc in matching)
    for worst in Fitness:
        allowed = {need: [rc for fitness, _, _, rc in found if fitness <= worst] for need, found in options.items()}
        if all(allowed.values()) and (chosen := distinct(allowed)) is not None:
            state.bind(arc, {need: rc.name for need, rc in chosen.items()})
            return True
    return False


def _fitness(
    state: SchedulerState, arc: Arc, rc: Rc, reserved: Reservations | None, claimed: int
) -> tuple[Fitness, float]:
    """How well `rc` would do, and what decides between equals."""
    non_preemptible = rc.non_preemptible_holders(arc, state.now)
    closed = reserved is not None and reserved.reserves(rc, arc)
    if rc.sharable:
        answer = state.votes.known(rc.name, frozenset((*(holder.id for holder in non_preemptible), arc.id)))
        if closed or (answer is None and rc.name in state.votes.unresponsive):
            return Fitness.RESERVED, rc.demand
        if answer is not None and not answer.accept:
            return Fitness.HELD, rc.demand
        return Fitness.FREE, len(rc.holders) + (answer is None)
    if non_preemptible:
        return Fitness.HELD, max(0 if one.hold is None else one.hold.end for one in non_preemptible)
    if closed:
        return Fitness.RESERVED, rc.demand
    if rc.holders:
        return Fitness.PREEMPTIBLE, max(one.priority for one in rc.holders.values())
    return (Fitness.CLAIMED if rc.bit & claimed else Fitness.FREE), rc.demand


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
