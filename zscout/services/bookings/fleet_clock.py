"""Fleet time: the leader's publications give all hosts the same dates. Pure.

It begins as the median of the hosts' clocks, and runs on the leader's monotonic clock. Where most of the hosts' clocks
differ from it, it is corrected in one step: at once if a clock was set to what they say, else after a minute."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from statistics import median_high, median_low
from typing import Final, NamedTuple

from zscout.types import SECOND, HostName, Ns

DIFFERS: Final = 2.0  # seconds of a host clock's error before a warning, and before a correction
LASTS: Final[Ns] = 60 * SECOND  # time for which most clocks differ before a correction
REMEMBERED: Final[Ns] = 3_600 * SECOND  # the clock of a silent host counts for so long
MAX_HOSTS: Final = 1_000  # whose clocks count: those read last
SAME: Final = 1.0  # seconds: fleet times that began this close together are equally old


def wall_ns(seconds: float) -> Ns:
    return round(seconds * SECOND)


def agreed(times: Iterable[Ns], goes_on: Ns | None = None, kept: Collection[Ns] = ()) -> Ns:
    """The median of several clocks at one instant. Of two middle ones the nearer to what clocks say that are `kept` by
    a time service; else to `goes_on`, the present time, which more may share; else the lower. Raises ValueError for
    none."""
    all_times = sorted(times)
    if kept:
        goes_on = agreed(kept, goes_on)
    low, high = median_low(all_times), median_high(all_times)
    return high if goes_on is not None and abs(high - goes_on) < abs(low - goes_on) else low


def _differ(offset: Ns, other: Ns) -> bool:
    return abs(offset - other) > DIFFERS * SECOND


class _Clock(NamedTuple):
    """A host's clock as it was read last: by how much it was ahead of the own one, when, and if a time service keeps
    it."""

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
        """By how much it was corrected last, and when."""
        self._doubted: tuple[Ns, Ns] | None = None
        """What most clocks say instead, as such an offset, and since when."""
        self.step(time, now)

    def at(self, now: Ns) -> Ns:
        """Fleet time, in ns since 1970 (UTC)."""
        return now + self._offset

    def step(self, time: Ns, now: Ns) -> None:
        """Set it to `time` at `now`."""
        self._offset, self.set_at, self._doubted = time - now, now, None

    def correct(self, walls: Mapping[HostName, Ns], now: Ns, kept: Collection[HostName] = ()) -> Ns:
        """Compare it with hosts' clocks as they were read at `now`, of which some are `kept` by a time service. Returns
        by how much it is corrected; 0: it is not.

        Hosts that are not among them count as they did within the last hour: a host that is alone for a while is not
        the majority."""
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
        if not was_set and now - self._doubted[1] < LASTS:
            return 0
        moved = aim - self._offset
        self.step(now + aim, now)
        self.corrected = moved, now
        return moved
