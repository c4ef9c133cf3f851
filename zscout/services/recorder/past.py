"""Lanes of RCs before the start of a recording, from journals. Pure. Input is in seconds since 1970, output in seconds
of the timeline."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from operator import itemgetter
from typing import Final, NamedTuple, TypeAlias

from zscout.messages import PastHold
from zscout.services.journal.asking import FleetHistory
from zscout.services.journal.merging import Span, apart, both
from zscout.services.recorder.drawing import MAX_SLOTS, with_person

MAX_LANES: Final = 500
"""RCs whose past is drawn: the most recently held."""
MAX_GAPS: Final = 20
"""Incomplete periods that become events: the latest."""
MAX_NAMED: Final = 8
"""Hosts named in one line."""


class PastBar(NamedTuple):
    """An ARC that held an RC; without a name it is unknown whether any did."""

    arc: str = ""
    operator: bool = False


PastLane: TypeAlias = Sequence[tuple[float, Sequence[PastBar | None]]]
"""By time, the bar of each row from then on; None: no bar."""


class Past(NamedTuple):
    """The past to draw, with events that describe it and its gaps."""

    lanes: Mapping[str, PastLane]
    words: Sequence[str]
    gaps: Sequence[str]


def past_of(history: FleetHistory, zero: float, seconds: float, operator_priority: int) -> Past:
    """The past of `seconds` before `zero`, which is second 0. Starts no earlier than the oldest journal."""
    known = min((journal.since for journal in history.journals.values() if journal.since is not None), default=zero)
    began = max(zero - seconds, known, history.holds[0].began if history.more else 0.0)
    window = Span(min(began, zero), zero)
    unknown = [Span(max(span.began, window.began), min(span.ended, zero)) for span in history.unknown]
    unknown = [span for span in unknown if span.ended > span.began]
    hours, journals = f"{seconds / 3600:.3g} h", f"of {', '.join(sorted(history.journals)[:MAX_NAMED])}"
    words = []
    if history.holds:
        count = "1 hold" if len(history.holds) == 1 else f"{len(history.holds)} holds"
        count = f"the latest {count}" if history.more else count
        words = [f"the journals {journals} list {count} in the {hours} before this recording"]
    if history.without:
        words.append(f"no journal of {', '.join(history.without[:MAX_NAMED])}: off, older than 0.3.0, or too slow")
    gaps = [
        f"from {_at(span.began)} to {_at(span.ended)} UTC the journals are incomplete: {history.causes(span)}"
        for span in unknown
    ]
    more = [f"and {len(gaps) - MAX_GAPS} more such times before"] if len(gaps) > MAX_GAPS else []
    return Past(past_lanes(history.holds, unknown, window, zero, operator_priority), words, [*gaps[-MAX_GAPS:], *more])


def _at(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%d %b %H:%M:%S}"


def past_lanes(
    holds: Iterable[PastHold], unknown: Sequence[Span], window: Span, zero: float, operator_priority: int
) -> Mapping[str, PastLane]:
    """The lane of each RC within the window; second 0 is `zero`. `unknown`: periods, sorted and disjoint, that no
    journal covers completely; in them an RC without a known hold is not known to be free."""
    bars: dict[str, list[tuple[Span, PastBar]]] = {}
    for hold in holds:
        span = Span(
            max(hold.began, window.began), min(window.ended if hold.ended is None else hold.ended, window.ended)
        )
        for rc in dict.fromkeys(hold.rcs) if span.ended > span.began else ():
            bar = PastBar(with_person(hold.arc, hold.who), hold.priority >= operator_priority)
            bars.setdefault(rc, []).append((span, bar))
    last = sorted(bars, key=lambda rc: max(span.ended for span, _ in bars[rc]))[-MAX_LANES:]
    return {rc: _lane(sorted(bars[rc], key=itemgetter(0)), unknown, zero) for rc in sorted(last)}


def _lane(bars: Sequence[tuple[Span, PastBar]], unknown: Sequence[Span], zero: float) -> PastLane:
    """Simultaneous bars have a row each, at most MAX_SLOTS."""
    ends: list[float] = []
    changes: list[tuple[float, bool, int, PastBar | None]] = []

    def add(span: Span, row: int, bar: PastBar) -> None:
        # At one instant ends come before starts.
        changes.extend([(span.began, True, row, bar), (span.ended, False, row, None)])

    for span, bar in bars:
        row = next((row for row, end in enumerate(ends) if end <= span.began), len(ends))
        if row == len(ends):
            if row == MAX_SLOTS:
                continue
            ends.append(0.0)
        ends[row] = span.ended
        add(span, row, bar)
    for span in _free(unknown, (span for span, _ in bars)):
        add(span, 0, PastBar())
    shown: list[PastBar | None] = [None] * len(ends)
    lane: list[tuple[float, Sequence[PastBar | None]]] = []
    for at, _, row, shows in sorted(changes, key=itemgetter(0, 1, 2)):
        shown[row] = shows
        if lane and lane[-1][0] == at - zero:
            lane.pop()
        lane.append((at - zero, tuple(shown)))
    return lane


def _free(unknown: Sequence[Span], held: Iterable[Span]) -> list[Span]:
    """The parts of `unknown` in which no hold is known; all spans are sorted and disjoint."""
    busy = apart(held)
    begins, ends = [-math.inf, *(span.ended for span in busy)], [*(span.began for span in busy), math.inf]
    return both(unknown, [Span(*between) for between in zip(begins, ends, strict=True)])
