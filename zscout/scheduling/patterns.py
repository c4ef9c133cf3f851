"""Needs by pattern: `framegrabber/*` is met by any one RC whose name it matches.

While an ARC waits, each check *binds* its patterns to separate RCs, the best at that instant. A bound ARC is like any
other, so every strategy supports patterns. Where a bound RC keeps the ARC out, the check tries the next best. A hold
keeps its binding to its end.

Bindings are compared by the worst RC in them (`Fitness`). The best one is found by augmenting paths (Kuhn's algorithm),
so an ARC never waits where some choice of free RCs would let it run. Ties: the RC kept for the ARC's booking, then the
RC least wanted by ARCs that name it (`Rc.wanted`). Ties of sharable RCs: the RC of the ARC that it continues, then the
RC with the fewest holders. The bindings of a pass are found together (`plan.py`).

Where holds have to end, the fewest and lowest-ranked do (`_least_ending`). Holders of named exclusive RCs end anyway,
so their other RCs count as free.

`optimal` is exact for the bindings of the instant; it does not search all bindings of all ARCs."""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from operator import attrgetter
from typing import Final, NamedTuple

from zscout.scheduling.model import Arc, PatternClass, Rank, Rc, absences, union
from zscout.scheduling.reason import Reason, ReasonCode, of_rcs
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.state import SchedulerState
from zscout.types import Need, Ns, RcName


class Fitness(IntEnum):
    """How well an RC suits an ARC, best first."""

    FREE = 0
    FREED = 1
    """Its holder ends for the ARC anyway."""
    CLAIMED = 2
    """Already bound to a higher rank in this pass."""
    PREEMPTIBLE = 3
    RESERVED = 4
    """Reserved for another, or unresponsive with an unknown vote."""
    HELD = 5
    """Its holder stays, or it has refused the ARC."""


MAX_TRIED: Final = 200
"""Choices tried to find the fewest victims."""


class _Choice(NamedTuple):
    """An RC for a pattern, in order of preference."""

    fitness: Fitness
    tie: tuple[float, ...]
    bit: int
    rc: Rc


class Choices:
    """The RCs that an ARC with patterns may have at this instant, and the best bindings to them."""

    def __init__(self, state: SchedulerState, arc: Arc, closed: int) -> None:
        """`closed`: bits of RCs reserved for others."""
        like = class_of(arc)
        self._state, self._arc, self._masks = state, arc, like.masks
        ending = set(_exclusive_victims(state, arc, arc.named_mask))
        there = like.reach & state.open_to(arc.priority)
        free = there & ~(closed | state.busy | state.sharable | (0 if arc.claim is None else arc.claim.kept))
        self._there, self._held = there, there & ~(free | state.sharable | usable(state, arc))
        self._best_first = [_Choice(Fitness.FREE, rc.wanted, rc.bit, rc) for rc in state.rcs_in(free)]
        self._best_first += [
            _Choice(*_fitness(state, arc, rc, bool(rc.bit & closed), ending), rc.bit, rc)
            for rc in state.rcs_in(there & ~(free | self._held))
        ]
        self._best_first.sort()
        self.contended = union(choice.bit for choice in self._best_first if choice.fitness <= Fitness.PREEMPTIBLE)
        """Bits of the RCs for which claims by others matter."""
        self._found: dict[tuple[int, int], Mapping[Need, RcName] | None] = {}

    def best(self, *, without: int = 0, claimed: int = 0) -> Mapping[Need, RcName] | None:
        """The best binding outside `without`, where others are bound to `claimed` RCs (bit masks); None: none."""
        key = without, claimed & self.contended
        if key not in self._found:
            self._found[key] = self._bind(*key)
        return self._found[key]

    def first(self, mask: int) -> Rc | None:
        """The best RC in `mask` that may serve the ARC now."""
        usable = _count(self._best_first, Fitness.PREEMPTIBLE)
        return next((choice.rc for choice in self._best_first[:usable] if choice.bit & mask), None)

    def _bind(self, without: int, claimed: int) -> Mapping[Need, RcName] | None:
        found = self._best_first
        if without:
            found = [choice for choice in found if not choice.bit & without]
        if claimed:
            free = found[: _count(found, Fitness.FREED)]
            taken = [choice for choice in free if choice.bit & claimed and not choice.rc.sharable]
            taken = [_Choice(Fitness.CLAIMED, choice.tie, choice.bit, choice.rc) for choice in taken]
            left = [choice for choice in free if not choice.bit & claimed or choice.rc.sharable]
            found = [*left, *sorted(taken), *found[len(free) :]]
        numbers = Counter(self._masks.values())
        fit = {mask: list[Rc]() for mask in numbers}
        seen = 0
        for worst in Fitness:
            if worst is Fitness.HELD:
                rcs = self._state.rcs_in(self._held & ~without)
                held = [_Choice(worst, (_held_until(rc.holders.values()),), rc.bit, rc) for rc in rcs]
                found = sorted([*found, *held])
            more = found[seen : _count(found, worst)]
            seen += len(more)
            for mask, some in fit.items():
                some += [choice.rc for choice in more if choice.bit & mask]
            if any(len(fit[mask]) < number for mask, number in numbers.items()):
                continue
            if (chosen := distinct({need: fit[mask] for need, mask in self._masks.items()})) is not None:
                if worst <= Fitness.PREEMPTIBLE and self._state.running:
                    claimed = claimed if worst < Fitness.CLAIMED else 0
                    there = self._there & ~without
                    chosen = _least_ending(self._state, self._arc, chosen, found, there, claimed)
                return {need: rc.name for need, rc in chosen.items()}
        return None


