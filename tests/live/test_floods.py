"""Floods that roles allow, on a secured fleet of real nodes: an honest client is served while they go on. That it waits
for a share of each host's alone: `tests/services/rcm/test_floods.py`; how long: `python -m studies doors`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
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


async def flood(client: Client, key: str, message: Any, kind: Any) -> None:
    """Keep so many questions outstanding until cancelled."""

    async def again() -> None:
        while True:
            await client.mesh.ask_one(key, message, kind, timeout=5)

    async with asyncio.TaskGroup() as group:
        for _ in range(OUTSTANDING):
            group.create_task(again())


@asynccontextmanager
async def floods(lab: ClosedLab) -> AsyncIterator[None]:
    """Of questions, dry runs and asks, by three people, about robot/a."""
    wall, bob, eve = [await lab.person(name) for name in ("wall", "bob", "eve")]
    await lab.ready(eve, "robot/a")
    keys, needs = wall.mesh.keys, {"robot/a": dict[str, Decimal]()}
    for number in range(OUTSTANDING):
        ask = Ask(f"q{number}", f"q{number}", needs, 0, Decimal(60))
        await eve.mesh.ask_one(keys.schedule(eve.mesh.me), ask, Notice, timeout=HANG)
    dry_run = Foresee("dry", "dry", needs, 0, Decimal(60))
    tasks = [
        asyncio.create_task(task)
        for task in (
            flood(wall, keys.ask_state(wall.mesh.me), StateAsk(arc="q1", forecast=True), RcmState),
            flood(wall, keys.ask_bookings(wall.mesh.me), BookingsAsk(), BookingsTold),
            flood(wall, keys.ask_rank(wall.mesh.me), RankAsk(reports=True), HostRanking),
            flood(bob, keys.schedule(bob.mesh.me), dry_run, Foresight),
            flood(eve, keys.schedule(eve.mesh.me), Ask("q1", "q1", needs, 0, Decimal(60)), Notice),
        )
    ]
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
