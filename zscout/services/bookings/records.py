"""Records of bookings, merged one by one: whoever has heard of the same ones knows the same, in whatever order. Pure.

What changes of a record only grows: it is given up, or dates of it are, or are over. So nothing that was given up
comes back from a host that was away, however old its copy is."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from typing import Final

from msgspec.structs import replace

from zscout.messages import MAX_MERGED, BookingRecord, encode
from zscout.services.bookings.dates import DAY, last_end

MAX_BYTES: Final = 12_000_000
"""Of all records: one answer, and a file, has room for them."""
KEEP: Final = DAY
"""Seconds for which a record is kept beyond its last end: clocks may differ."""


def merged(one: BookingRecord, other: BookingRecord) -> BookingRecord:
    """What both tell of one booking. The newer tells all but what is final."""
    newer = max(one, other, key=lambda record: (record.changed, _changing(record)))
    return replace(
        newer,
        made=min(one.made, other.made),
        unbooked=one.unbooked or other.unbooked,
        dropped=sorted({*one.dropped, *other.dropped}),
        over=sorted({*one.over, *other.over}),
    )


def _changing(record: BookingRecord) -> bytes:
    """What the newer tells."""
    return encode(replace(record, made=record.changed, unbooked=False, dropped=[], over=[]))


class Records:
    """All bookings that a process knows, by id."""

    def __init__(self) -> None:
        self._records: dict[str, BookingRecord] = {}
        self.size = 0
        """In bytes, as they are sent."""
        self._digest: str | None = None

    def __iter__(self) -> Iterator[BookingRecord]:
        return iter(self._records.values())

    def __len__(self) -> int:
        return len(self._records)

    def get(self, booking: str) -> BookingRecord | None:
        return self._records.get(booking)

    def take(self, records: Iterable[BookingRecord]) -> list[BookingRecord]:
        """Merges these, as far as there is room; returns what is not as it was."""
        changed = []
        for record in records:
            known = self._records.get(record.id)
            new = record if known is None else merged(known, record)
            if new == known:
                continue
            grown = len(encode(new)) - (0 if known is None else len(encode(known)))
            if self.size + grown <= MAX_BYTES and (known is not None or len(self) < MAX_MERGED):
                self._records[record.id] = new
                self.size += grown
                changed.append(new)
        if changed:
            self._digest = None
        return changed

    def remove(self, booking: str) -> None:
        """As if it had never been made."""
        if (record := self._records.pop(booking, None)) is not None:
            self.size -= len(encode(record))
            self._digest = None

    def forget_old(self, time: float) -> bool:
        """Forgets those that were over a day ago, by fleet time; whether there were any."""
        old = [record.id for record in self if last_end(record) + KEEP < time]
        for booking in old:
            self.remove(booking)
        return bool(old)

    def digest(self) -> str:
        """The same for who knows the same."""
        if self._digest is None:
            found = hashlib.sha256()
            for _, record in sorted(self._records.items()):
                found.update(encode(record))
            self._digest = found.hexdigest()[:32]
        return self._digest