def _count(best_first: Sequence[_Choice], worst: Fitness) -> int:
    return bisect_right(best_first, worst, key=attrgetter("fitness"))


def choices(state: SchedulerState, arc: Arc, reserved: Reservations | None) -> Choices:
    """The choices of a queued ARC with patterns; shared by its class, unless votes or bookings matter."""
    like, reserved_bits = class_of(arc), 0 if reserved is None else usable(state, arc) & reserved.bits
    closed = union(rc.bit for rc in state.rcs_in(reserved_bits) if reserved is not None and reserved.reserves(rc, arc))
    if not _are_shared(state, arc):
        return Choices(state, arc, closed)
    versions = state.version, state.demand_version
    if like.choices_of != versions:
        like.choices, like.choices_of = {}, versions
    found = like.choices.get(closed)
    if not isinstance(found, Choices):
        found = like.choices[closed] = Choices(state, arc, closed)
    return found


def _are_shared(state: SchedulerState, arc: Arc) -> bool:
    """Return True if members of its class with the same RCs reserved for others have the same choices."""
    matters = (class_of(arc).reach | arc.named_mask) & state.sharable
    return not matters and not usable(state, arc) & state.dates.claimed


def class_of(arc: Arc) -> PatternClass:
    if arc.like is None:
        raise ValueError(f"ARC {arc.id} is not queued, or has no pattern")
    return arc.like


def bind(state: SchedulerState, arc: Arc, reserved: Reservations | None) -> bool:
    """Return False if no binding exists."""
    bound = choices(state, arc, reserved).best()
    state.bind(arc, bound or {})
    return bound is not None


def usable(state: SchedulerState, arc: Arc) -> int:
    """Bits of the matching RCs that are open to the ARC and, if exclusive, free or preemptible."""
    like = class_of(arc)
    if like.usable_of != state.version:
        like.usable_of, like.usable = state.version, like.reach & state.open_to(arc.priority)
        held = like.usable & state.busy
        while held:
            (holder,) = next(state.rcs_in(held)).holders.values()
            if not holder.preemptible_by(arc, state.now):
                like.usable &= ~(held & holder.mask)
            held &= ~holder.mask
        like.short = not enough(mask & like.usable for mask in like.masks.values())
    return like.usable


