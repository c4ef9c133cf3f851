"""How long holds last, learned from those that are over: who asks for an hour and always takes ten minutes is expected to
take ten minutes.

After Tsafrir, Etsion and Feitelson, "Backfilling using system-generated predictions rather than user runtime estimates"
(IEEE TPDS 18(6), 2007): what is asked for is kept for whatever ends a hold or promises something, and predictions
serve estimates alone. Histories are by name, command and RCs as asked, and by less where that is not known well enough.
A hold that was taken away would have lasted longer: its time is a lower bound, and quantiles are those of Kaplan and Meier
("Nonparametric estimation from incomplete observations", JASA 53, 1958), among those that lasted longer than the hold in
question has already.

Each history judges itself. It foretells every hold in two ways, by the time that earlier ones lasted and by the share of
what they had asked for, and goes by the better one only where that was nearer than what was asked for.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Hashable, Iterator
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
"""Holds that a history must have foretold before it is asked: the first foretells nothing."""
TOLERANCE: Final = 1e-9


class Wish(NamedTuple):
    """What a request is known by, and what it asks for."""

    name: str
    command: str
    owner: str
    needs: frozenset[Need]
    runtime: Ns
    """> 0."""

    @classmethod
    def of(cls, request: ArcRequest) -> Wish:
        who, host = request.who, request.client.partition("/")[0]
        command, user = ("", "") if who is None else (who.command, who.user)
        return cls(request.name, command, user or host, frozenset(request.needs), request.min_runtime)

    def keys(self) -> Iterator[Hashable]:
        """Of the histories that it belongs to, the closest first."""
        name, command = self.name[:MAX_TEXT], self.command[:MAX_TEXT]
        if len(self.needs) <= MAX_NEEDS:
            yield name, command, self.needs
        yield name, command
        yield (self.owner[:MAX_TEXT],)


class RuntimeEstimator:
    """What is known of all programs of a fleet. It has no clock, and its memory is bounded."""

    def __init__(self, most: int = MAX_HISTORIES) -> None:
        self._most = most
        self._histories: OrderedDict[Hashable, _History] = OrderedDict()

    def observe(self, wish: Wish, lasted: Ns, *, whole: bool) -> None:
        """A hold is over. `whole`: its program gave it back, or it had all that was asked for; else it was taken away."""
        for key in wish.keys():
            history = self._histories.setdefault(key, _History())
            self._histories.move_to_end(key)
            history.add(wish.runtime, max(1, lasted), whole=whole)
        while len(self._histories) > self._most:
            self._histories.popitem(last=False)

    def runtime(self, wish: Wish, elapsed: Ns = 0) -> Ns | None:
        """How long a hold will have lasted in all, given that it has for `elapsed` ns: always longer than that. None:
        nothing better is known than what was asked for."""
        for key in wish.keys():
            history = self._histories.get(key)
            if history is not None and len(history.scores) >= JUDGED:
                return history.runtime(wish.runtime, max(0, elapsed))
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

    def value(self, *, shares: bool) -> float:
        return self.lasted / self.asked if shares else float(self.lasted)


class _History:
    __slots__ = ("_medians", "scores", "spans")

    def __init__(self) -> None:
        self.spans: deque[_Span] = deque(maxlen=MAX_KEPT)
        self.scores: deque[tuple[float, float, float]] = deque(maxlen=MAX_KEPT)
        """Of each hold that was foretold the accuracy of what was asked for, of the times, of the shares."""
        self._medians: tuple[float | None, float | None] = (None, None)

    def add(self, asked: Ns, lasted: Ns, *, whole: bool) -> None:
        time, share = self._medians
        if whole and time is not None and share is not None:
            self.scores.append((_accuracy(asked, lasted), _accuracy(time, lasted), _accuracy(share * asked, lasted)))
        self.spans.append(_Span(asked, lasted, whole))
        self._medians = self._median(0, shares=False), self._median(0, shares=True)

    def runtime(self, asked: Ns, elapsed: Ns) -> Ns | None:
        plain, times, shares = (sum(one[way] for one in self.scores) for way in range(3))
        if max(times, shares) <= plain + TOLERANCE:
            return None
        by_share = shares > times
        unit = asked if by_share else 1
        median = self._median(elapsed / unit, shares=by_share) if elapsed else self._medians[by_share]
        if median is not None:
            return max(elapsed + 1, round(median * unit))
        # It has outlasted all that are known: what is expected grows with what has passed.
        return elapsed + elapsed // 8 + 1 if elapsed else None

    def _median(self, above: float, *, shares: bool) -> float | None:
        """Of the spans longer than `above`; None where too many of the longest were cut short."""
        # Of equals, those that were cut short lasted longer.
        found = sorted((span.value(shares=shares), not span.whole) for span in self.spans)
        found = [one for one in found if one[0] > above]
        surviving = 1.0
        for at, (value, cut) in enumerate(found):
            surviving *= 1.0 if cut else 1 - 1 / (len(found) - at)
            if surviving <= 0.5 + TOLERANCE:
                return value
        return None


def _accuracy(expected: float, lasted: Ns) -> float:
    """From 0 to 1, as the paper has it: so no single hold counts for more than another."""
    return min(expected, lasted) / max(expected, lasted)
