"""Upcoming ends of holds, for their holders: the requests, bookings and maintenance that may end each.

No pass and no grant depends on this. As with the reasons to wait, the caller collects changes for a tenth of a second
before it asks. Reported for each hold are at most the best-ranked waiting request, and the booking or maintenance that
ends it first."""

from __future__ import annotations

import heapq
from collections.abc import Container, Iterator
from typing import Final, Literal, NamedTuple, TypeAlias

from zscout.scheduling.model import Arc, Claim, PatternClass, Rc, union
from zscout.scheduling.reason import Party, ReasonCode
from zscout.scheduling.state import SchedulerState
from zscout.types import SECOND, ArcId, Ns, RcName

HORIZON: Final[Ns] = 7 * 86_400 * SECOND
"""Later bookings are not reported yet."""
MAX_RANKS: Final = 4
"""Waiting requests considered for each RC."""
MAX_CLASSES: Final = 64
"""Classes of requests with patterns considered for all RCs together."""
MAX_CHOICES: Final = 8
"""Holds reported to end for a class: those that yield first."""

UpcomingCode: TypeAlias = Literal["waits", "booked", "maintenance"]


class UpcomingEnd(NamedTuple):
    """`by` waits for `rcs` of a hold, has booked them, or needs them for maintenance. The hold does not end for `by`
    before `until`; 0: it may end at any time. `begins`: the date of a booking or maintenance."""

    code: UpcomingCode
    by: Party
    rcs: tuple[RcName, ...]
    until: Ns = 0
    begins: Ns | None = None


def contended_holds(state: SchedulerState) -> list[Arc]:
    """The holds whose upcoming ends may have changed since the last call."""
    region = state.index.contended | state.dates.contended
    state.index.contended = state.dates.contended = 0
    if not region:
        return []
    while (grown := region | union(like.reach for like in state.classes.values() if like.reach & region)) != region:
        region = grown
    held = region & (state.busy | state.sharable)
    holds = list(dict.fromkeys(holder for rc in state.rcs_in(held) for holder in rc.holders.values()))
    _choose(state, region, holds)
    return holds


def upcoming(state: SchedulerState, arc: Arc) -> tuple[UpcomingEnd, ...]:
    if arc.hold is None:
        return ()
    waiting = _waiting(state, arc) if state.queued else None
    dated = _dated(state, arc) if arc.mask & state.dates.claimed else None
    return tuple(found for found in (waiting, dated) if found is not None)


# Requests that wait


def _choose(state: SchedulerState, region: int, holds: list[Arc]) -> None:
    """Choose the holds that will probably end for the patterns of waiting ARCs (`state.chosen`)."""
    chosen = {name: by for name, by in state.chosen.items() if name in state.running and by in state.queued}
    for hold in holds:
        chosen.pop(hold.id, None)
    classes = (like for like in state.classes.values() if like.reach & region)
    for like in heapq.nsmallest(MAX_CLASSES, classes, key=lambda like: like.members[0]):
        for number, hold in enumerate(_choices(state, like, chosen)):
            chosen[hold.id] = like.members[number // len(like.masks)][-1]
    state.chosen = chosen


def _choices(state: SchedulerState, like: PatternClass, chosen: Container[ArcId]) -> list[Arc]:
    """The holds that may have to end for this class, not counting those already `chosen`."""
    first = state.queued[like.members[0][-1]]
    reach = like.reach & state.present & ~state.sharable
    missing = len(like.members) * len(like.masks) - (reach & ~state.busy).bit_count()
    holders = dict.fromkeys(holder for rc in state.rcs_in(reach & state.busy) for holder in rc.holders.values())
    yielding = [
        (_until(state, holder, first), holder.rank, holder)
        for holder in holders
        if holder.id not in chosen and _yields(holder, first)
    ]
    return [holder for _, _, holder in heapq.nsmallest(min(missing, MAX_CHOICES), yielding)]


def _waiting(state: SchedulerState, arc: Arc) -> UpcomingEnd | None:
    best = state.queued.get(state.chosen.get(arc.id, ""))
    chosen = best
    for rc in arc.rcs:
        for rank in (rc.watchers if rc.sharable else rc.demand)[:MAX_RANKS]:
            other = state.queued[rank[-1]]
            if (best is None or rank < best.rank) and _yields(arc, other) and _is_in_way(rc, other):
                best = other
                break
    if best is None:
        return None
    reach = best.like.reach if best is chosen and best.like is not None else 0
    wanted = (rc for rc in arc.rcs if rc.sharable or rc.bit & (best.named_mask | reach))
    rcs = tuple(sorted(rc.name for rc in wanted if _is_in_way(rc, best)))
    return UpcomingEnd("waits", best.party, rcs, _until(state, arc, best))


def _yields(arc: Arc, other: Arc) -> bool:
    return other.priority >= arc.priority and not other.request.continues_from(arc.request)


def _is_in_way(rc: Rc, other: Arc) -> bool:
    """Return True unless both can hold the sharable RC."""
    if not rc.sharable:
        return True
    why = other.reason
    return why is not None and why.code is ReasonCode.VETOED and rc.name in why.rcs


def _until(state: SchedulerState, arc: Arc, other: Arc) -> Ns:
    return 0 if arc.preemptible_by(other, state.now) else int(arc.known_end(other))


# Bookings


def _dated(state: SchedulerState, arc: Arc) -> UpcomingEnd | None:
    ends = dict.fromkeys(_ends(state, arc))
    if not ends:
        return None
    until, date, name = min(ends)
    claim = state.claims[name]
    rcs = tuple(rc.name for rc in arc.rcs if rc.bit & claim.mask)
    code: UpcomingCode = "maintenance" if claim.booking.maintenance else "booked"
    return UpcomingEnd(code, claim.booking.party, tuple(sorted(rcs)), until, date)


def _ends(state: SchedulerState, arc: Arc) -> Iterator[tuple[Ns, Ns, str]]:
    """For each booking in the way of a hold: the time before which the hold does not end for it, its date and id."""
    now = state.now
    for rc in arc.rcs:
        for claim in state.dates.of(rc, now, now + HORIZON):
            if not claim.mask & rc.bit or claim is arc.claim or claim.booking.end <= now:
                continue
            until = _until_date(arc, claim, sharable=rc.sharable)
            if until is not None and (claim.booking.lasting or until < claim.booking.end):
                yield until, claim.date, claim.booking.id


def _until_date(arc: Arc, claim: Claim, *, sharable: bool) -> Ns | None:
    """The time before which a hold does not end for a booking; None: it does not end for it at all."""
    hold, booking, date = arc.hold, claim.booking, claim.date
    if hold is None or booking.broken or (hold.last is not None and hold.last <= date):
        return None
    if not arc.request.keep and date >= hold.end:
        return None
    if booking.maintenance:
        if booking.urgent:
            return date
        return max(date, hold.end) if booking.priority >= arc.priority else None
    # The ARC of a booking that was taken up is queued from its date on, or runs.
    waits = claim.is_taken and claim.arc.held_back is None
    if sharable or waits or booking.priority < arc.priority:
        return None
    below = hold.protected_below
    preempts = booking.priority > arc.priority and (below is None or booking.priority >= below)
    return date if preempts else max(date, hold.end)