def short(state: SchedulerState, arc: Arc) -> bool:
    """Return True if too few RCs are usable for any binding."""
    usable(state, arc)
    return class_of(arc).short


def alternatives(state: SchedulerState, arc: Arc) -> int:
    masks = class_of(arc).masks
    return union(masks[need] & state.sharable for need, rc in arc.bound.items() if state.rc(rc).sharable)


def all_present(state: SchedulerState, arc: Arc) -> bool:
    """Return True if enough RCs are present for all patterns."""
    return enough(mask & state.open_to(arc.priority) for mask in class_of(arc).masks.values())


def enough(masks: Iterable[int]) -> bool:
    """Return True if each mask can have a bit of its own (Kuhn's algorithm)."""
    wanted = sorted(masks, key=int.bit_count)
    owner: dict[int, int] = {}
    taken = 0

    def place(number: int, seen: list[int]) -> bool:
        nonlocal taken
        if free := wanted[number] & ~taken:
            owner[free & -free] = number
            taken |= free & -free
            return True
        while left := wanted[number] & ~seen[0]:
            bit = left & -left
            seen[0] |= bit
            if place(owner[bit], seen):
                owner[bit] = number
                return True
        return False

    return all(place(number, [0]) for number in range(len(wanted)))


def _fitness(
    state: SchedulerState, arc: Arc, rc: Rc, closed: bool, ending: Collection[Arc]
) -> tuple[Fitness, tuple[float, ...]]:
    """The fitness of `rc` and a tie-breaker. `closed`: reserved for another; `ending`: holders that end anyway."""
    non_preemptible = rc.non_preemptible_holders(arc, state.now)
    kept = arc.claim is not None and bool(rc.bit & arc.claim.kept)
    if rc.sharable:
        answer = state.votes.known(rc.name, frozenset((*(holder.id for holder in non_preemptible), arc.id)))
        if closed or (answer is None and rc.name in state.votes.unresponsive):
            return Fitness.RESERVED, rc.wanted
        if answer is not None and not answer.accept:
            return Fitness.HELD, rc.wanted
        # The ARC that it continues ends for it; its device continues only on the same RC.
        request = arc.request
        continues_here = bool(request.continues) and any(
            request.continues_from(holder.request) for holder in rc.holders.values()
        )
        return Fitness.FREE, (-1 if continues_here or kept else len(rc.holders) + (answer is None),)
    if non_preemptible:
        return Fitness.HELD, (_held_until(non_preemptible),)
    if closed:
        return Fitness.RESERVED, rc.wanted
    if others := [holder for holder in rc.holders.values() if holder not in ending]:
        return Fitness.PREEMPTIBLE, (max(holder.priority for holder in others),)
    return Fitness.FREED if rc.holders else Fitness.FREE, () if kept else rc.wanted


def _held_until(holders: Iterable[Arc]) -> Ns:
    return max(0 if holder.hold is None else holder.hold.end for holder in holders)


def _exclusive_victims(state: SchedulerState, arc: Arc, mask: int) -> Iterator[Arc]:
    for rc in state.rcs_in(mask & ~state.sharable):
        yield from (holder for holder in rc.holders.values() if holder.preemptible_by(arc, state.now))


