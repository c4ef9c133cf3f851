"""Which bookings can't be beside those that go before them, where two halves of a fleet have booked."""

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
    losers: dict[str, str] = field(default_factory=dict)
    """Bookings that can't be, each with one that goes before it."""
    unknown: list[tuple[Rc, HolderSet]] = field(default_factory=list)
    """Votes that have to be known before all can be told."""


def overlaps(state: SchedulerState, order: Iterable[str], starts: Mapping[str, Ns]) -> Overlaps:
    """Of claims in the order in which they stand. `starts`: when they begin by the fleet's clock of now, which was not
    moved for what has begun. RCs that are absent are not judged: whether one is sharable is known
    once it is there."""
    result = Overlaps()
    standing: dict[tuple[int, int], list[Claim]] = {}
    """By bit and day: thousands of dates of one RC are not compared with one another."""
    for name in order:
        if (claim := state.claims.get(name)) is None:
            continue
        # What it has for a pattern while it runs, it has.
        needed = claim.kept if claim.arc.hold is None else claim.arc.named_mask
        for rc in state.rcs_in(needed & state.present):
            near = (standing.get((rc.bit, day), ()) for day in _days(claim, starts))
            before = list({one.booking.id: one for one in chain(*near) if _meet(one, claim, starts)}.values())
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


def _meet(one: Claim, other: Claim, starts: Mapping[str, Ns]) -> bool:
    """Whether they are at one time; that an RC is in maintenance twice keeps nobody from it more."""
    both = one.booking.maintenance and other.booking.maintenance
    apart = _start(other, starts) - _start(one, starts)
    return not both and -other.booking.runtime < apart < one.booking.runtime


def _excluded(claim: Claim, before: list[Claim]) -> bool:
    return claim.booking.maintenance or any(one.booking.maintenance for one in before)


def _refused(state: SchedulerState, rc: Rc, claim: Claim, before: list[Claim], result: Overlaps) -> bool:
    """Whether the RC would refuse it beside the others, at any time of it."""
    for time in sorted({claim.booking.start, *(one.booking.start for one in before)}):
        if not claim.booking.start <= time < claim.booking.end:
            continue
        there = [one for one in (*before, claim) if one.booking.start <= time < one.booking.end]
        holders = frozenset(one.arc.id for one in there)
        answer = state.votes.known(rc.name, holders)
        if answer is None:
            result.unknown.append((rc, holders))
        elif not answer.accept:
            return True
    return False
