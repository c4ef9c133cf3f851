"""Bookings in a simulated fleet: disks and clocks of hosts, and programs that book, give up and take up."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from decimal import Decimal
from functools import lru_cache
from typing import Any, Final

from studies.faults.booking_promises import BookingPromises, Life
from studies.faults.programs import Work
from zscout.behaviors.client.arc import Revoked, hold
from zscout.behaviors.client.bookings import BookingsClient, RcmSilent
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.client.request import amounts
from zscout.keyexpr import RANDOM, new_instance
from zscout.messages import (
    Amounts,
    Book,
    BookingRecord,
    BookingView,
    FindSlots,
    SlotsTold,
    Unbook,
    decode_received,
    encode,
)
from zscout.services.bookings.dates import DAY
from zscout.testing.virtual_time import START

EPOCH: Final = 1_804_000_000.0
"""Seconds since 1970 at the beginning of a run: four weeks before a change to summer time."""
SECONDS_OFF, HOURS_OFF, DRIFT = 3.0, (3_600.0, 20_000.0), 0.0005
"""Largest offset of a host's clock, its range in some runs (all in seconds), and the largest rate of its drift."""
SOON, FAR = (1, 12), (8_000, 12_000)
"""Seconds until the date of a booking. Far dates are beyond the hour for which components hold, as nearer dates would
keep them from starting."""
TIMES: Final = (1, 2, 2, 3, 40)
"""Repetitions of bookings: some continue after a month."""
QUICK, SLOW = (0.001, 0.02), (0.1, 1.0)
"""Seconds for a write to a disk."""
TIMEOUT: Final = 3.0
"""Seconds after which the outcome of an operation is unknown."""
WAITS: Final = 25.0
REFUSED: Final = frozenset({"not_free", "bad_date", "not_kept", "unknown_booking", "unknown_device"})
"""Permitted codes of refused operations. (A new leader does not know RCs that are down.)"""
NOT_TAKEN: Final = frozenset({"unknown_booking"})


@lru_cache(1 << 12)
def _record(raw: bytes) -> BookingRecord:
    return decode_received(raw, BookingRecord)


class MemoryDisk:
    """A disk, which outlives the processes of its host. A write that was not complete when its process died is lost."""

    def __init__(self, takes: tuple[float, float] = QUICK) -> None:
        self.content: list[bytes] = []
        self.failing = False
        self._takes = takes

    def read(self) -> list[BookingRecord]:
        return [_record(raw) for raw in self.content]

    async def write(self, records: list[BookingRecord]) -> None:
        content = [encode(record) for record in records]
        await asyncio.sleep(RANDOM.get().uniform(*self._takes))
        if self.failing:
            raise OSError(28, "no space left on device")
        self.content = content


class Hosts:
    """`now` is virtual time."""

    def __init__(self, seed: int, hosts: list[str], now: Callable[[], float], *, booked: bool) -> None:
        rng = random.Random(f"hosts {seed}")  # noqa: S311 - what failed once must fail again
        self._now, self._passed = now, 0.0
        self.disks = {host: MemoryDisk(SLOW if rng.random() < 0.15 else QUICK) for host in hosts}
        self.ahead = {host: rng.uniform(-SECONDS_OFF, SECONDS_OFF) for host in hosts}
        """Seconds by which each host's clock is ahead."""
        self._set: dict[str, list[tuple[float, float]]] = {host: [] for host in hosts}
        """When each host's clock was set, and by how many seconds it was ahead before."""
        self._drift = {host: rng.uniform(-DRIFT, DRIFT) for host in hosts}
        self._copies: dict[str, list[bytes]] = {}
        if booked and rng.random() < 0.4:
            for host in rng.sample(hosts, rng.choice((1, 1, len(hosts)))):
                self.ahead[host] = rng.choice((-1, 1)) * rng.uniform(*HOURS_OFF)
        self.kept = {host: rng.random() < 0.5 for host in hosts}
        """By host: True if it reports that a time service keeps its clock."""

    def wall(self, host: str) -> float:
        """The clock of a host, in seconds since 1970."""
        return self._wall(host, self.ahead[host])

    def _wall(self, host: str, ahead: float) -> float:
        return EPOCH + self._passed + (self._now() - START) * (1 + self._drift[host]) + ahead

    def set_clock(self, host: str, by: float) -> None:
        """Set the clock of a host `by` seconds ahead."""
        self._set[host].append((self._now(), self.ahead[host]))
        self.ahead[host] += by

    def believed(self, host: str, within: float) -> list[float]:
        """The clock of a host: now, and as if it had not been set in the last `within` seconds."""
        former = [ahead for at, ahead in self._set[host] if self._now() - at < within]
        return [self._wall(host, ahead) for ahead in (self.ahead[host], *former)]

    def pass_by(self, seconds: float) -> None:
        """Advance all clocks by a time in which no process ran."""
        self._passed += seconds

    def copy_disks(self) -> None:
        self._copies = {host: disk.content for host, disk in self.disks.items()}

    def fail(self, hosts: Iterable[str], *, fails: bool = True) -> None:
        for host in hosts:
            self.disks[host].failing = fails

    def restore_disk(self, host: str) -> None:
        """Restore the disk from its copy; without a copy, it is empty."""
        self.disks[host].content = self._copies.get(host, [])


