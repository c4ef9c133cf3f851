"""One host's copy of the fleet's bookings: in memory, and on disk with a state folder.

Each host that may lead or has RCs has a copy. Only the leader shares bookings: it asks all hosts at once to store its
records, and their answers contain the records that it lacks."""

from __future__ import annotations

import asyncio
import logging
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, Protocol

import msgspec

from zscout import messages
from zscout.config.state_folder import write_durably
from zscout.config.strict import BadInput, read_bytes
from zscout.mesh import Declaration, IncomingQuery, Mesh, Refused
from zscout.mesh.supervision import Supervisor
from zscout.services.bookings.fleet_clock import SAME
from zscout.services.bookings.records import Records
from zscout.types import NO_TERM, SECOND, VERSION, Ns, Term

log = logging.getLogger(__name__)

FILE: Final = "bookings.json"
ASIDE: Final = "bookings.damaged.json"
MAX_SAVING: Final = 16  # answers awaiting the disk at one time
UNASKED: Final[Ns] = 40 * SECOND
"""A keeper that gets no query from a leader for so long is invisible to it: each keeper is queried every 30 s."""
LEFT: Final[Ns] = 5 * SECOND  # silence after which a leader counts as new
APART: Final = 500  # clocks of two hosts drift apart by less than one part in so many


class _BookingFile(msgspec.Struct):
    fleet: str
    records: Annotated[list[msgspec.Raw], msgspec.Meta(max_length=messages.MAX_MERGED)] = []


class Disk(Protocol):
    def read(self) -> list[messages.BookingRecord]: ...
    async def write(self, records: list[messages.BookingRecord]) -> None:
        """Return once `records` are on disk. Raises OSError."""


class BookingFile:
    """A file of one fleet's bookings. Unreadable records are skipped and logged, and the file copied aside."""

    def __init__(self, folder: Path, fleet: str) -> None:
        self._path, self._fleet = folder / FILE, fleet

    def read(self) -> list[messages.BookingRecord]:
        if not self._path.exists():
            return []
        try:
            kept: _BookingFile = messages.decode(
                read_bytes(self._path, max_bytes=messages.MAX_STATE), _BookingFile, messages.MAX_STATE
            )
        except (BadInput, messages.Malformed) as error:
            log.warning("%s can't be read, and is not used%s: %s", self._path, self._set_aside(), error)
            return []
        if kept.fleet != self._fleet:
            log.warning("%s belongs to fleet %s, and is not used%s", self._path, kept.fleet, self._set_aside())
            return []
        found: list[messages.BookingRecord] = []
        for raw in kept.records:
            try:
                found.append(messages.decode_received(bytes(raw), messages.BookingRecord))
            except messages.Malformed as error:
                log.warning("a booking in %s can't be read, and is left out: %s", self._path, error)
        if len(found) < len(kept.records):
            log.warning("%s is damaged in part; its other bookings are used%s", self._path, self._set_aside())
        return found

    def _set_aside(self) -> str:
        """Return a remark for the log."""
        try:
            shutil.copy(self._path, self._path.with_name(ASIDE))
        except OSError as error:
            return f" (and can't be copied: {error.strerror})"
        return f" (a copy is kept as {ASIDE})"

    async def write(self, records: list[messages.BookingRecord]) -> None:
        content = messages.encode(
            _BookingFile(self._fleet, [msgspec.Raw(messages.encode(record)) for record in records])
        )
        await asyncio.to_thread(write_durably, self._path, content, 0o600)


