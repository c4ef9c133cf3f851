"""Fleet time: the leader's publications give all hosts the same dates. Pure.

Within a reign it never jumps: it is slewed by at most 1 % towards the median of the hosts' clocks, as in `adjtime`."""

from __future__ import annotations

from collections.abc import Iterable
from statistics import median_high, median_low
from typing import Final

from zscout.types import SECOND, Ns

SLEW: Final = 100  # slew by one part in so many
DIFFERS: Final = 2.0  # seconds of a host clock's error before a warning
SAME: Final = 1.0  # seconds: fleet times that began this close together are equally old


def wall_ns(seconds: float) -> Ns:
    return round(seconds * SECOND)


def agreed(times: Iterable[Ns], goes_on: Ns | None = None) -> Ns:
    """The median of several clocks at one instant. Of two middle ones the nearer to `goes_on`, the present time, which
    more may share; else the lower. Raises ValueError for none."""
    all_times = sorted(times)
    low, high = median_low(all_times), median_high(all_times)
    return high if goes_on is not None and abs(high - goes_on) < abs(low - goes_on) else low


class FleetClock:
    """Fleet time on one host's own clock, which `now` always uses."""

    def __init__(self, time: Ns, now: Ns, since: Ns) -> None:
        """`time`: ns since 1970 (UTC) at `now`; unbroken since `since` on the own clock."""
        self.since = since
        self.step(time, now)

    def at(self, now: Ns) -> Ns:
        """Fleet time, in ns since 1970 (UTC)."""
        return now + self._slewed(now)

    def step(self, time: Ns, now: Ns) -> None:
        """Set it to `time` at `now`: before its first use, or to adopt an older one."""
        self._offset = self._aim = time - now
        self._set = now

    def aim(self, time: Ns, now: Ns) -> None:
        """Slew towards `time` at `now`."""
        self._offset, self._set = self._slewed(now), now
        self._aim = time - now

    def _slewed(self, now: Ns) -> Ns:
        most = max(0, now - self._set) // SLEW
        return self._offset + max(-most, min(most, self._aim - self._offset))
