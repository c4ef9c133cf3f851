"""What RCs showed before a recording began, as journals tell: pure. Seconds since 1970 come in, seconds of the timeline
go out."""

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
"""RCs whose past is drawn: those that were held last."""
MAX_GAPS: Final = 20
"""Times of which not all is known that are told of in words: the latest."""
MAX_NAMED: Final = 8
"""Hosts in one line."""


class PastBar(NamedTuple):
    """An ARC that held an RC; without a name nobody knows who did."""

    arc: str = ""
    operator: bool = False


PastLane: TypeAlias = Sequence[tuple[float, Sequence[PastBar | None]]]
"""By time, what each row shows from then on; None: nothing."""


class Past(NamedTuple):
    """What there is to draw of it, and to say: what it is, and of when nobody knows all."""

    lanes: Mapping[str, PastLane]
    words: Sequence[str]
    gaps: Sequence[str]


def past_of(told: FleetHistory, zero: float, seconds: float, operator_priority: int) -> Past:
    """What journals tell of so many seconds before `zero`, which is second 0. Nothing is said of when no journal was
    kept yet."""
    known = min((one.since for one in told.journals.values() if one.since is not None), default=zero)
    began = max(zero - seconds, known, told.holds[0].began if told.more else 0.0)
    window = Span(min(began, zero), zero)
    unknown = [Span(max(one.began, window.began), min(one.ended, zero)) for one in told.unknown]
    unknown = [one for one in unknown if one.ended > one.began]
    hours, journals = f"{seconds / 3600:.3g} h", f"of {', '.join(sorted(told.journals)[:MAX_NAMED])}"
    words = []
    if told.holds:
        count = "1 hold" if len(told.holds) == 1 else f"{len(told.holds)} holds"
        count = f"the latest {count}" if told.more else count
        words = [f"the journals {journals} tell of {count} in the {hours} before this recording"]
    if told.without:
        words.append(f"no journal of {', '.join(told.without[:MAX_NAMED])}: off, older than 0.3.0, or too slow")
    gaps = [
        f"from {_at(one.began)} to {_at(one.ended)} UTC the journals are incomplete: {told.causes(one)}"
        for one in unknown
    ]
    more = [f"and {len(gaps) - MAX_GAPS} more such times before"] if len(gaps) > MAX_GAPS else []
    return Past(past_lanes(told.holds, unknown, window, zero, operator_priority), words, [*gaps[-MAX_GAPS:], *more])


def _at(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%d %b %H:%M:%S}"


def past_lanes(
    holds: Iterable[PastHold], unknown: Sequence[Span], window: Span, zero: float, operator_priority: int
) -> Mapping[str, PastLane]:
    """By RC, what its lane shows within the window, and nothing after it. `unknown`: times of which no journal knows
    all, in order and apart; there an RC of which no hold is known is not known to be free. Second 0 is `zero`."""
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
    """Bars at one time stand one below the other, MAX_SLOTS at most."""
    ends: list[float] = []
    changes: list[tuple[float, bool, int, PastBar | None]] = []

    def add(span: Span, row: int, bar: PastBar) -> None:
        # What ends is before what begins then.
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
    """What is left of times, in order and apart, where nothing is held."""
    busy = apart(held)
    begins, ends = [-math.inf, *(span.ended for span in busy)], [*(span.began for span in busy), math.inf]
    return both(unknown, [Span(*between) for between in zip(begins, ends, strict=True)])
