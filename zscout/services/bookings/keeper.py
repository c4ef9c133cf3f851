"""What one host keeps of the fleet's bookings: in memory, and on its disk if it has a state folder.

Each host that may lead or has RCs is one. It learns of bookings from the leader alone, which asks all at once to keep
what it has, and hears in the same answer what others have and it has not."""

from __future__ import annotations

import asyncio
import logging
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, Protocol

import msgspec

from zscout.config.state_folder import write_durably
from zscout.config.strict import BadInput, read_bytes
from zscout.mesh import Declaration, IncomingQuery, Mesh, Refused
from zscout.mesh.supervision import Supervisor
from zscout.messages import (
    MAX_MERGED,
    MAX_STATE,
    BookingRecord,
    BookingsKept,
    Grants,
    Malformed,
    ShareBookings,
    decode,
    decode_told,
    encode,
)
from zscout.services.bookings.fleet_clock import DIFFERS, SAME, SLEW
from zscout.services.bookings.records import Records
from zscout.types import NO_TERM, SECOND, VERSION, Ns, Term

log = logging.getLogger(__name__)

FILE: Final = "bookings.json"
ASIDE: Final = "bookings.damaged.json"
MAX_SAVING: Final = 16
"""Answers that wait for the disk at one time."""
UNASKED: Final[Ns] = 40 * SECOND
"""After which a keeper that hears a leader, and is not asked by it, is not seen: each is asked every 30 s."""
LEFT: Final[Ns] = 5 * SECOND
"""Silence after which a leader counts as heard anew."""


class _BookingFile(msgspec.Struct):
    """What is kept on disk."""

    fleet: str
    records: Annotated[list[msgspec.Raw], msgspec.Meta(max_length=MAX_MERGED)] = []


class Disk(Protocol):
    """Where records outlive their process."""

    def read(self) -> list[BookingRecord]: ...
    async def write(self, records: list[BookingRecord]) -> None:
        """They are on disk on return. Raises OSError."""


class BookingFile:
    """A file of one fleet's bookings. A record that can't be read is left out, and told in the log; as the next write
    would be its end, a copy of such a file is kept."""

    def __init__(self, folder: Path, fleet: str) -> None:
        self._path, self._fleet = folder / FILE, fleet

    def read(self) -> list[BookingRecord]:
        if not self._path.exists():
            return []
        try:
            kept: _BookingFile = decode(read_bytes(self._path, max_bytes=MAX_STATE), _BookingFile, MAX_STATE)
        except (BadInput, Malformed) as error:
            log.warning("%s can't be read, and is not used%s: %s", self._path, self._set_aside(), error)
            return []
        if kept.fleet != self._fleet:
            log.warning("%s is of fleet %s, and is not used%s", self._path, kept.fleet, self._set_aside())
            return []
        found: list[BookingRecord] = []
        for raw in kept.records:
            try:
                found.append(decode_told(bytes(raw), BookingRecord))
            except Malformed as error:
                log.warning("a booking in %s can't be read, and is left out: %s", self._path, error)
        if len(found) < len(kept.records):
            log.warning("%s is not used whole%s", self._path, self._set_aside())
        return found

    def _set_aside(self) -> str:
        """Keeps a copy; the last one stays. What is to be said of it."""
        try:
            shutil.copy(self._path, self._path.with_name(ASIDE))
        except OSError as error:
            return f" (and can't be set aside: {error.strerror})"
        return f" (a copy stays as {ASIDE})"

    async def write(self, records: list[BookingRecord]) -> None:
        content = encode(_BookingFile(self._fleet, [msgspec.Raw(encode(record)) for record in records]))
        await asyncio.to_thread(write_durably, self._path, content, 0o600)


