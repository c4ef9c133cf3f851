"""Free times of a set of RCs, at which a booking could be kept.

Obstacles: all other bookings and maintenance, whatever their priority; holds that neither end nor yield; and
reservations of starving ARCs of equal or higher priority. Other queued ARCs avoid bookings. Sharable RCs are asked
about all holders at that time. The result is exact if earlier bookings keep their present bindings; others are not
tried."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from types import MappingProxyType
from typing import Final, NamedTuple

from zscout.scheduling.booking import Booking
from zscout.scheduling.model import Arc, Rc
from zscout.scheduling.patterns import distinct
from zscout.scheduling.reservations import reservations
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import HolderSet
from zscout.types import ArcId, Need, Ns, RcName

MAX_TRIED: Final = 4_000
"""Starts tried per search."""


class Slot(NamedTuple):
    """A booking may begin at any time from `start` to `latest`; `bound` has the RC for each pattern."""

    start: Ns
    latest: Ns
    bound: Mapping[Need, RcName]


@dataclass(slots=True)
class SlotsFound:
    found: list[Slot] = field(default_factory=list)
    unknown: list[tuple[Rc, HolderSet]] = field(default_factory=list)  # votes needed before the next slot is known
    complete: bool = True  # False: the search was cut off at MAX_TRIED


class _Taken(NamedTuple):
    """A span in which an RC is taken or, if sharable, has this holder."""

    start: Ns
    end: float
    arc: ArcId
    excludes: bool = False
    held: bool = False
    """True for a hold, which yields to a booking that begins before `start`."""


def slots(
    state: SchedulerState,
    wanted: Booking,
    arc: Arc,
    until: Ns,
    limit: int,
    *,
    bookings_only: bool = False,
    presume: bool = False,
    likely: Mapping[ArcId, Ns] = MappingProxyType({}),
) -> SlotsFound:
    """The first `limit` times, up to `until`, at which `wanted` could start; `arc` represents it. `bookings_only`
    ignores holds and queue; `presume` counts unknown votes as yes; `likely` has expected earlier ends of holds."""
    search, result = _Search(state, wanted, arc, until, bookings_only, presume, likely), SlotsFound()
    latest: Ns = wanted.start - 1
    for tried, start in enumerate(search.starts(until)):
        if start <= latest:
            continue
        if tried >= MAX_TRIED:
            result.complete = False
            break
        fit = search.fit(start)
        if isinstance(fit, list):
            result.unknown = fit
            break
        if fit is None:
            continue
        latest = min(until, search.latest(start, fit.values()))
        result.found.append(Slot(start, latest, fit))
        if len(result.found) == limit:
            break
    return result


class _Search:
    def __init__(
        self,
        state: SchedulerState,
        wanted: Booking,
        arc: Arc,
        until: Ns,
        bookings_only: bool,
        presume: bool,
        likely: Mapping[ArcId, Ns],
    ) -> None:
        self._state, self._wanted, self._arc, self._presume, self._likely = state, wanted, arc, presume, likely
        self._end = max(until, wanted.start) + wanted.runtime
        self._named = list(state.rcs_in(arc.named_mask))
        barred = state.barred(arc) | arc.named_mask
        self._choices: dict[Need, list[Rc]] = {}
        for need in arc.patterns:
            known = [rc for rc in state.matching(need) if not rc.bit & barred]
            # Absent RCs may return by then, but count only where none is present.
            self._choices[need] = [rc for rc in known if rc.present] or known
        self._taken: dict[int, list[_Taken]] = {}
        for rc in {rc.bit: rc for rc in chain(self._named, *self._choices.values())}.values():
            self._taken[rc.bit] = [*self._booked(rc), *(() if bookings_only else self._held(rc))]
        if not bookings_only:
            self._add_reserved()
        for taken in self._taken.values():
            taken.sort()
        self._over = dict.fromkeys(self._taken, 0)
        """By bit: how many of these spans are over at the start tried last. Starts are tried in order."""

    def _held(self, rc: Rc) -> Iterable[_Taken]:
        now = self._state.now
        for holder in rc.holders.values():
            start = now if holder.hold is None else max(now, holder.hold.protected_from)
            first = next((at for at in (now, start) if not holder.preemptible_by(self._arc, at)), None)
            if first is not None:
                end = holder.known_end(self._arc)
                yield _Taken(first, min(end, self._likely.get(holder.id, end)), holder.id, held=True)

    def _booked(self, rc: Rc) -> Iterable[_Taken]:
        for claim in self._state.dates.of(rc, self._wanted.start, self._end):
            booking = claim.booking
            if claim.mask & rc.bit and booking.id != self._wanted.id:
                yield _Taken(booking.start, booking.end, claim.arc.id, booking.maintenance)

    def _add_reserved(self) -> None:
        state = self._state
        if state.policy.patience is None or not state.queued:
            return
        for bit, reserved in reservations(state, None).starving.items():
            for promise in reserved if bit in self._taken else ():
                if state.band(promise.arc.priority) >= state.band(self._wanted.priority):
                    self._taken[bit].append(_Taken(promise.start, promise.arc.ends(promise.start), promise.arc.id))

    def starts(self, until: Ns) -> list[Ns]:
        first = self._wanted.start
        ends = {int(span.end) for taken in self._taken.values() for span in taken if first < span.end <= until}
        return sorted({first, *ends})

    def fit(self, start: Ns) -> Mapping[Need, RcName] | list[tuple[Rc, HolderSet]] | None:
        """The binding of its patterns if it starts at `start`, or the votes that decide; None: it can't start."""
        unknown: list[tuple[Rc, HolderSet]] = []
        for rc in self._named:
            free = self._is_free(rc, start)
            if free is False:
                return None
            unknown += [] if free is True or self._presume else [(rc, free)]
        allowed: dict[Need, list[Rc]] = {}
        for need, choices in self._choices.items():
            found = {rc.bit: self._is_free(rc, start) for rc in choices}
            allowed[need] = [rc for rc in choices if found[rc.bit] is True]
            if self._presume:
                allowed[need] += [rc for rc in choices if not isinstance(found[rc.bit], bool)]
            if len(allowed[need]) < len(self._choices) and not self._presume:
                # With enough free RCs no vote is needed.
                unknown += [(rc, free) for rc in choices if not isinstance(free := found[rc.bit], bool)]
        chosen = distinct(allowed)
        if unknown and chosen is not None and not any(rc in self._named for rc, _ in unknown):
            unknown = []
        if unknown:
            return unknown
        return None if chosen is None else {need: rc.name for need, rc in chosen.items()}

    def _is_free(self, rc: Rc, start: Ns) -> bool | HolderSet:
        """Return whether `rc` is free from `start` for long enough, or a set of holders if the vote on it decides."""
        end = start + self._wanted.runtime
        spans, over = self._taken[rc.bit], self._over[rc.bit]
        while over < len(spans) and spans[over].end <= start:
            over += 1
        self._over[rc.bit] = over
        last = bisect_left(spans, (end,))
        taken = [span for span in spans[over:last] if span.end > start and not (span.held and span.start > start)]
        if not rc.sharable or self._wanted.maintenance or any(span.excludes for span in taken):
            return not taken
        there = frozenset(span.arc for span in taken)
        answer = self._state.votes.known(rc.name, there | {self._arc.id})
        return there | {self._arc.id} if answer is None else answer.accept

    def latest(self, start: Ns, bound: Iterable[RcName]) -> Ns:
        rcs = (*self._named, *(self._state.rc(name) for name in bound))
        after = (spans[bisect_left(spans, (start + 1,)) :] for spans in (self._taken[rc.bit] for rc in rcs))
        before = (span.start - (1 if span.held else self._wanted.runtime) for spans in after for span in spans)
        return max(start, min(before, default=start + (1 << 62)))
