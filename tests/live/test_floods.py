"""Floods that roles allow, on a secured fleet of real nodes: an honest client is served while they go on. That it waits
for a share of each host's alone: `tests/services/rcm/test_floods.py`; how long: `python -m studies doors`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from tests.hang import HANG
from tests.live.closed import ClosedLab
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.client import Client
from zscout.messages import (
    Ask,
    BookingsAsk,
    BookingsTold,
    Foresee,
    Foresight,
    HostRanking,
    Notice,
    RankAsk,
    RcmState,
    StateAsk,
)

pytestmark = pytest.mark.live

OUTSTANDING = 100
NEEDS: dict[str, dict[str, Decimal]] = {"robot/a": {}}


async def flood(client: Client, key: str, message: Any, kind: Any) -> None:
    """Keep so many questions outstanding until cancelled."""

    async def again() -> None:
        while True:
            await client.mesh.ask_one(key, message, kind, timeout=5)

    async with asyncio.TaskGroup() as group:
        for _ in range(OUTSTANDING):
            group.create_task(again())


async def crowd(client: Client) -> None:
    """Requests that wait for robot/a, but for the first."""
    for number in range(OUTSTANDING):
        ask = Ask(f"q{number}", f"q{number}", NEEDS, 0, Decimal(60))
        await client.mesh.ask_one(client.mesh.keys.schedule(client.mesh.me), ask, Notice, timeout=HANG)


def each(wall: Client, bob: Client, eve: Client) -> dict[str, Coroutine[Any, Any, None]]:
    """Floods by a viewer and two clients, the second with a crowd."""
    keys = wall.mesh.keys
    dry_run, again = Foresee("dry", "dry", NEEDS, 0, Decimal(60)), Ask("q1", "q1", NEEDS, 0, Decimal(60))
    return {
        "rcm/state": flood(wall, keys.ask_state(wall.mesh.me), StateAsk(arc="q1", forecast=True), RcmState),
        "rcm/bookings": flood(wall, keys.ask_bookings(wall.mesh.me), BookingsAsk(), BookingsTold),
        "balancer/rank": flood(wall, keys.ask_rank(wall.mesh.me), RankAsk(reports=True), HostRanking),
        "dry runs": flood(bob, keys.schedule(bob.mesh.me), dry_run, Foresight),
        "requests asked again": flood(eve, keys.schedule(eve.mesh.me), again, Notice),
    }


@asynccontextmanager
async def floods(lab: ClosedLab) -> AsyncIterator[None]:
    """Of questions, dry runs and asks, by three people, about robot/a."""
    wall, bob, eve = [await lab.person(name) for name in ("wall", "bob", "eve")]
    await lab.ready(eve, "robot/a")
    await crowd(eve)
    tasks = [asyncio.create_task(task) for task in each(wall, bob, eve).values()]
    try:
        yield
        assert not any(task.done() for task in tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.slow
async def test_an_honest_client_is_served_beside_floods(tmp_path: Path) -> None:
    async with ClosedLab(tmp_path) as lab:
        lab.node("anvil", "robot/a", "robot/b")
        ada = await lab.person("ada")
        before = await lab.ready(ada, "robot/a", "robot/b")
        async with floods(lab):
            for number in range(20):
                async with asyncio.timeout(HANG), hold(ada, f"honest{number}", {"robot/b": {}}, min_runtime=1):
                    pass
        assert (await lab.ready(ada, "robot/a", "robot/b")).term == before.term
