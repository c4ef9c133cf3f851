"""Predicted hold times, learned from past holds.

After Tsafrir, Etsion and Feitelson, "Backfilling using system-generated predictions rather than user runtime estimates"
(IEEE TPDS 18(6), 2007): requested times still end holds and make promises; predictions serve estimates alone. Histories
are by name, command and requested RCs, or by name and command if there are too few such holds. The length of a hold
that was cut short is a lower bound, so medians are Kaplan and Meier's ("Nonparametric estimation from incomplete
observations", JASA 53, 1958), among the holds that lasted longer than the present hold.

Each history measures its own accuracy: it predicts every hold by the length of earlier holds and by their share of the
requested time. The better method is used, and only if it was more accurate than the requested time."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import OrderedDict, deque
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Final, NamedTuple

from zscout.scheduling.model import ArcRequest, Hold
from zscout.types import Need, Ns

MAX_HISTORIES: Final = 4_000
"""Beyond, the history unused for longest is dropped."""
MAX_KEPT: Final = 20
"""Holds per history, the latest."""
MAX_NEEDS: Final = 32
"""Requests of more RCs have only the history by name and command."""
MAX_TEXT: Final = 200
"""Characters of a name or command that count."""
MIN_JUDGED: Final = 2
"""Predicted holds that a history needs before it is used; its first hold is not predicted."""
TOLERANCE: Final = 1e-9


class RequestTraits(NamedTuple):
    name: str
    command: str
    needs: frozenset[Need]
    runtime: Ns

    @classmethod
    def of(cls, request: ArcRequest) -> RequestTraits:
        command = "" if request.who is None else request.who.command
        return cls(request.name, command, frozenset(request.needs), request.min_runtime)

    def histories(self) -> Iterator[Hashable]:
        """The keys of its histories, the closest first."""
        name, command = self.name[:MAX_TEXT], self.command[:MAX_TEXT]
        if len(self.needs) <= MAX_NEEDS:
            yield name, command, self.needs
        yield name, command


class RuntimeEstimator:
    def __init__(self, most: int = MAX_HISTORIES) -> None:
        self._most = most
        self._histories: OrderedDict[Hashable, _History] = OrderedDict()

    def observe(self, traits: RequestTraits, lasted: Ns, *, whole: bool) -> None:
        """Record a hold. `whole`: released, or ran its requested time; else cut short."""
        for key in traits.histories():
            history = self._histories.setdefault(key, _History())
            self._histories.move_to_end(key)
            history.add(_Span(traits.runtime, max(1, lasted), whole))
        while len(self._histories) > self._most:
            self._histories.popitem(last=False)

    def runtime(self, traits: RequestTraits, elapsed: Ns = 0) -> Ns | None:
        """The expected length of a hold that has lasted `elapsed` ns, always more than that. None: no better guess than
        the requested time."""
        for key in traits.histories():
            history = self._histories.get(key)
            if history is not None and (estimate := history.estimate()) is not None:
                return estimate.runtime(traits.runtime, max(0, elapsed))
        return None

    def end(self, request: ArcRequest, hold: Hold, now: Ns) -> Ns | None:
        """The likely release of a hold, after `now` and before its end. None: unknown."""
        runtime = self.runtime(RequestTraits.of(request), now - hold.start)
        if runtime is None:
            return None
        end = max(hold.start + runtime, now + 1)
        return end if request.keep or end < hold.end else None


class _Span(NamedTuple):
    requested: Ns
    lasted: Ns
    whole: bool


class _History:
    """The latest holds of one key; estimates are computed on demand."""

    __slots__ = ("_estimates", "spans")

    def __init__(self) -> None:
        self.spans: deque[_Span] = deque(maxlen=MAX_KEPT)
        self._estimates: tuple[_Estimate, _Estimate] | None = None

    def add(self, span: _Span) -> None:
        self.spans.append(span)
        self._estimates = None

    def estimate(self) -> _Estimate | None:
        if self._estimates is None:
            self._estimates = _Estimate(self.spans, by_share=False), _Estimate(self.spans, by_share=True)
        best = max(self._estimates, key=lambda estimate: estimate.accuracy)
        return best if best.judged >= MIN_JUDGED else None


class _Estimate:
    __slots__ = ("_by_share", "_median", "_values", "accuracy", "judged", "requested_accuracy")

    def __init__(self, spans: Iterable[_Span], *, by_share: bool) -> None:
        self._by_share = by_share
        self.accuracy = self.requested_accuracy = 0.0
        """Summed over the `judged` holds: of this estimate, and of the requested time."""
        self.judged = 0
        self._values: list[tuple[float, bool]] = []
        """Sorted lengths, each with True if it was cut short; of equals these come last, as they would be longer."""
        self._median: float | None = None
        for span in spans:
            unit = span.requested if by_share else 1
            if span.whole and self._median is not None:
                self.accuracy += _accuracy(self._median * unit, span.lasted)
                self.requested_accuracy += _accuracy(span.requested, span.lasted)
                self.judged += 1
            insort(self._values, (span.lasted / unit, not span.whole))
            self._median = _median(self._values)

    def runtime(self, requested: Ns, elapsed: Ns) -> Ns | None:
        if self.accuracy <= self.requested_accuracy + TOLERANCE:
            return None
        unit = requested if self._by_share else 1
        left = self._values[bisect_right(self._values, (elapsed / unit, True)) :] if elapsed else []
        median = _median(left) if elapsed else self._median
        if median is not None:
            return max(elapsed + 1, round(median * unit))
        # Longer than all known holds: the expectation grows with the elapsed time.
        return elapsed + elapsed // 8 + 1 if elapsed else None


def _median(values: Sequence[tuple[float, bool]]) -> float | None:
    """Return None if too many of the longest were cut short."""
    surviving = 1.0
    for at, (value, cut) in enumerate(values):
        if not cut:
            surviving *= 1 - 1 / (len(values) - at)
            if surviving <= 0.5 + TOLERANCE:
                return value
    return None


def _accuracy(expected: float, lasted: Ns) -> float:
    """The accuracy of a prediction from 0 to 1, as in the paper, so that all holds count alike."""
    return min(expected, lasted) / max(expected, lasted)
