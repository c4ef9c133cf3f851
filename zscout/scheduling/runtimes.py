"""How long holds last, learned from those that are over: who asks for an hour and always takes ten minutes is expected
to take ten minutes.

After Tsafrir, Etsion and Feitelson, "Backfilling using system-generated predictions rather than user runtime estimates"
(IEEE TPDS 18(6), 2007): what is asked for is kept for whatever ends a hold or promises something, and predictions
serve estimates alone. Histories are by name, command and RCs as asked, and by name and command alone where too little
is known of that. A hold that was taken away would have lasted longer: its time is a lower bound, and medians are those
of Kaplan and Meier ("Nonparametric estimation from incomplete observations", JASA 53, 1958), among the holds that
lasted longer than the one in question has already.

Each history judges itself. It foretells every hold in two ways, by the time that earlier ones lasted and by the share
of what they had asked for, and goes by the better one only where that was nearer than what was asked for.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import OrderedDict, deque
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Final, NamedTuple

from zscout.scheduling.model import ArcRequest, Hold
from zscout.types import Need, Ns

MAX_HISTORIES: Final = 4_000
"""The one that was not added to for longest is dropped."""
MAX_KEPT: Final = 20
"""Holds of one history: the latest."""
MAX_NEEDS: Final = 32
"""A request of more RCs is known by its name and command alone."""
MAX_TEXT: Final = 200
"""Characters of a name or command that count."""
JUDGED: Final = 2
"""Holds that a history must have foretold before it is asked: its first one foretells nothing."""
TOLERANCE: Final = 1e-9


class Wish(NamedTuple):
    """What a request is known by, and what it asks for."""

    name: str
    command: str
    needs: frozenset[Need]
    runtime: Ns
    """> 0."""

    @classmethod
    def of(cls, request: ArcRequest) -> Wish:
        command = "" if request.who is None else request.who.command
        return cls(request.name, command, frozenset(request.needs), request.min_runtime)

    def histories(self) -> Iterator[Hashable]:
        """The keys of those that it belongs to, the closest first."""
        name, command = self.name[:MAX_TEXT], self.command[:MAX_TEXT]
        if len(self.needs) <= MAX_NEEDS:
            yield name, command, self.needs
        yield name, command


class RuntimeEstimator:
    """What is known of all programs of a fleet. It has no clock, and its memory is bounded."""

    def __init__(self, most: int = MAX_HISTORIES) -> None:
        self._most = most
        self._histories: OrderedDict[Hashable, _History] = OrderedDict()

    def observe(self, wish: Wish, lasted: Ns, *, whole: bool) -> None:
        """A hold is over. `whole`: its program gave it back, or it had all that was asked for; else it was taken."""
        for key in wish.histories():
            history = self._histories.setdefault(key, _History())
            self._histories.move_to_end(key)
            history.add(_Span(wish.runtime, max(1, lasted), whole))
        while len(self._histories) > self._most:
            self._histories.popitem(last=False)

    def runtime(self, wish: Wish, elapsed: Ns = 0) -> Ns | None:
        """How long a hold will have lasted in all, given that it has for `elapsed` ns: always longer than that. None:
        nothing better is known than what was asked for."""
        for key in wish.histories():
            history = self._histories.get(key)
            if history is not None and (estimate := history.estimate()) is not None:
                return estimate.runtime(wish.runtime, max(0, elapsed))
        return None

    def end(self, request: ArcRequest, hold: Hold, now: Ns) -> Ns | None:
        """When a hold is likely to be given back: after `now`, and before it is over. None: that is not known."""
        runtime = self.runtime(Wish.of(request), now - hold.start)
        if runtime is None:
            return None
        end = max(hold.start + runtime, now + 1)
        return end if request.keep or end < hold.end else None


class _Span(NamedTuple):
    asked: Ns
    lasted: Ns
    whole: bool


class _History:
    """The latest holds of one key. What follows of them is worked out when it is asked for."""

    __slots__ = ("_estimates", "spans")

    def __init__(self) -> None:
        self.spans: deque[_Span] = deque(maxlen=MAX_KEPT)
        self._estimates: tuple[_Estimate, _Estimate] | None = None

    def add(self, span: _Span) -> None:
        self.spans.append(span)
        self._estimates = None

    def estimate(self) -> _Estimate | None:
        """The better one of the two, with how well it did; None where too little is known."""
        if self._estimates is None:
            self._estimates = _Estimate(self.spans, by_share=False), _Estimate(self.spans, by_share=True)
        best = max(self._estimates, key=lambda estimate: estimate.accuracy)
        return best if best.judged >= JUDGED else None


class _Estimate:
    """By the time that holds lasted, in ns, or by the share of what they had asked for."""

    __slots__ = ("_by_share", "_median", "_values", "accuracy", "asked_accuracy", "judged")

    def __init__(self, spans: Iterable[_Span], *, by_share: bool) -> None:
        self._by_share = by_share
        self.accuracy = self.asked_accuracy = 0.0
        """Summed over the `judged` holds that it would have foretold: its own, and that of what was asked for."""
        self.judged = 0
        self._values: list[tuple[float, bool]] = []
        """With whether they were cut short; of equals, those last: they would have been longer."""
        self._median: float | None = None
        for span in spans:
            unit = span.asked if by_share else 1
            if span.whole and self._median is not None:
                self.accuracy += _accuracy(self._median * unit, span.lasted)
                self.asked_accuracy += _accuracy(span.asked, span.lasted)
                self.judged += 1
            insort(self._values, (span.lasted / unit, not span.whole))
            self._median = _median(self._values)

    def runtime(self, asked: Ns, elapsed: Ns) -> Ns | None:
        if self.accuracy <= self.asked_accuracy + TOLERANCE:
            return None
        unit = asked if self._by_share else 1
        left = self._values[bisect_right(self._values, (elapsed / unit, True)) :] if elapsed else []
        median = _median(left) if elapsed else self._median
        if median is not None:
            return max(elapsed + 1, round(median * unit))
        # It has outlasted those that are known: what is expected grows with what has passed.
        return elapsed + elapsed // 8 + 1 if elapsed else None


def _median(values: Sequence[tuple[float, bool]]) -> float | None:
    """None where too many of the longest were cut short."""
    surviving = 1.0
    for at, (value, cut) in enumerate(values):
        if not cut:
            surviving *= 1 - 1 / (len(values) - at)
            if surviving <= 0.5 + TOLERANCE:
                return value
    return None


def _accuracy(expected: float, lasted: Ns) -> float:
    """From 0 to 1, as the paper has it: so no single hold counts for more than another."""
    return min(expected, lasted) / max(expected, lasted)