class BookingKeeper:
    """Stores bookings and answers the leader. `wall`: the host's clock in seconds since 1970 (UTC); None: the present
    time, continued by the mesh's clock. `synchronised`: by a time service."""

    def __init__(
        self,
        mesh: Mesh,
        disk: Disk | None = None,
        *,
        candidate: bool = True,
        wall: Callable[[], float] | None = None,
        synchronised: Callable[[], bool | None] = lambda: None,
    ) -> None:
        self.mesh, self._disk, self._candidate = mesh, disk, candidate
        began = time.time() - mesh.now() / SECOND
        self.wall = wall or (lambda: began + mesh.now() / SECOND)
        self._synchronised = synchronised
        self.records = Records()
        self._offset: Ns | None = None  # fleet time minus the own clock, at the last publication
        self.received: tuple[Term, Ns] = NO_TERM, 0  # term and time of that publication
        self._run: Ns = 0  # fleet time at the start of its run, by that publication; a correction moves it
        self._leader: tuple[Term, Ns, Ns] = NO_TERM, 0, 0
        """The present leader's term, and the times of its first and last publication."""
        self._asked: Ns = 0  # last query of a leader
        self._saved = self.records.digest()  # digest of the records on disk
        self._saving = asyncio.Lock()
        self._waiting = 0
        self._declared: list[Declaration] = []
        self.shared = asyncio.Event()  # set when another leader shared new records
        if disk is not None:
            self.records.take(disk.read())
            self._saved = self.records.digest()

    def start(self, supervisor: Supervisor) -> None:
        self._supervisor, keys, guard = supervisor, self.mesh.keys, supervisor.guard
        key = keys.bookings(self.mesh.me.host)
        self._declared = [
            self.mesh.serve(key, messages.ShareBookings, guard(self._on_shared), limit=messages.MAX_STATE)
        ]
        if not self._candidate:
            # Candidates call `observe` themselves. Other hosts need no fleet time, but watch the leader.
            watch = guard(lambda _key, grants: self._check_queried(grants))
            self._declared.append(self.mesh.subscribe(keys.grants, messages.Grants, watch))

    def stop(self) -> None:
        for declared in self._declared:
            declared.close()

    def observe(self, grants: messages.Grants) -> None:
        """Take a publication of the leader. A delayed one shows too early a fleet time, but no delay changes when fleet
        time began. A leader that began without fleet time has a younger one than ours, until it learns ours."""
        if grants.time is None:
            return
        self._check_queried(grants)
        now, (_, at) = self.mesh.now(), self.received
        offset, run = round(grants.time * SECOND) - now, round((grants.time - grants.time_age) * SECOND)
        if self._offset is not None:
            if abs(run - self._run) <= SAME * SECOND:
                offset = max(offset, self._offset - (now - at) // APART)
            elif grants.time_age < self.age - SAME:
                return
        self._offset, self._run, self.received = offset, run, (grants.term, now)

    def _check_queried(self, grants: messages.Grants) -> None:
        """Suspect the link if a leader with fleet time does not query this keeper."""
        if grants.time is None:
            return
        now, (leader, since, last) = self.mesh.now(), self._leader
        self._leader = grants.term, since if leader == grants.term and now - last < LEFT else now, now
        unasked = now - max(self._asked, self._leader[1]) > UNASKED
        self.mesh.suspicions.suspect("the leader does not query this host's bookings", so=unasked)

    @property
    def time(self) -> Ns | None:
        """Fleet time here, in ns since 1970 (UTC); None: unknown."""
        return None if self._offset is None else self.mesh.now() + self._offset

    @property
    def age(self) -> float:
        """Seconds for which fleet time has run."""
        return 0.0 if self.time is None else max(0, self.time - self._run) / SECOND

    async def save(self) -> bool:
        """Return True once the present records are on disk; False without a disk, or if it fails."""
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

    def answer_to(self, digest: str, *, durable: bool) -> messages.BookingsKept:
        """Has records if the digests differ."""
        own, fleet_time = self.records.digest(), self.time
        return messages.BookingsKept(
            self.mesh.me.host,
            self._candidate,
            self.wall(),
            own,
            time=None if fleet_time is None else fleet_time / SECOND,
            time_age=self.age,
            durable=durable,
            records=[] if own == digest else list(self.records),
            version=VERSION,
            synchronised=self._synchronised() is True,
        )

    def _on_shared(self, query: IncomingQuery[messages.ShareBookings]) -> None:
        self._asked = self.mesh.now()
        if self._waiting >= MAX_SAVING:
            raise Refused("busy", "this host is still writing bookings to its disk; try again")
        if query.message.time is not None:
            self.records.forget_old(query.message.time)
        if self.records.take(query.message.records):
            self.shared.set()
        if self._disk is None or self.records.digest() == self._saved:
            query.answer(self.answer_to(query.message.digest, durable=self._disk is not None))
            return
        self._waiting += 1
        self._supervisor.spawn(self._answer_saved(query))

    async def _answer_saved(self, query: IncomingQuery[messages.ShareBookings]) -> None:
        try:
            durable = await self.save()
        finally:
            self._waiting -= 1
        query.answer(self.answer_to(query.message.digest, durable=durable))
