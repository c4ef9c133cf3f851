"""Behavior reports at a rate that a recording can bear: pure; time is passed in, in seconds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from zscout.drivers.airtime import Bucket
from zscout.keyexpr import Sender
from zscout.messages import BehaviorSaid
from zscout.types import SECOND

RATE: Final = 20
"""Reports of one sender kept in a second."""
BURST: Final = 20
MAX_WAITING: Final = 256
"""Paths of one sender whose newest report waits for its turn."""
MAX_SENDERS: Final = 1_000
DROPS_EVERY: Final = 10.0
"""Seconds between two figures of what was dropped of one sender."""


@dataclass(slots=True)
class _Sender:
    bucket: Bucket
    waiting: dict[str, BehaviorSaid] = field(default_factory=dict)
    """The newest report of each path that came too fast, oldest first."""
    dropped: int = 0
    counted_at: float = -DROPS_EVERY

    def take(self, at: float) -> bool:
        """Whether the rate allows one more report now."""
        now = round(at * SECOND)
        if self.bucket.ready(1) > now:
            return False
        self.bucket.take(1, now)
        return True


class RateLimiter:
    """Passes on the reports of each sender, at most `RATE` a second. What comes faster waits, and of each
    path only the newest is kept: however much was dropped, what is passed on last is how it is."""

    def __init__(self) -> None:
        self._senders: dict[Sender, _Sender] = {}

    def offer(self, at: float, sender: Sender, report: BehaviorSaid) -> BehaviorSaid | None:
        """The report itself if it is to be recorded now."""
        state = self._senders.pop(sender, None)
        if state is None:
            if len(self._senders) >= MAX_SENDERS:
                del self._senders[next(iter(self._senders))]
            state = _Sender(Bucket(Fraction(BURST), Fraction(RATE), round(at * SECOND)))
        self._senders[sender] = state
        if not state.waiting and state.take(at):
            return report
        if state.waiting.pop(report.path, None) is not None:
            state.dropped += 1
        if len(state.waiting) >= MAX_WAITING:
            state.dropped += 1
        else:
            state.waiting[report.path] = report
        return None

    def due(self, at: float) -> Iterator[tuple[Sender, BehaviorSaid]]:
        """What has waited and is to be recorded now."""
        for sender, state in self._senders.items():
            while state.waiting and state.take(at):
                yield sender, state.waiting.pop(next(iter(state.waiting)))

    def dropped(self, at: float) -> Iterator[tuple[Sender, int]]:
        """Senders of whom reports were dropped, and how many since the last figure."""
        for sender, state in self._senders.items():
            if state.dropped and at - state.counted_at >= DROPS_EVERY:
                state.counted_at, count, state.dropped = at, state.dropped, 0
                yield sender, count

    def forget(self, sender: Sender) -> None:
        self._senders.pop(sender, None)
