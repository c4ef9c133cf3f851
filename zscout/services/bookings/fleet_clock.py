"""Fleet time: the leader's publications give all hosts the same dates. Pure.

It begins as the median of the hosts' clocks, and runs on the leader's monotonic clock. If most clocks of hosts differ
from fleet time, it is corrected in one step: at once if a clock was just set to their time, else after a minute."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from statistics import median_high, median_low
from typing import Final, NamedTuple

from zscout.types import SECOND, HostName, Ns

DIFFERS: Final = 2.0  # seconds of a host clock's error before a warning, and before a correction
DIFFERENCE_LASTS: Final[Ns] = 60 * SECOND  # time for which most clocks differ before a correction
REMEMBERED: Final[Ns] = 3_600 * SECOND  # the clock of a silent host counts for so long
MAX_HOSTS: Final = 1_000  # hosts whose clocks count: those read last
SAME: Final = 1.0  # seconds: fleet times that began this close together are equally old


def wall_ns(seconds: float) -> Ns:
    return round(seconds * SECOND)


def agreed(times: Iterable[Ns], current: Ns | None = None, kept: Collection[Ns] = ()) -> Ns:
    """The median of several clocks at one instant. Of two middle ones: the nearer to the agreed time of those `kept` by
    a time service; else to `current` fleet time, which more hosts may share; else the lower. ValueError: no clocks."""
    all_times = sorted(times)
    if kept:
        current = agreed(kept, current)
    low, high = median_low(all_times), median_high(all_times)
    return high if current is not None and abs(high - current) < abs(low - current) else low


def _differ(offset: Ns, other: Ns) -> bool:
    return abs(offset - other) > DIFFERS * SECOND


class _Clock(NamedTuple):
    """A host's clock as last read: how far ahead of the own clock, when, and if a time service synchronises it."""

    offset: Ns
    at: Ns
    kept: bool


class FleetClock:
    """Fleet time on one host's own clock, which `now` always uses."""

    def __init__(self, time: Ns, now: Ns, since: Ns) -> None:
        """`time`: ns since 1970 (UTC) at `now`; unbroken, but for corrections, since `since` on the own clock."""
        self.since = since
        self._hosts: dict[HostName, _Clock] = {}
        self.corrected: tuple[Ns, Ns] | None = None
        """Size and time of the last correction."""
        self._doubted: tuple[Ns, Ns] | None = None
        """The offset on which most clocks agree instead, and since when."""
        self.step(time, now)

    @property
    def hosts(self) -> Collection[HostName]:
        """Hosts whose clocks count."""
        return self._hosts.keys()

    def at(self, now: Ns) -> Ns:
        """Fleet time, in ns since 1970 (UTC)."""
        return now + self._offset

    def step(self, time: Ns, now: Ns) -> None:
        self._offset, self.set_at, self._doubted = time - now, now, None

    def correct(self, walls: Mapping[HostName, Ns], now: Ns, kept: Collection[HostName] = ()) -> Ns:
        """Compare fleet time with hosts' clocks read at `now`, of which a time service keeps those in `kept`. Return
        the correction; 0: none. Missing hosts count with their clocks of the last hour: a host that is alone for a
        while is not the majority."""
        offsets, before = {host: wall - now for host, wall in walls.items()}, self._hosts
        silent = [item for item in before.items() if item[0] not in walls and now - item[1].at < REMEMBERED]
        latest = [(host, _Clock(offset, now, host in kept)) for host, offset in offsets.items()]
        self._hosts = dict([*silent, *latest][-MAX_HOSTS:])
        clocks = self._hosts.values()
        aim = agreed((clock.offset for clock in clocks), self._offset, [clock.offset for clock in clocks if clock.kept])
        if not _differ(aim, self._offset):
            self._doubted = None
            return 0
        if self._doubted is None or _differ(aim, self._doubted[0]):
            self._doubted = aim, now
        was_set = any(
            host in before and _differ(offset, before[host].offset) and not _differ(offset, aim)
            for host, offset in offsets.items()
        )
        if not was_set and now - self._doubted[1] < DIFFERENCE_LASTS:
            return 0
        moved = aim - self._offset
        self.step(now + aim, now)
        self.corrected = moved, now
        return moved
