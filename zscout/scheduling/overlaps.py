"""Bookings that conflict with earlier ones, after two halves of a fleet have booked separately."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain, product
from typing import Final

from zscout.scheduling.model import Claim, Rc
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import HolderSet
from zscout.types import SECOND, Ns

DAY: Final[Ns] = 86_400 * SECOND


@dataclass(slots=True)
class Overlaps:
    losers: dict[str, str] = field(default_factory=dict)  # bookings that lose, each with an earlier one in its way
    unknown: list[tuple[Rc, HolderSet]] = field(default_factory=list)  # votes needed for a complete answer


def overlaps(state: SchedulerState, order: Iterable[str], starts: Mapping[str, Ns]) -> Overlaps:
    """Check claims in `order`. `starts`: dates by the fleet's current clock, which holds do not follow. Absent RCs
    are not judged: whether they are sharable is unknown."""
    result = Overlaps()
    standing: dict[tuple[int, int], list[Claim]] = {}  # by bit and day, to avoid comparing thousands of dates of one RC
    for name in order:
        if (claim := state.claims.get(name)) is None:
            continue
        # A running ARC keeps the RCs of its patterns.
        needed = claim.kept if claim.arc.hold is None else claim.arc.named_mask
        for rc in state.rcs_in(needed & state.present):
            near = (standing.get((rc.bit, day), ()) for day in _days(claim, starts))
            before = list({other.booking.id: other for other in chain(*near) if _meet(other, claim, starts)}.values())
            if before and (not rc.sharable or _excluded(claim, before) or _refused(state, rc, claim, before, result)):
                result.losers[name] = before[0].booking.id
                break
        else:
            for key in product((rc.bit for rc in state.rcs_in(claim.mask & state.present)), _days(claim, starts)):
                standing.setdefault(key, []).append(claim)
    return result


def _start(claim: Claim, starts: Mapping[str, Ns]) -> Ns:
    return starts.get(claim.booking.id, claim.booking.start)


def _days(claim: Claim, starts: Mapping[str, Ns]) -> range:
    start = _start(claim, starts)
    return range(start // DAY, (start + claim.booking.runtime) // DAY + 1)


def _meet(claim: Claim, other: Claim, starts: Mapping[str, Ns]) -> bool:
    """Return True if both are at one time; maintenance does not conflict with maintenance."""
    both = claim.booking.maintenance and other.booking.maintenance
    apart = _start(other, starts) - _start(claim, starts)
    return not both and -other.booking.runtime < apart < claim.booking.runtime


def _excluded(claim: Claim, before: list[Claim]) -> bool:
    return claim.booking.maintenance or any(other.booking.maintenance for other in before)


def _refused(state: SchedulerState, rc: Rc, claim: Claim, before: list[Claim], result: Overlaps) -> bool:
    """Return True if the RC would refuse it beside the others, at any time of it."""
    for time in sorted({claim.booking.start, *(other.booking.start for other in before)}):
        if not claim.booking.start <= time < claim.booking.end:
            continue
        there = [booked for booked in (*before, claim) if booked.booking.start <= time < booked.booking.end]
        holders = frozenset(booked.arc.id for booked in there)
        answer = state.votes.known(rc.name, holders)
        if answer is None:
            result.unknown.append((rc, holders))
        elif not answer.accept:
            return True
    return False
