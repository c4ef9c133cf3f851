"""Devices that somebody has reported broken: operators alone get them, over changes of leader, until they are well."""

from __future__ import annotations

import asyncio
from decimal import Decimal
from typing import Any

import pytest

from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import BookedFleet, booked, do
from tests.services.rcm.kit import Refusal, request
from zscout.messages import WINDOW, Book, BookingView, Release, Unbook, Who

OPERATOR = 10
WHY = "its power supply smokes"
SPAN = Decimal(WINDOW)


def broken(fleet: BookedFleet, *needs: str, **more: Any) -> Book:
    terms: dict[str, Any] = {"start": round(fleet.time()), "runtime": SPAN, "patience": SPAN, "priority": 0}
    terms |= {"maintenance": True, "lasting": True, "broken": True, "who": Who(user="ada", comment=WHY)} | more
    return Book(id="b", name="broken", needs={need: {} for need in needs}, **terms)


async def test_the_holder_goes_on_and_nobody_but_operators_is_granted_it_until_it_is_well() -> None:
    fleet, (leader, heir) = await booked("x", "y")
    one, two, three = (fleet.client(name) for name in ("one", "two", "three"))
    await one.do(request("mine", "robot/a", seconds=1, keep=True))
    await do(one, broken(fleet, "robot/a"), BookingView)
    told = await two.ask("next", "robot/a", priority=OPERATOR - 1)
    assert (told.state, told.reason) == ("queued", f"robot/a is broken, as ada reports: {WHY}")
    # Kept past its minimum runtime it is not ended, as ordinary maintenance would.
    await asyncio.sleep(5)
    assert all(notice.state == "running" for notice in one.notices)
    assert (await three.ask("repair", "robot/a", priority=OPERATOR)).state == "running"
    fleet.network.kill(leader.mesh)
    await until(lambda: heir.rcm)
    assert (await two.ask("late", "robot/a")).state == "queued"
    assert (await two.ask("well", "robot/b")).state == "running"
    assert (await three.ask("again", "robot/a", priority=OPERATOR)).state == "running"
    await three.do(Release("again"))
    assert [view.broken for view in (await fleet.bookings()).values()] == [True]
    await do(one, Unbook("b"), BookingView)
    await until(lambda: two.notices[-1].state == "running")


@pytest.mark.parametrize(
    ("needs", "more"),
    [
        (("robot/a",), {"urgent": True}),
        (("robot/a",), {"lasting": False, "runtime": Decimal(60), "patience": Decimal(60)}),
        (("@devices",), {}),
    ],
)
async def test_what_is_no_report_is_refused(needs: tuple[str, ...], more: dict[str, Any]) -> None:
    fleet, _ = await booked("x")
    with pytest.raises(Refusal, match=r"bad_request.*broken devices are in lasting maintenance"):
        await do(fleet.client("one"), broken(fleet, *needs, **more), BookingView)
