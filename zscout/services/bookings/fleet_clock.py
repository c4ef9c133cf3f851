"""Fleet time: what the leader's publications tell, so that all mean the same by a date. Pure.

In a reign it never jumps once it is told: it is slewed by at most 1 % towards the median of the hosts' clocks, as
`adjtime` does."""

from __future__ import annotations

from collections.abc import Iterable
from statistics import median_high, median_low
from typing import Final

from zscout.types import SECOND, Ns

SLEW: Final = 100
"""One part in so many."""
DIFFERS: Final = 2.0
"""Seconds by which a host's clock may differ before people are told."""
SAME: Final = 1.0
"""Seconds: fleet times that have gone on for as long, but for this, are as old."""


def wall_ns(seconds: float) -> Ns:
    return round(seconds * SECOND)


def agreed(times: Iterable[Ns], goes_on: Ns | None = None) -> Ns:
    """The time of several clocks at one instant: their median. Of two in the middle it is the one that is nearer to
    the time that `goes_on`, which more may have agreed upon; else the lower. Raises ValueError for none."""
    all_times = sorted(times)
    low, high = median_low(all_times), median_high(all_times)
    return high if goes_on is not None and abs(high - goes_on) < abs(low - goes_on) else low


class FleetClock:
    """Fleet time on one host's own clock, on which `now` always is."""

    def __init__(self, time: Ns, now: Ns, since: Ns) -> None:
        """`time`: ns since 1970 (UTC) that it is at `now`; it has gone on since `since` on the own clock."""
        self.since = since
        self.step(time, now)

    def at(self, now: Ns) -> Ns:
        """Fleet time, in ns since 1970 (UTC)."""
        return now + self._slewed(now)

    def step(self, time: Ns, now: Ns) -> None:
        """It is `time` at `now`: before anybody goes by it, or where one that is older goes on elsewhere."""
        self._offset = self._aim = time - now
        self._set = now

    def aim(self, time: Ns, now: Ns) -> None:
        """It should be `time` at `now`: goes there slowly."""
        self._offset, self._set = self._slewed(now), now
        self._aim = time - now

    def _slewed(self, now: Ns) -> Ns:
        most = max(0, now - self._set) // SLEW
        return self._offset + max(-most, min(most, self._aim - self._offset))
