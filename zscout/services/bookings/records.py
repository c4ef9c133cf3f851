"""Records of bookings, merged to the same result in any order. Pure.

Final facts only accumulate (a record, or a date, was given up or is over), so an old copy restores nothing."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from typing import Final

from msgspec.structs import replace

from zscout.messages import MAX_MERGED, BookingRecord, encode
from zscout.services.bookings.dates import DAY, last_end
from zscout.types import NO_TERM, Grant

MAX_BYTES: Final = 12_000_000  # of all records: the limit of one answer, and of a file
KEEP: Final = DAY  # seconds a record is kept after its last end: clocks may differ


def merged(record: BookingRecord, other: BookingRecord) -> BookingRecord:
    """Merge two records of one booking: the newer, with the final facts of both."""
    newer = max(record, other, key=lambda known: (known.changed, _changing(known)))
    return replace(
        newer,
        made=min(record.made, other.made),
        unbooked=record.unbooked or other.unbooked,
        dropped=sorted({*record.dropped, *other.dropped}),
        over=sorted({*record.over, *other.over}),
    )


def _changing(record: BookingRecord) -> bytes:
    """The parts taken from the newer record."""
    return encode(replace(record, made=record.changed, unbooked=False, dropped=[], over=[]))


class Records:
    """All bookings that a process knows, by id."""

    def __init__(self) -> None:
        self._records: dict[str, BookingRecord] = {}
        self._encoded: dict[str, bytes] = {}
        self.size = 0  # encoded bytes
        self.latest = Grant(NO_TERM, 0)  # number of the last change of any record
        self._digest: str | None = None

    def __iter__(self) -> Iterator[BookingRecord]:
        return iter(self._records.values())

    def __len__(self) -> int:
        return len(self._records)

    def get(self, booking: str) -> BookingRecord | None:
        return self._records.get(booking)

    def take(self, records: Iterable[BookingRecord]) -> list[BookingRecord]:
        """Merge records while there is room; return the changed ones."""
        changed = []
        for record in records:
            known = self._records.get(record.id)
            new = record if known is None else merged(known, record)
            if new == known:
                continue
            encoded = encode(new)
            grown = len(encoded) - len(self._encoded.get(record.id, b""))
            if self.size + grown <= MAX_BYTES and (known is not None or len(self) < MAX_MERGED):
                self._records[record.id], self._encoded[record.id] = new, encoded
                self.latest = max(self.latest, new.changed)
                self.size += grown
                changed.append(new)
        if changed:
            self._digest = None
        return changed

    def remove(self, booking: str) -> None:
        """Leaves no trace."""
        if self._records.pop(booking, None) is not None:
            self.size -= len(self._encoded.pop(booking))
            self._digest = None

    def forget_old(self, time: float) -> bool:
        """Forget records that ended a day ago, by fleet time; return True if there were any."""
        old = [record.id for record in self if last_end(record) + KEEP < time]
        for booking in old:
            self.remove(booking)
        return bool(old)

    def digest(self) -> str:
        """A digest that is equal for equal records."""
        if self._digest is None:
            encoded = b"".join(self._encoded[booking] for booking in sorted(self._encoded))
            self._digest = hashlib.sha256(encoded).hexdigest()[:32]
        return self._digest
