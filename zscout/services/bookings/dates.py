"""The dates of a repeated booking: the same hour in its owner's zone, across changes of summer time.

Repeated hours are the first, missing ones use the offset before the gap: RFC 5545, section 3.3.5, and `fold=0`."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime, timedelta
from functools import lru_cache
from typing import Final
from zoneinfo import ZoneInfo

from zscout.config.strict import quoted
from zscout.messages import MAX_AHEAD, BookingRecord, Instant

DAY: Final = 86_400


@lru_cache(256)
def zone_of(name: str) -> ZoneInfo:
    """A time zone by its IANA name. Raises ValueError for unknown ones."""
    try:
        return ZoneInfo(name)
    except (ValueError, KeyError, OSError):
        raise ValueError(f"{quoted(name[:80])} is not a time zone; write one, as in Europe/Berlin or UTC") from None


def dates(booking: BookingRecord, after: float, before: float) -> list[Instant]:
    """Starts in [`after`, `before`), including cancelled dates. Raises ValueError for an unknown zone."""
    return Repetition(booking).between(after, before)


class Repetition:
    """The dates of a booking, each found once. Raises ValueError, OverflowError as `dates` does."""

    def __init__(self, booking: BookingRecord) -> None:
        self._booking = booking
        self._known: list[Instant] = []
        self._coming: Iterator[Instant] | None = None
        self._from = math.inf

    def between(self, after: float, before: float) -> list[Instant]:
        if not self._booking.every:
            return [self._booking.start] if after <= self._booking.start < before else []
        self._find(after, before)
        return self._known[bisect_left(self._known, after) : bisect_left(self._known, before)]

    def first_from(self, time: float) -> float:
        """The first date at `time` or later; infinite if there is none."""
        if not self._booking.every:
            return self._booking.start if self._booking.start >= time else math.inf
        self._find(time, time)
        at = bisect_left(self._known, time)
        return self._known[at] if at < len(self._known) else math.inf

    def _find(self, after: float, before: float) -> None:
        """Find the dates from `after`, up to the first that is not before `before`."""
        if self._coming is None or after < self._from:
            self._coming, self._known, self._from = _repeated(self._booking, after), [], after
        while not self._known or self._known[-1] < before:
            at = next(self._coming, None)
            if at is None:
                return
            self._known.append(at)


def last_end(booking: BookingRecord) -> float:
    """The end of the last date, or a later time."""
    last = booking.start
    if booking.every:
        last = booking.until if booking.until is not None else booking.start + MAX_AHEAD
    return float(last) + float(booking.runtime)


def _repeated(booking: BookingRecord, after: float) -> Iterator[Instant]:
    """Yield dates, from one before `after` to the last."""
    zone = zone_of(booking.zone)
    first = datetime.fromtimestamp(booking.start, zone).replace(tzinfo=None)
    last = booking.until if booking.until is not None else booking.start + MAX_AHEAD
    # Days have 23 to 25 hours: start one date early.
    count = max(0, int((after - booking.start) // (booking.every * DAY)) - 1)
    while True:
        local = first + timedelta(days=count * booking.every)
        at = booking.start if count == 0 else round(local.replace(tzinfo=zone).timestamp())
        if at > last:
            return
        yield at
        count += 1


def in_zone(time: float, zone: str) -> str:
    with suppress(ValueError, OverflowError):
        return datetime.fromtimestamp(time, zone_of(zone)).strftime("%Y-%m-%d %H:%M:%S %Z")
    return f"{time:.0f} s after 1970"
