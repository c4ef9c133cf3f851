"""Rebalancing on a real mesh: where the fleet asks for it, what was placed badly spreads, and then rests."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.live.lab import START, Lab
from tests.live.placing import Placing
from zscout.messages import ListPlacements, Placement, Placements

pytestmark = pytest.mark.live

QUIET = 6.0
"""Seconds: three times what the fleet of this test needs for a move."""
NAMES = [f"part-{number}" for number in range(4)]


def test_what_is_on_one_host_spreads_and_then_stays(tmp_path: Path) -> None:
    asyncio.run(_spreads(tmp_path))


async def _spreads(tmp_path: Path) -> None:
    rules = "[placement]\nrebalance = true\ngain = 0.1\nsteady = 1\nrest = 2\n"
    async with Lab(tmp_path, candidates=["h1"], extra=rules) as lab:
        lab.node("h1", extra='load = "tree"')
        client = await lab.client()
        await lab.ready(client)
        placing = Placing(client)
        await placing.hosts(1)
        # More than one host carries, on any machine that has two processors or more.
        for name in NAMES:
            await placing.place(name, "spin", {"cpu": 1.0})
        lab.node("h2", extra='load = "tree"')
        await placing.hosts(2)
        hosts: list[str | None] = []
        async with asyncio.timeout(3 * START):
            while sorted(map(str, hosts)) != ["h1", "h1", "h2", "h2"]:
                before = await running(placing)
                hosts = [one.host for one in before]
                await asyncio.sleep(0.1)
        assert {one.host for one in before if "runs" in one.reason and one.moves} == {"h2"}
        # Several looks later nothing has gone back.
        await asyncio.sleep(QUIET)
        after = await running(placing)
        assert [(one.component, one.host, one.moves) for one in after] == [
            (one.component, one.host, one.moves) for one in before
        ]


async def running(placing: Placing) -> list[Placement]:
    listed = await placing.get(ListPlacements(), Placements)
    return [one for one in listed.components if one.state == "running"]
