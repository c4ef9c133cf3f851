"""How events become bookings: several at a time, and what is said when that is interrupted."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any

import pytest
from msgspec.structs import asdict

from zscout.cli.bookings import calendar
from zscout.cli.bookings.calendar import CONCURRENT_BOOKINGS, _Import
from zscout.cli.bookings.calendar_plan import ImportPlan, Wanted
from zscout.messages import Book, BookingView


@dataclass
class Leader:
    """Answers `answers` bookings."""

    answers: int
    asked: list[str] = field(default_factory=list)
    waiting: int = 0
    most: int = 0

    def __call__(self, _: object) -> Leader:
        return self

    async def ask(self, wanted: Book, _: object) -> BookingView:
        self.asked.append(wanted.id)
        self.waiting += 1
        self.most = max(self.most, self.waiting)
        await asyncio.sleep(0.001)
        if len(self.asked) > self.answers:
            await asyncio.Event().wait()
        self.waiting -= 1
        return BookingView(**asdict(wanted), owner="desk", since=0)


def importing(leader: Leader, number: int, monkeypatch: pytest.MonkeyPatch) -> tuple[_Import, ImportPlan]:
    monkeypatch.setattr(calendar, "BookingsClient", leader)
    wanted: list[Wanted] = []
    for name in map(str, range(number)):
        hour = Decimal(3600)
        book = Book(
            id=name, name=name, needs={"robot/a": {}}, priority=0, start=2_000_000_000, runtime=hour, patience=hour
        )
        wanted.append(Wanted((name,), name, book))
    client: Any = None
    return _Import(client, client, [], dry_run=False, again=False), ImportPlan(wanted)


async def test_events_are_booked_several_at_a_time_and_told_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    work, plan = importing(leader := Leader(100), 20, monkeypatch)
    await work._run(plan, sync=False)
    assert (leader.most, [row.title for row in work.rows]) == (
        CONCURRENT_BOOKINGS,
        [wanted.title for wanted in plan.wanted],
    )
    assert {row.result for row in work.rows} == {"booked"}


async def test_an_import_that_is_interrupted_says_what_stays(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    work, plan = importing(leader := Leader(CONCURRENT_BOOKINGS), 20, monkeypatch)
    task = asyncio.create_task(work.run(plan, sync=False))
    while len(leader.asked) <= CONCURRENT_BOOKINGS:  # noqa: ASYNC110
        await asyncio.sleep(0.001)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert capsys.readouterr().err.startswith(f"{CONCURRENT_BOOKINGS} of 20 events imported; they stay booked; ")
