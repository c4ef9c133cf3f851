"""Merge the journals of one fleet. Pure.

Each candidate has its own clock and gaps. Records of a hold share its grant; the most complete is taken whole, so that
its times are of one clock. Only the use of RCs, by their own clocks, is the maximum of all records."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import NamedTuple

from msgspec import structs

from zscout.messages import UNHEARD, History, PastHold
from zscout.types import HostName


class Span(NamedTuple):
    """Seconds since 1970, UTC."""

    began: float
    ended: float


def merged(journals: Iterable[Iterable[PastHold]]) -> list[PastHold]:
    """Each hold once, by start."""
    best: dict[object, PastHold] = {}
    for hold in (hold for journal in journals for hold in journal):
        known = best.get(hold.grant)
        if known is None:
            best[hold.grant] = hold
            continue
        more = hold if _knowledge(hold) > _knowledge(known) else known
        used = {rc: max(record.used.get(rc, 0.0) for record in (known, hold)) for rc in {**known.used, **hold.used}}
        best[hold.grant] = more if more.used == used else structs.replace(more, used=used)
    return sorted(best.values(), key=lambda hold: (hold.began, hold.grant))


def _knowledge(hold: PastHold) -> tuple[int, bool, bool]:
    """Rank of a record: end or present state known; start known; wait known."""
    ending = 1 if hold.outcome == UNHEARD else 0 if hold.ended is not None and not hold.outcome else 2
    return ending + (hold.ended is not None and ending == 2), not hold.late, hold.waited is not None


def unknown_to(journal: History, window: Span) -> list[Span]:
    """Incomplete times of a journal within a window, sorted and disjoint."""
    since = window.ended if journal.since is None else journal.since
    spans = [Span(window.began, since)]
    spans += [Span(gap.began, window.ended if gap.ended is None else gap.ended) for gap in journal.gaps]
    return apart(Span(max(span.began, window.began), min(span.ended, window.ended)) for span in spans)


def unknown_to_all(journals: Sequence[History], window: Span) -> list[Span]:
    """Times of a window that no journal covers."""
    return reduce(both, (unknown_to(journal, window) for journal in journals), [window])


def enough(journals: Mapping[HostName, History], window: Span) -> list[HostName]:
    """Hosts whose journals cover as much as all, the most complete first: without candidates in the fleet file every
    node keeps one, with up to 180,000 holds."""
    unknown = {host: unknown_to(journal, window) for host, journal in journals.items()}
    chosen: list[HostName] = []
    left = [window]
    for host in sorted(unknown, key=lambda host: (_length(unknown[host]), host)):
        rest = both(left, unknown[host])
        if not chosen or _length(rest) < _length(left):
            chosen.append(host)
            left = rest
    return chosen


def apart(spans: Iterable[Span]) -> list[Span]:
    """The union, sorted and disjoint."""
    found: list[Span] = []
    for span in sorted(span for span in spans if span.ended > span.began):
        if found and span.began <= found[-1].ended:
            found[-1] = Span(found[-1].began, max(found[-1].ended, span.ended))
        else:
            found.append(span)
    return found


def both(some: Sequence[Span], others: Sequence[Span]) -> list[Span]:
    """The intersection; both sorted and disjoint."""
    found, at = [], 0
    for span in some:
        while at < len(others) and others[at].ended <= span.began:
            at += 1
        for other in others[at:]:
            if other.began >= span.ended:
                break
            found.append(Span(max(span.began, other.began), min(span.ended, other.ended)))
    return found


def _length(spans: Iterable[Span]) -> float:
    return sum(span.ended - span.began for span in spans)
