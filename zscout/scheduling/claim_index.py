"""Active bookings by id, date and RC; the bookings of a time span are found without a scan of all."""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterable, Iterator

from zscout.scheduling.booking import Booking
from zscout.scheduling.model import Claim, Rc, union
from zscout.types import Ns


class DateIndex:
    """Claims by time. Claims of similar length share a list sorted by start, so a long claim slows no search."""

    def __init__(self) -> None:
        self._levels: dict[int, list[tuple[Ns, str, Claim]]] = {}  # by the bits of the length

    def __bool__(self) -> bool:
        return bool(self._levels)

    def add(self, start: Ns, end: Ns, claim: Claim) -> None:
        insort(self._levels.setdefault((end - start).bit_length(), []), (start, claim.booking.id, claim))

    def remove(self, start: Ns, end: Ns, claim: Claim) -> None:
        level = (end - start).bit_length()
        entries = self._levels[level]
        del entries[bisect_left(entries, (start, claim.booking.id))]
        if not entries:
            del self._levels[level]

    def discard(self, start: Ns, end: Ns, claim: Claim) -> None:
        entries = self._levels.get((end - start).bit_length(), [])
        at = bisect_left(entries, (start, claim.booking.id))
        if at < len(entries) and entries[at][2] is claim:
            self.remove(start, end, claim)

    def overlapping(self, start: Ns, end: float) -> list[Claim]:
        """The claims that may overlap this span: some begin up to twice their length before it."""
        found: list[Claim] = []
        for level, entries in self._levels.items():
            first, last = bisect_left(entries, (start - (1 << level),)), bisect_left(entries, (end,))
            if first < last:
                found += [entry[2] for entry in entries[first:last]]
        return found


class ClaimIndex:
    """Call `add`, `put` or `remove` at every change of a booking, its ARC or its RCs."""

    def __init__(self) -> None:
        self.by_id: dict[str, Claim] = {}
        self.maintenance: dict[str, Claim] = {}
        self.claimed = 0  # bits of the RCs booked at any time
        self.contended = 0  # bits of the RCs whose holders may have another upcoming end (`upcoming.py`)
        self.version = 0  # grows with each change
        self.touched: dict[tuple[Claim, int, Ns, Ns], None] = {}
        """Changed claims, each with its RCs and span before and after; `Calendar` empties it."""
        self._by_rc: dict[int, DateIndex] = {}
        self._by_date: list[tuple[Ns, str]] = []
        self._ends: list[tuple[Ns, str]] = []
        """A heap of lapses and ends of bookings and starts of maintenance. Outdated entries are skipped."""
        self._spans: dict[Claim, tuple[int, Ns, Ns]] = {}  # as indexed
        self._touched_at: dict[int, int] = {}  # by bit: the version at the last change
        self._seen: tuple[int, int, int] | None = None
        self._suspended: set[Claim] = set()  # past their dates while an RC is absent: nothing is kept for them

    def add(self, claim: Claim) -> None:
        booking = claim.booking
        self.by_id[booking.id] = claim
        if booking.maintenance:
            self.maintenance[booking.id] = claim
        self._enter(claim)

    def put(self, claim: Claim, *, changed: bool = True) -> None:
        """Index an active claim again after a change. Not `changed`: it moved by the same step as all others."""
        self._leave(claim, changed=changed)
        self._enter(claim, changed=changed)

    def remove(self, claim: Claim) -> None:
        del self.by_id[claim.booking.id]
        self.maintenance.pop(claim.booking.id, None)
        self._leave(claim)
        self._suspended.discard(claim)

    def _enter(self, claim: Claim, *, changed: bool = True) -> None:
        booking = claim.booking
        start, end = min(booking.start, claim.date), max(booking.start, claim.date) + booking.runtime
        mask = claim.kept | claim.mask
        self._spans[claim] = mask, start, end
        for bit in bits(mask):
            self._by_rc.setdefault(bit, DateIndex()).add(start, end, claim)
        self.claimed |= mask
        insort(self._by_date, (start, booking.id))
        for at in _instants(booking):
            heapq.heappush(self._ends, (at, booking.id))
        self._touch(claim, changed=changed)

    def _leave(self, claim: Claim, *, changed: bool = True) -> None:
        self._touch(claim, changed=changed)
        mask, start, end = self._spans.pop(claim)
        for bit in bits(mask):
            timeline = self._by_rc[bit]
            timeline.remove(start, end, claim)
            if not timeline:
                del self._by_rc[bit]
                self.claimed &= ~bit
        del self._by_date[bisect_left(self._by_date, (start, claim.booking.id))]

    def _touch(self, claim: Claim, *, changed: bool = True) -> None:
        self.version += 1
        mask, start, end = self._spans[claim]
        if changed:
            self.touched[claim, mask, start, end] = None
            self.contended |= mask
        for bit in bits(mask):
            self._touched_at[bit] = self.version

    def changed_since(self, version: int) -> int:
        """Bits of the RCs whose bookings have changed since this version."""
        return 0 if version == self.version else union(bit for bit, at in self._touched_at.items() if at > version)

    def pass_time(self, now: Ns, present: int) -> None:
        """Suspend the bookings past their dates of which an RC is absent, and resume the others."""
        begun = bisect_right(self._by_date, (now, "\U0010ffff"))
        if (seen := (begun, present if begun else 0, self.version)) == self._seen:
            return
        suspended = {claim for claim in self.begun(now) if not claim.booking.maintenance and claim.mask & ~present}
        for claim in suspended ^ self._suspended:
            self._touch(claim)
        self._suspended = suspended
        self._seen = (*seen[:2], self.version)

    def begun(self, now: Ns) -> list[Claim]:
        return [self.by_id[name] for _, name in self._by_date[: bisect_right(self._by_date, (now, "\U0010ffff"))]]

    def of(self, rc: Rc, start: Ns, end: float = math.inf) -> list[Claim]:
        """The claims that may hold or keep `rc` at some time of this span."""
        timeline = self._by_rc.get(rc.bit)
        return [] if timeline is None else timeline.overlapping(start, end)

    def booked(self, rc: Rc, start: Ns, end: float) -> list[Claim]:
        """The claims that hold or keep `rc` at some time of this span, and are not suspended."""
        return [
            claim
            for claim in self.of(rc, start, end)
            if (booking := claim.booking).start < end
            and booking.start + booking.runtime > start
            and claim.mask & rc.bit
            and claim not in self._suspended
        ]

    def is_suspended(self, claim: Claim) -> bool:
        return claim in self._suspended

    def over(self, now: Ns) -> Iterator[Claim]:
        """Yield the bookings whose time or patience is over, each perhaps twice."""
        while self._ends and self._ends[0][0] <= now:
            at, booking = heapq.heappop(self._ends)
            claim = self.by_id.get(booking)
            if claim is not None and at in (claim.booking.lapses, claim.booking.end):
                yield claim

    def next_change(self) -> Ns | None:
        while self._ends:
            at, booking = self._ends[0]
            claim = self.by_id.get(booking)
            if claim is not None and at in _instants(claim.booking):
                return at
            heapq.heappop(self._ends)
        return None


def bits(mask: int) -> Iterator[int]:
    while mask:
        low = mask & -mask
        yield low
        mask ^= low


def by_date(claims: Iterable[Claim]) -> list[Claim]:
    return sorted(claims, key=lambda claim: (claim.booking.start, claim.booking.id))


def _instants(booking: Booking) -> tuple[Ns, ...]:
    return (booking.start, booking.end) if booking.maintenance else (booking.lapses, booking.end)
