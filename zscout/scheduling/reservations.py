"""Bounded waiting: once an ARC has waited for the fleet's patience it is *due*, and nobody may pass it.

Shortest-first starves, and so does the larger set of ARCs where it is preferred to a smaller one. The remedy is that of
batch schedulers, reservation with conservative backfill (Mu'alem and Feitelson, IEEE TPDS 12(6), 2001), on distinct RCs
instead of many equal processors, and with a date: what is reserved is the time from which the ARC is due, so that no
ARC is held back that would be over by then. Minimum runtimes are exact, so reservations are.

From half its patience on, an ARC is *starving*. In the order of priority, then of waiting, each starving ARC is given
the earliest time, from when it is due, at which its RCs are free of the holders that are not preempted for it, and of
the ARCs that were starving before it. An ARC of equal or lower priority that shares an RC with it may start only if it
is over by then, or if the RC is sharable and accepts it beside everyone concerned.

`docs/scheduling.md` states the promise that follows, and what else was tried.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from zscout.scheduling.model import Arc, Rc, union
from zscout.scheduling.reason import Reason, ReasonCode
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import HolderSet
from zscout.types import Ns

MAX_STARVING: Final = 16
"""ARCs that have reservations at one time; those that starve after them follow as these start."""


class Reservation(NamedTuple):
    """An RC is reserved for `arc` from `start` on."""

    arc: Arc
    start: Ns


class Inadmissible(NamedTuple):
    """`rc` keeps an ARC out as long as its situation is this, or until the vote on `proposal` says otherwise."""

    rc: Rc
    reason: Reason
    proposal: HolderSet | None = None


def reservations(state: SchedulerState, patience: Ns, last: Reservations | None) -> Reservations:
    """What is reserved now: the `last` that was found, if nothing has changed that it depends on.

    Passing time alone does not change the RCs or their order; for an ARC already due no backfill is possible."""
    state.index.mark_starving(state.now - patience // 2, state.queued)
    if last is not None and last.made_of == _versions(state):
        return last
    return Reservations(state, patience)


def _versions(state: SchedulerState) -> tuple[int, int, int]:
    return state.version, state.votes.version, state.index.starving_version


class Reservations:
    """What is reserved for whom, of those starving."""

    def __init__(self, state: SchedulerState, patience: Ns) -> None:
        self._state, self._votes, self._patience = state, state.votes, patience
        self.by_rc: dict[int, list[Reservation]] = {}
        """By bit of the RC, the first that starved first; of an exclusive RC only the first."""
        self.bits = 0
        """RCs with reservations."""
        self._free: dict[int, Ns] = {}
        """By bit: when the earlier reservations of the RC end."""
        self.made_of = _versions(state)
        for _, _, arc in state.index.starving[:MAX_STARVING]:
            self._reserve(state.queued[arc])

    def _reserve(self, arc: Arc) -> None:
        rcs = self._rcs(arc)
        if not all(rc.present for rc in rcs):
            return
        start = max(self._within_quota(arc), *(self._free_from(rc, arc) for rc in rcs))
        if math.isinf(start):
            return
        reservation = Reservation(arc, max(int(start), self.due(arc)))
        for rc in rcs:
            reserved = self.by_rc.setdefault(rc.bit, [])
            if rc.sharable or not reserved:
                reserved.append(reservation)
            self._free[rc.bit] = max(self._free.get(rc.bit, 0), reservation.start + arc.request.min_runtime)
            self.bits |= rc.bit

    def _rcs(self, arc: Arc) -> list[Rc]:
        """The RCs to reserve. For each pattern the matching RC that is free earliest; an absent placeholder
        RC if none is left."""
        rcs = list(self._state.rcs_in(arc.named_mask)) if arc.patterns else list(arc.rcs)
        for need in arc.patterns:
            matching = self._state.matching(need)
            left = [rc for rc in matching if rc.present and rc not in rcs and not rc.bit & self._state.barred(arc)]
            rcs.append(min(left, key=lambda rc: (self._free_from(rc, arc), rc.bit), default=Rc(need, 0)))
        return rcs

    def _within_quota(self, arc: Arc) -> float:
        """When its owner has room for `arc`."""
        state, ends = self._state, [float(self._state.now)]
        if state.quota_left(arc) == 0:
            ends.append(min(one.known_end() for one in state.running.values() if one.owner == arc.owner))
        for quota in state.policy.rc_quotas.get(arc.owner, ()):
            running = [one for one in state.running.values() if one.owner in quota.owners]
            held = sum(len(one.rcs) for one in running)
            for one in sorted(running, key=lambda one: one.known_end()):
                if held + len(arc.request.needs) <= quota.rcs:
                    break
                ends.append(one.known_end())
                held -= len(one.rcs)
        return max(ends)

    def _free_from(self, rc: Rc, arc: Arc) -> float:
        """When `rc` has room for `arc` at the latest; infinite where that is not known."""
        non_preemptible = rc.non_preemptible_holders(arc, self._state.now)
        if rc.sharable:
            sharing = (reservation.arc.id for reservation in self.by_rc.get(rc.bit, ()))
            if self._votes.accepts(rc.name, frozenset((*(holder.id for holder in non_preemptible), *sharing, arc.id))):
                return self._state.now
            alone = self._votes.known(rc.name, frozenset((arc.id,)))
            if rc.name in self._votes.unresponsive or (alone is not None and not alone.accept):
                return math.inf
        return max((self._free.get(rc.bit, self._state.now), *(holder.known_end(arc) for holder in non_preemptible)))

    def due(self, arc: Arc) -> Ns:
        """When its patience is over."""
        return arc.since + self._patience

    def goes_first(self, arc: Arc) -> bool:
        """Whether `arc` goes before its equals that could start as well. A sharable RC may accept each
        backfilled ARC alone but not all together, so a due ARC goes first there."""
        state = self._state
        return arc.starving and bool(arc.mask & state.sharable) and self.due(arc) <= state.now

    def conflict(self, arc: Arc) -> Inadmissible | None:
        """What `arc` would be in the way of if it started now."""
        if not arc.mask & self.bits:
            return None
        for rc in self._state.rcs_in(arc.mask & self.bits):
            before: list[Arc] = []
            blocking: Reservation | None = None
            for reservation in self.by_rc[rc.bit]:
                if reservation.arc is arc:
                    break
                before.append(reservation.arc)
                if blocking is None and self._delays(arc, reservation):
                    blocking = reservation
            if blocking is None:
                continue
            reason = Reason(ReasonCode.RESERVED, (rc.name,), (blocking.arc.party,))
            if not rc.sharable:
                return Inadmissible(rc, reason)
            together = frozenset((*rc.holders, arc.id, *(one.id for one in before)))
            answer = self._votes.known(rc.name, together)
            if answer is None or not answer.accept:
                is_open = answer is None and rc.name not in self._votes.unresponsive
                return Inadmissible(rc, reason, together if is_open else None)
        return None

    def reserves(self, rc: Rc, arc: Arc) -> bool:
        """Whether `rc`, exclusive, is reserved for another that goes before `arc`."""
        return any(one.arc is not arc and self._delays(arc, one) for one in self.by_rc.get(rc.bit, ()))

    def _delays(self, arc: Arc, reservation: Reservation) -> bool:
        """Whether `arc`, started now, would hold what is reserved when the time comes, and must not."""
        band = self._state.band
        return (
            band(arc.priority) <= band(reservation.arc.priority)
            and self._state.now + arc.request.min_runtime > reservation.start
        )

    def changed(self, earlier: Reservations) -> int:
        """Bits of the RCs at which the reservations differ from the `earlier` ones."""
        either = self.by_rc.keys() | earlier.by_rc.keys()
        return union(bit for bit in either if self.by_rc.get(bit) != earlier.by_rc.get(bit))