def _victims(state: SchedulerState, arc: Arc, mask: int) -> set[Arc]:
    """The victims if `arc` starts with these RCs, by steps 3b and 3c of `priority`. Unknown votes count as yes, as RCs
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
    state: SchedulerState, arc: Arc, start: dict[Need, Rc], best_first: Sequence[_Choice], there: int, claimed: int
) -> dict[Need, Rc]:
    """Separate RCs for all needs, none of `claimed`, with the fewest victims: first of victims within their minimum
    runtimes, then of all, then the lowest-ranked. Branch and bound from `start`, over MAX_TRIED choices at most.
    `there`: bits of all RCs that could be chosen."""
    if not arc.named_mask & state.sharable and not any(rc.holders for rc in start.values()):
        return start
    now, best = state.now, start

    def cost(ending: Collection[Arc]) -> tuple[int, int]:
        return sum(not victim.past_min_runtime(now) for victim in ending), len(ending)

    least = _victims(state, arc, arc.named_mask | union(rc.bit for rc in start.values()))
    if cost(least) == cost(set(_exclusive_victims(state, arc, arc.named_mask))):
        return start
    masks = class_of(arc).masks
    needs = sorted(masks, key=lambda need: ((there & masks[need]).bit_count(), need))
    fit = [choice for choice in best_first if choice.fitness <= Fitness.PREEMPTIBLE and not choice.bit & claimed]
    bits = {need: [(choice.rc, choice.bit) for choice in fit if choice.bit & mask] for need, mask in masks.items()}
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


def bind_all(state: SchedulerState, reserved: Reservations | None = None, claimed: int = 0) -> None:
    """Find bindings of all queued ARCs with patterns (`PatternClass.bound`), best-ranked first, to different RCs as
    far as possible, and to others than the `claimed`. Once the claims of a class no longer change its choices, its
    other members get the same binding, until other classes claim RCs that matter to it."""
    asleep = dict[PatternClass, int]()  # such classes, with bits of the RCs that matter
    heap = [(like.members[0], number, like) for number, like in enumerate(state.classes.values())]
    numbers = {like: number for _, number, like in heap}
    heapq.heapify(heap)
    for like in state.classes.values():
        like.turns.clear()
    while heap:
        rank, _, like = heapq.heappop(heap)
        arc = state.queued[rank[-1]]
        found = choices(state, arc, reserved)
        bound = found.best(claimed=claimed) or {}
        like.turns.append((rank, bound))
        new = state.mask(bound.values()) & ~claimed
        claimed |= new
        awake = [other for other, contended in asleep.items() if contended & new]
        reserved_bits = 0 if reserved is None else reserved.bits
        if not (found.contended & new or usable(state, arc) & reserved_bits) and _are_shared(state, arc):
            asleep[like] = found.contended
        else:
            awake.append(like)
        for other in awake:
            asleep.pop(other, None)
            if (at := bisect_right(other.members, rank)) < len(other.members):
                heapq.heappush(heap, (other.members[at], numbers[other], other))


def no_match(state: SchedulerState, arc: Arc) -> Reason:
    to = state.open_to(arc.priority)
    there = {need: state.matching_mask(need) & to for need in arc.patterns}
    # The patterns without any RC; else all patterns, as there are too few RCs for them together.
    short = sorted(need for need, mask in there.items() if not mask) or sorted(there)
    lost = [rc for mask in map(state.matching_mask, short) for rc in state.rcs_in(mask & ~to)]
    return of_rcs(ReasonCode.NO_MATCH, short, absences(dict.fromkeys(lost)))


def distinct(allowed: dict[Need, list[Rc]]) -> dict[Need, Rc] | None:
    """Separate RCs for all needs, each the best that leaves RCs for the others; None: impossible."""
    if (chosen := _apart(allowed)) is not None:
        return chosen
    owner: dict[int, Need] = {}
    chosen = {}

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


def _apart(allowed: dict[Need, list[Rc]]) -> dict[Need, Rc] | None:
    """`distinct`, if any two needs have the same RCs or none in common; None: they don't, or it is impossible."""
    lists = {id(rcs): rcs for rcs in allowed.values()}
    seen = 0
    for rcs in lists.values() if len(lists) > 1 else ():
        mask = union(rc.bit for rc in rcs)
        if mask & seen:
            return None
        seen |= mask
    needs: dict[int, list[Need]] = {}
    for need in sorted(allowed, reverse=True):
        needs.setdefault(id(allowed[need]), []).append(need)
    if any(len(lists[key]) < len(some) for key, some in needs.items()):
        return None
    # As in `distinct`, the need placed last takes the best RC, and the earlier ones move up.
    return {need: rc for key, some in needs.items() for need, rc in zip(some, lists[key], strict=False)}
