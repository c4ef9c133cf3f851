"""The first whole: programs on several nodes get all that they asked for, or wait, and are preempted."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.live.lab import Lab
from zscout.behaviors.arc import Revoked, hold

pytestmark = pytest.mark.live


def test_a_gang_over_two_nodes_is_granted_commanded_and_preempted(tmp_path: Path) -> None:
    async def story() -> None:
        async with Lab(tmp_path) as lab:
            lab.node("a", "robot/a", "radio/a:rate=10")
            lab.node("b", "robot/b")
            client = await lab.client()
            await lab.ready(client, "robot/a", "radio/a", "robot/b")
            needs = {"robot/a": {}, "robot/b": {}, "radio/a": {"rate": 4}}
            operator: asyncio.Task[None] | None = None

            async def take() -> None:
                async with hold(client, "operator", {"robot/b": {}}, priority=10, min_runtime=0.2):
                    await asyncio.Event().wait()

            async def survey() -> None:
                nonlocal operator
                async with hold(client, "survey", needs, min_runtime=30) as held:
                    done = await held.command("robot/a", {"name": "echo", "value": [1, 2]})
                    assert done.result == [1, 2]
                    operator = asyncio.create_task(take())
                    await asyncio.Event().wait()

            with pytest.raises(Revoked) as revoked:
                await survey()
            assert revoked.value.outcome == "preempted"
            assert operator is not None
            await operator
            state = await lab.state(client, lambda state: not state.holds and not state.queue)
            assert state.host in ("a", "b")

    asyncio.run(story())