class BookingKeeper:
    """`wall`: the host's clock, in seconds since 1970 (UTC)."""

    def __init__(
        self, mesh: Mesh, disk: Disk | None = None, *, candidate: bool = True, wall: Callable[[], float] = time.time
    ) -> None:
        self.mesh, self.wall, self._disk, self._candidate = mesh, wall, disk, candidate
        self.records = Records()
        self._offset: Ns | None = None
        """What fleet time is more than the own clock, as it was heard last."""
        self.heard: tuple[Term, Ns] = NO_TERM, 0
        """In which term, and when, that was."""
        self.since: Ns = 0
        """Since when it has gone on, on the own clock."""
        self._leader: tuple[Term, Ns, Ns] = NO_TERM, 0, 0
        """Who is heard, since when, and when last."""
        self._asked: Ns = 0
        """When a leader asked last."""
        self._saved = self.records.digest()
        """What the disk has."""
        self._saving = asyncio.Lock()
        self._waiting = 0
        self._declared: list[Declaration] = []
        self.on_shared: Callable[[], None] = lambda: None
        """Called when another leader told of what was not known here."""
        if disk is not None:
            self.records.take(disk.read())
            self._saved = self.records.digest()

    def start(self, supervisor: Supervisor) -> None:
        """From now on it answers the leader."""
        self._supervisor, keys, guard = supervisor, self.mesh.keys, supervisor.guard
        key = keys.bookings(self.mesh.me.host)
        self._declared = [self.mesh.serve(key, ShareBookings, guard(self._on_shared), limit=MAX_STATE)]
        if not self._candidate:
            # A candidate passes on whom it believes. Here fleet time is of no use, and a leader is heard all the same.
            watch = guard(lambda _key, grants: self._look_whether_asked(grants))
            self._declared.append(self.mesh.subscribe(keys.grants, Grants, watch))

    def stop(self) -> None:
        for declared in self._declared:
            declared.close()

    # Fleet time

    def hear(self, grants: Grants) -> None:
        """A publication of the leader. One that tells an earlier time than can be was late, be it of another leader
        than the last: it may have waited here while this process stood still. And a leader that knew none as it began
        tells a younger time than is known here, until it has heard of this one."""
        if grants.time is None:
            return
        self._look_whether_asked(grants)
        now, (term, at) = self.mesh.now(), self.heard
        offset, since = round(grants.time * SECOND) - now, now - round(grants.time_age * SECOND)
        if self._offset is not None:
            near = abs(offset - self._offset) <= DIFFERS * SECOND
            if near or (grants.term == term and since >= self.since - SAME * SECOND):
                # Slewed as far as it may be, on a clock that is as far off again.
                offset = max(offset, self._offset - 2 * (now - at) // SLEW)
            elif since > self.since + SAME * SECOND:
                return
            since = min(since, self.since)
        self._offset, self.heard, self.since = offset, (grants.term, now), since

    def _look_whether_asked(self, grants: Grants) -> None:
        """A leader that is heard, and that knows bookings, asks each keeper that it sees."""
        if grants.time is None:
            return
        now, (leader, since, last) = self.mesh.now(), self._leader
        self._leader = grants.term, since if leader == grants.term and now - last < LEFT else now, now
        unasked = now - max(self._asked, self._leader[1]) > UNASKED
        self.mesh.suspicions.suspect("a leader is heard that asks nothing about bookings", so=unasked)

    @property
    def time(self) -> Ns | None:
        """Fleet time, in ns since 1970 (UTC), as it goes on here; None: it was never heard."""
        return None if self._offset is None else self.mesh.now() + self._offset

    # Records

    async def save(self) -> bool:
        """Whether what is known now is on disk on return; False where there is none, or it fails."""
        if self._disk is None:
            return False
        async with self._saving:
            digest = self.records.digest()
            if digest == self._saved:
                return True
            try:
                await self._disk.write(list(self.records))
            except OSError as error:
                log.warning("bookings can't be written to disk: %s", error)
                return False
            self._saved = digest
        return True

    def told(self, digest: str, *, durable: bool) -> BookingsKept:
        """What is kept here, for one who knows what `digest` tells: its records where it may know others."""
        own, heard = self.records.digest(), self.time
        return BookingsKept(
            self.mesh.me.host,
            self._candidate,
            self.wall(),
            own,
            time=None if heard is None else heard / SECOND,
            time_age=0.0 if heard is None else (self.mesh.now() - self.since) / SECOND,
            durable=durable,
            records=[] if own == digest else list(self.records),
            version=VERSION,
        )

    def _on_shared(self, query: IncomingQuery[ShareBookings]) -> None:
        self._asked = self.mesh.now()
        if self._waiting >= MAX_SAVING:
            raise Refused("busy", "this host is still writing bookings to its disk; try again")
        if query.message.time is not None:
            self.records.forget_old(query.message.time)
        if self.records.take(query.message.records):
            self.on_shared()
        if self._disk is None or self.records.digest() == self._saved:
            query.answer(self.told(query.message.digest, durable=self._disk is not None))
            return
        self._waiting += 1
        self._supervisor.spawn(self._answer_saved(query))

    async def _answer_saved(self, query: IncomingQuery[ShareBookings]) -> None:
        try:
            durable = await self.save()
        finally:
            self._waiting -= 1
        query.answer(self.told(query.message.digest, durable=durable))
