"""A fleet on a mesh in memory whose candidates keep bookings."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from decimal import Decimal
from typing import Any, TypeVar

from tests.mesh.kit import until
from tests.services.kit import answer
from tests.services.rcm.kit import FakeClient, FakeFleet, request
from zscout.mesh import IncomingQuery
from zscout.messages import Book, BookingRecord, BookingsAsk, BookingsTold, BookingView, Operation, ShareBookings
from zscout.rcm.steps import BookedDanger
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.rcm.candidate import Candidate, CandidateParts
from zscout.testing.memory import MemoryMesh

R = TypeVar("R")
NOON = 1_800_000_000.0
"""Seconds since 1970 at the beginning of each story."""


class Disk:
    """What outlives a process, in memory."""

    def __init__(self) -> None:
        self.records: list[BookingRecord] = []
        self.broken = False

    def read(self) -> list[BookingRecord]:
        return list(self.records)

    async def write(self, records: list[BookingRecord]) -> None:
        if self.broken:
            raise OSError("no space left")
        self.records = list(records)


class BookedFleet(FakeFleet):
    """Candidates with disks and clocks of their own."""

    def __init__(self, *candidates: str) -> None:
        self.meshes: list[MemoryMesh] = []
        super().__init__(*candidates, strategy="adaptive")
        self.disks: dict[str, Disk] = {}
        self.dangers: dict[str, list[BookedDanger]] = {}
        """By host, what it told of as it led."""
        self.ahead: dict[str, float] = {}
        """By how many seconds a host's clock is ahead."""
        self.synchronised = set[str]()
        """Hosts whose clocks are."""
        loop = asyncio.get_running_loop()
        begun = loop.time()
        self.time: Callable[[], float] = lambda: NOON + loop.time() - begun

    def mesh(self, host: str, client: str = "node") -> MemoryMesh:
        self.meshes.append(super().mesh(host, client))
        return self.meshes[-1]

    def part(self, host: str) -> None:
        """Cuts the links between a host and all others."""
        for one in self.meshes:
            for other in self.meshes:
                if (one.me.host == host) is not (other.me.host == host):
                    self.network.cut(one, other)

    def candidate(self, host: str, *_: Any, **how: Any) -> Candidate:
        disk = self.disks.setdefault(host, Disk())
        mesh = self.mesh(host)
        keeper = BookingKeeper(
            mesh,
            disk,
            wall=lambda: self.time() + self.ahead.get(host, 0.0),
            synchronised=lambda: host in self.synchronised,
        )
        parts = CandidateParts(keeper=keeper, on_danger=self.dangers.setdefault(host, []).append, **how)
        candidate = Candidate(mesh, self.fleet, parts)
        candidate.start()
        return candidate

    def silent(self) -> list[IncomingQuery[ShareBookings]]:
        """A host that answers no question about bookings: those that it was asked."""
        mesh, asked = self.mesh("silent"), list[IncomingQuery[ShareBookings]]()
        mesh.serve(mesh.keys.bookings("silent"), ShareBookings, asked.append)
        return asked

    async def bookings(self, **asked: Any) -> dict[str, BookingView]:
        return {view.id: view for view in (await self.told(**asked)).bookings}

    async def told(self, **asked: Any) -> BookingsTold:
        return await answer(self.watcher, self.watcher.keys.rcm_bookings, BookingsAsk(**asked), BookingsTold, timeout=1)


async def do(client: FakeClient, operation: Operation, kind: type[R]) -> R:
    return await answer(client.mesh, client.mesh.keys.schedule(client.mesh.me), operation, kind, timeout=10)


def book(name: str, *needs: str, at: float, seconds: float = 100, **more: Any) -> Book:
    """A booking whose id is its name; `at`: seconds after the beginning of the story."""
    wanted = request(name, *needs).needs
    settings = {"priority": 0, "patience": Decimal(20), **more}
    return Book(id=name, name=name, needs=wanted, start=round(NOON + at), runtime=Decimal(str(seconds)), **settings)


async def led(fleet: BookedFleet, *hosts: str) -> list[Candidate]:
    """Candidates, of which one leads, and two robots that count as there."""
    candidates = [fleet.candidate(host) for host in hosts]
    robots = [fleet.rc(f"robot/{name}") for name in "ab"]
    await until(lambda: any(one.rcm is not None and one.rcm.bookings.settled for one in candidates))
    await fleet.joined(*robots)
    return candidates


async def booked(*hosts: str) -> tuple[BookedFleet, list[Candidate]]:
    """A fleet that all these hosts may lead, and one does."""
    fleet = BookedFleet(*hosts)
    return fleet, await led(fleet, *hosts)


def states(view: BookingView) -> list[str]:
    return [date.state for date in view.dates]


def record(booking: Book, **more: Any) -> BookingRecord:
    """As a host keeps it."""
    return BookingRecord(**{name: getattr(booking, name) for name in Book.__struct_fields__}, **more)
