"""The first whole: programs on several nodes get all that they asked for, or wait, and are preempted."""

from __future__ import annotations

import asyncio
import re
from decimal import Decimal

import pytest

from tests.live.lab import TTL, Lab
from zscout.behaviors.client.arc import Revoked, hold

pytestmark = pytest.mark.live


@pytest.mark.essential
async def test_a_gang_over_two_nodes_is_granted_commanded_and_preempted(lab: Lab) -> None:
    lab.node("a", "robot/a", "radio/a:rate=10")
    lab.node("b", "robot/b")
    client = await lab.begun()
    needs = {"robot/a": {}, "robot/b": {}, "radio/a": {"rate": 4}}
    operator: asyncio.Task[None] | None = None

    async def take() -> None:
        async with hold(client, "operator", {"robot/b": {}}, priority=10, min_runtime=0.2, keep=False):
            await asyncio.Event().wait()

    async def survey() -> None:
        nonlocal operator
        async with hold(client, "survey", needs, min_runtime=30) as held:
            done = await held.command("robot/a", {"name": "echo", "value": [1, 2]}, ttl=TTL)
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


async def test_what_would_come_is_foretold_and_nothing_is_changed_by_asking(lab: Lab) -> None:
    lab.node("a", "robot/a")
    client = await lab.begun()
    running = await client.request("mine", {"robot/a": {}}, min_runtime=60)
    waiting = await client.request("next", {"robot/a": {}}, min_runtime=5)
    state = await client.state(forecast=True)
    assert state is not None
    [view] = state.queue
    assert view.starts_in is not None
    assert 50 < view.starts_in <= 60
    take = await client.foresee("take", {"robot/a": {}}, priority=10, min_runtime=Decimal(1))
    assert take is not None
    assert (take.starts_in, take.preempts) == (0.0, ["mine"])
    wait = await client.foresee("wait", {"robot/a": {}}, priority=0, min_runtime=Decimal(9))
    assert wait is not None
    assert wait.starts_in is not None
    assert wait.starts_in > view.starts_in + 4
    assert re.fullmatch(r"waits for \S+ \(\S+@\S+\): robot/a", wait.reason)
    never = await client.foresee("never", {"robot/b": {}}, min_runtime=Decimal(1), wait_for_device=True)
    assert never is not None
    assert (never.starts_in, never.reason) == (None, "robot/b not on the mesh")
    after = await client.state()
    assert after is not None
    assert [view.arc for view in after.holds] == ["mine"]
    assert [view.arc for view in after.queue] == ["next"]
    assert (running.state, waiting.state) == ("running", "queued")
