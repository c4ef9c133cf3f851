"""Notices to a holder of what its hold yields to next: a request, booking, maintenance. Pure; times in ns on this
host."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from zscout.messages import ReasonParty, Upcoming
from zscout.scheduling.reason import named
from zscout.types import SECOND, Ns, clean

WITHDRAWN_AFTER: Final[Ns] = 3 * SECOND // 2
"""Nanoseconds without a notice after which it counts as withdrawn: a new leader may answer the holder before it has
learned of all waiting requests."""
SAME: Final[Ns] = 2 * SECOND
"""Smallest change of a time that is reported, in ns."""


class HoldNotice(NamedTuple):
    """A hold yields to a waiting request (`code` is `waits`), a booking (`booked`) or maintenance (`maintenance`) of
    some of its devices; with `withdrawn`, it no longer does."""

    code: str
    by: ReasonParty
    """The request or booking, with its name (`arc`), priority and person (`who`)."""
    rcs: list[str]
    """The devices of the hold that are concerned."""
    safe_until: Ns
    """Time by the clock of `held.now()` until which the hold is safe from it; in the past, it may end at any time."""
    begins: Ns | None = None
    """Start of a booking or maintenance, by the same clock."""
    withdrawn: bool = False

    @classmethod
    def of(cls, end: Upcoming, now: Ns) -> HoldNotice:
        begins = None if end.begins_in is None else now + round(end.begins_in * SECOND)
        return cls(end.code, end.by, end.rcs, now + round(end.safe * SECOND), begins)

    def is_like(self, other: HoldNotice, now: Ns) -> bool:
        times = ((self.safe_until, other.safe_until), (self.begins or 0, other.begins or 0))
        close = all(abs(max(mine, now) - max(theirs, now)) < SAME for mine, theirs in times)
        return close and (self.by.client, self.by.id, self.rcs) == (other.by.client, other.by.id, other.rcs)

    def text(self, now: Ns, clock: Callable[[float], str] | None = None, by: str = "") -> str:
        """`clock` formats the time of day in so many seconds; `by` replaces the name of the request or booking."""
        by = by or named(self.by.who, self.by.client, self.by.arc)
        rcs = ", ".join(self.rcs)
        if self.withdrawn:
            return f"no request waits for {rcs} any more" if self.code == "waits" else f"{by} does not end the hold"
        left = (self.safe_until - now) / SECOND
        if left <= 0:
            ends = "the hold may end at any time"
        elif self.code == "waits":
            ends = f"yours until {clock(left)}" if clock is not None else f"yours for {left:.0f} s"
        else:
            ends = (
                f"the hold may end from {clock(left)} on" if clock is not None else f"the hold may end in {left:.0f} s"
            )
        if self.code == "waits":
            return f"{by} waits for {rcs}: {ends}"
        comment = self.by.who.comment if self.by.who is not None else ""
        ends += f" ({clean(comment)})" if comment else ""
        away = (self.begins or now) - now
        date = clock(away / SECOND) if clock is not None else f"in {away / SECOND:.0f} s"
        date = f" from {date}" if clock is not None else f" {date}"
        date = date if away > 0 else " now"
        what = f"maintenance of {rcs} by {by}" if self.code == "maintenance" else f"{by} has booked {rcs}"
        return f"{what}{date}: {ends}"


class NoticeTracker:
    """Decides which notices of one hold are new to its holder."""

    def __init__(self) -> None:
        self._known: dict[str, HoldNotice] = {}
        self._missing: dict[str, Ns] = {}

    @property
    def next(self) -> Ns | None:
        """Time of the next due `take`, even without changes."""
        return min((since + WITHDRAWN_AFTER for since in self._missing.values()), default=None)

    def take(self, ends: Sequence[HoldNotice], now: Ns) -> list[HoldNotice]:
        """Take all present notices; return the new, changed and withdrawn notices."""
        news, present = [], {end.code: end for end in ends}
        for code, end in present.items():
            self._missing.pop(code, None)
            if code not in self._known or not end.is_like(self._known[code], now):
                self._known[code] = end
                news.append(end)
        for code in [code for code in self._known if code not in present]:
            if now - self._missing.setdefault(code, now) >= WITHDRAWN_AFTER:
                del self._missing[code]
                news.append(self._known.pop(code)._replace(withdrawn=True))
        return news