@dataclass(slots=True)
class Booker:
    """A program with bookings. Its operations outlive it."""

    name: str
    work: Work
    promises: BookingPromises
    fleet_time: float = 0.0
    number: int = 0
    lives: dict[str, Life] = field(default_factory=dict)
    """Its bookings, by id."""
    unknown: list[Book | Unbook] = field(default_factory=list)
    """Operations with unknown outcomes."""

    async def run(self, client: Client, busy: set[str]) -> None:
        rng, bookings = RANDOM.get(), BookingsClient(client, timeout=TIMEOUT)
        await asyncio.sleep(rng.uniform(0.2, 2))
        async with asyncio.TaskGroup() as takers:
            while not self.work.over:
                try:
                    self.fleet_time = (await bookings.list()).time
                    operation = await self._next(bookings)
                    if operation is not None and not self.work.over:
                        await self._do(bookings, operation, client, busy, takers)
                except RcmSilent:
                    self.work.counts["bookings: RCM silent"] += 1
                await asyncio.sleep(rng.uniform(0.1, 1.5))

    async def _next(self, bookings: BookingsClient) -> Book | Unbook | None:
        rng = RANDOM.get()
        if self.unknown and rng.random() < 0.5:
            return self.unknown.pop(0)
        mine = [life for life in self.lives.values() if life.made and not life.given_up]
        what = rng.random()
        if what < 0.25 and mine:
            life = rng.choice(mine)
            return Unbook(life.book.id, rng.choice((None, *life.dates())) if life.book.every else None)
        self.number += 1
        near = rng.random() < 0.65
        start = math.ceil(self.fleet_time) + rng.randrange(*(SOON if near else FAR))
        runtime = rng.randrange(1, 5) if near else rng.randrange(100, 1_000)
        needs = self._needs()
        if what < 0.45 and (slot := await self._slot(bookings, needs, start, runtime)) is not None:
            start = slot
        more: dict[str, Any] = {}
        if rng.random() < 0.25:
            every = rng.choice((1, 1, 7))
            until = start + every * DAY * rng.choice(TIMES)
            more = {"every": every, "until": until, "zone": rng.choice(("UTC", "Europe/Berlin"))}
        if rng.random() < 0.06 and all("*" not in need for need in needs):
            more["maintenance"] = True
        return Book(
            id=new_instance() + f"{self.number}",
            name=f"booked-{self.name.replace('/', '-')}-{self.number}",
            needs=needs,
            priority=rng.choice((0, 0, 0, 1, 5)),
            start=start,
            runtime=Decimal(runtime),
            patience=Decimal(rng.choice((1, 3, runtime))),
            **more,
        )

    def _needs(self) -> dict[str, Amounts]:
        rng = RANDOM.get()
        if rng.random() < 0.2:
            return amounts({need: {} for need in rng.choice((("robot/*",), ("robot/*", "robot/*#2")))})
        rcs = rng.sample(sorted(self.work.devices), rng.choice((1, 1, 2)))
        return amounts({rc: {"rate": rng.choice((2, 4, 6))} if self.work.devices[rc] else {} for rc in rcs})

    async def _slot(self, bookings: BookingsClient, needs: Any, start: int, runtime: int) -> int | None:
        asked = FindSlots(new_instance(), needs, 0, Decimal(runtime), within=100.0, start=start, limit=2)
        try:
            slots = await bookings.ask(asked, SlotsTold)
        except RcmSilent:
            raise
        except RequestRefused as refused:
            self._refused(refused)
            return None
        self.work.counts["slots looked for"] += 1
        return slots.slots[0].start if slots.slots else None

    async def _do(
        self,
        bookings: BookingsClient,
        operation: Book | Unbook,
        client: Client,
        busy: set[str],
        takers: asyncio.TaskGroup,
    ) -> None:
        rng, counts = RANDOM.get(), self.work.counts
        if isinstance(operation, Book):
            if operation.id not in self.lives:
                self.lives[operation.id] = self.promises.asked(operation)
        else:
            self.lives[operation.id].give_up(operation.start)
        self.work.log(f"{self.name} {operation}")
        asked = self.promises.now()
        try:
            # If this program dies now, it asks again after its restart.
            self.unknown.append(operation)
            view = await bookings.ask(operation, BookingView)
        except RequestRefused as refused:
            if not isinstance(refused, RcmSilent):
                self.unknown.remove(operation)
                self._refused(refused)
            else:
                counts["bookings: outcome unknown"] += 1
            return
        self.unknown.remove(operation)
        life = self.lives[operation.id]
        if isinstance(operation, Unbook):
            counts["unbooked" if operation.start is None else "dates unbooked"] += 1
            self.promises.unbooked(life, operation.start, view, asked)
            return
        self.promises.booked(life, view, asked)
        if not life.made:
            return
        counts["booked"] += 1
        if operation.maintenance or operation.start > self.fleet_time + 2 * SOON[1] or rng.random() < 0.2:
            return
        late = rng.uniform(-1, float(operation.patience)) if rng.random() < 0.3 else -60
        wait = max(0.0, operation.start + late - self.fleet_time)
        takers.create_task(self._take_up(client, operation, busy, wait + rng.uniform(0, 0.5)))

    def _refused(self, refused: RequestRefused) -> None:
        self.work.counts[f"bookings refused {refused.code}"] += 1
        self.work.log(f"refused {refused.code}: {refused}")
        if refused.code not in REFUSED:
            self.work.broken(f"an operation on bookings was refused: {refused.code}: {refused}")

    async def _take_up(self, client: Client, book: Book, busy: set[str], wait: float) -> None:
        await asyncio.sleep(wait)
        if self.work.over:
            return
        rng, counts = RANDOM.get(), self.work.counts
        arc = book.name.replace("booked", "takes")
        busy.add(arc)
        try:
            how = BookingsClient.terms(BookingView(**{name: getattr(book, name) for name in Book.__struct_fields__}))
            counts["take-ups asked for"] += 1
            async with hold(client, arc, keep=False, timeout=WAITS, **how) as held:
                counts["taken up"] += held.arc.booking != ""
                for _ in range(rng.randrange(1, 8)):
                    self.work.commanded += 1
                    echo = {"name": "echo", "value": f"command {self.work.commanded}"}
                    await held.command(rng.choice(held.rcs), echo)
                    await asyncio.sleep(rng.uniform(0.05, 0.5))
        except Revoked as revoked:
            counts[f"take-up revoked {revoked.outcome}"] += 1
        except (TimeoutError, CommandRefused):
            counts["take-up ended early"] += 1
        except RequestRefused as refused:
            counts[f"take-up refused {refused.code}"] += 1
            if refused.code not in NOT_TAKEN:
                self.work.broken(f"{arc} was thrown away: {refused.code}: {refused}")
        finally:
            busy.discard(arc)
