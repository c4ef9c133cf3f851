"""Bounded waiting: who has waited too long is owed its RCs, and nobody of its own level may pass it for good.

Shortest-first starves. The remedy is a reservation with backfill, as batch schedulers have it: an ARC that
has waited longer than `patience` is *owed*. Of equal or lower priority, only what will be over before the
owed ARC could start at all may still take an RC that it needs. Higher priority is not held back: strict
priority across levels stays as the paper has it.

The promise, while no higher priority asks for its RCs: an ARC waits at most `patience` plus, for each ARC
that was owed before it and shares an RC with it, and once for those who held its RCs, the longest minimum
runtime among them. `docs/scheduling.md` has the argument.
"""

from __future__ import annotations

from collections.abc import Iterable

from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, ArcId, Ns

MAX_OWED = 64
"""ARCs that are owed at one time in one part; more would reserve everything for the far future."""


def held_back(floor: Floor, arcs: Iterable[Arc], now: Ns, patience: Ns) -> set[ArcId]:
    """Which waiting ARCs of `arcs` may not start at `now`, so that the owed ones get their turn."""
    waiting = [arc for arc in arcs if arc.hold is None]
    owed = sorted(
        (arc for arc in waiting if now - arc.since > patience),
        key=lambda arc: (-arc.request.priority, arc.place, arc.id),
    )[:MAX_OWED]
    back: set[ArcId] = set()
    for creditor in owed:
        if creditor.id in back:
            continue
        start = earliest_start(floor, creditor, now)
        for arc in waiting:
            if (
                arc is not creditor
                and arc.mask & creditor.mask
                and arc.request.priority <= creditor.request.priority
                and arc.id not in back
                and not _before(arc, creditor, owed)
                and now + arc.request.min_runtime > start
            ):
                back.add(arc.id)
    return back


def _before(arc: Arc, creditor: Arc, owed: list[Arc]) -> bool:
    """Whether `arc` is owed as well, and has the earlier claim."""
    return arc in owed and owed.index(arc) < owed.index(creditor)


def earliest_start(floor: Floor, arc: Arc, now: Ns) -> Ns:
    """When the last of those who hold an exclusive RC that `arc` needs, and do not yield to it, is over.

    A kept hold yields to its equals from the end of its minimum runtime."""
    start = now
    for rc in floor.of(arc.mask & floor.busy):
        for holder in rc.holders.values():
            if holder.hold is not None and not holder.yields_to(arc, now):
                start = max(start, holder.hold.end)
    return start
