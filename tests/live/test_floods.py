"""Floods that roles allow, on a secured fleet of real nodes: an honest client beside them is served at once."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Coroutine
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from tests.live.closed import ClosedLab
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.client import Client
from zscout.messages import (
    Ask,
    BookingsAsk,
    BookingsTold,
    Foresee,
    Foresight,
    Grants,
    HostRanking,
    Notice,
    RankAsk,
    RcmState,
    StateAsk,
)

pytestmark = pytest.mark.live

OUTSTANDING = 100
WITHIN = 0.5
"""Seconds."""


async def flood(client: Client, key: str, message: Any, kind: Any) -> None:
    """Keep so many questions outstanding until cancelled."""

    async def again() -> None:
        while True:
            await client.mesh.ask_one(key, message, kind, timeout=5)

    async with asyncio.TaskGroup() as group:
        for _ in range(OUTSTANDING):
            group.create_task(again())


@pytest.mark.slow
async def test_an_honest_client_beside_floods_is_served_at_once(tmp_path: Path) -> None:
    async with ClosedLab(tmp_path) as lab:
        lab.node("anvil", "robot/a", "robot/b")
        wall, bob, eve, ada = [await lab.person(name) for name in ("wall", "bob", "eve", "ada")]
        await lab.ready(ada, "robot/a", "robot/b")
        keys, needs = wall.mesh.keys, {"robot/a": dict[str, Decimal]()}
        for number in range(100):
            ask = Ask(f"q{number}", f"q{number}", needs, 0, Decimal(60))
            await eve.mesh.ask_one(keys.schedule(eve.mesh.me), ask, Notice, timeout=5)
        dry_run = Foresee("dry", "dry", needs, 0, Decimal(60))
        floods: list[Coroutine[Any, Any, None]] = [
            flood(wall, keys.ask_state(wall.mesh.me), StateAsk(arc="q1", forecast=True), RcmState),
            flood(wall, keys.ask_bookings(wall.mesh.me), BookingsAsk(), BookingsTold),
            flood(wall, keys.ask_rank(wall.mesh.me), RankAsk(reports=True), HostRanking),
            flood(bob, keys.schedule(bob.mesh.me), dry_run, Foresight),
            flood(eve, keys.schedule(eve.mesh.me), Ask("q1", "q1", needs, 0, Decimal(60)), Notice),
        ]
        heard = [time.monotonic()]
        ada.mesh.subscribe(keys.grants, Grants, lambda *_: heard.append(time.monotonic()))
        tasks = [asyncio.create_task(task) for task in floods]
        try:
            waits = []
            for number in range(20):
                began = time.monotonic()
                async with hold(ada, f"honest{number}", {"robot/b": {}}, min_runtime=1):
                    waits.append(time.monotonic() - began)
                await asyncio.sleep(0.05)
            assert max(waits) < WITHIN, waits
            assert not any(task.done() for task in tasks)
            gaps = [after - before for before, after in itertools.pairwise(heard)]
            assert max(gaps) < 0.5 + WITHIN, gaps
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
