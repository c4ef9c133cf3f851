"""Rebalancing on a real mesh: where the fleet asks for it, what was placed badly spreads, and then rests."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.lab import Lab
from tests.live.placing import Placing
from zscout.messages import ListPlacements, Placement, Placements

pytestmark = [pytest.mark.live, pytest.mark.slow]

QUIET = 4.0
"""Seconds: more than the fleet of this test needs for a move."""
NAMES = [f"part-{number}" for number in range(4)]


async def test_what_is_on_one_host_spreads_and_then_stays(tmp_path: Path) -> None:
    rules = f"[placement]\nstart_timeout = {HANG}\nrebalance = true\ngain = 0.1\nsteady = 1\nrest = 2\n"
    async with Lab(tmp_path, candidates=["h1"], extra=rules) as lab:
        lab.node("h1", extra='load = "tree"')
        client = await lab.begun()
        placing = Placing(client)
        await placing.hosts(1)
        # More than this machine carries, if it has two processors.
        for name in NAMES:
            await placing.place(name, "spin", {"cpu": 0.7})
        lab.node("h2", extra='load = "tree"')
        await placing.hosts(2)
        hosts: set[str | None] = set()
        async with asyncio.timeout(3 * HANG):
            while hosts != {"h1", "h2"}:
                hosts = {one.host for one in await running(placing)}
                await asyncio.sleep(0.1)
        await asyncio.sleep(QUIET)
        after = await running(placing)
        assert {one.host for one in after} == {"h1", "h2"}
        assert {one.host for one in after if one.moves} == {"h2"}
        # Whatever went, has not come back.
        assert all(one.moves <= 1 for one in after)
        assert any("runs" in one.reason and one.moves for one in after)


async def running(placing: Placing) -> list[Placement]:
    listed = await placing.get(ListPlacements(), Placements)
    return [one for one in listed.components if one.state == "running"]
