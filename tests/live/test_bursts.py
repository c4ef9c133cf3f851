"""Operations that arrive together are decided together, and each still gets its own answer, in its order."""

from __future__ import annotations

import asyncio

import pytest

from tests.hang import HANG
from tests.live.lab import Lab
from zscout.messages import Cancel, Grants, Notice

pytestmark = pytest.mark.live


async def test_what_is_asked_and_given_up_in_one_burst_is_gone(lab: Lab) -> None:
    lab.node("a", "robot/a")
    client = await lab.begun()
    holder = await client.request("holder", {"robot/a": {}}, min_runtime=60)
    assert holder.state == "running"
    key = client.mesh.keys.schedule(client.mesh.me)
    asked = [asyncio.create_task(client.request(f"w{n}", {"robot/a": {}}, min_runtime=1)) for n in range(40)]
    arcs = [await task for task in asked]
    assert {arc.state for arc in arcs} == {"queued"}
    # Each waiting request, asked again and cancelled without waiting for the answer in between.
    pairs = [operation for arc in arcs for operation in (arc.ask(0), Cancel(id=arc.id))]
    answers = await asyncio.gather(*(client.mesh.ask_one(key, operation, Notice, timeout=HANG) for operation in pairs))
    assert all(answer is not None and answer.message is not None for answer in answers)
    last = [answer.message.state for answer in answers[1::2] if answer and answer.message]
    assert last == ["ended"] * 40
    state = await lab.state(client, lambda state: not state.queue)
    assert [hold.arc for hold in state.holds] == ["holder"]


async def test_those_who_subscribe_alike_hear_alike_until_each_leaves(lab: Lab) -> None:
    lab.node("a", "robot/a")
    client = await lab.begun()
    first: asyncio.Queue[int] = asyncio.Queue()
    second: asyncio.Queue[int] = asyncio.Queue()
    grants = client.mesh.keys.grants
    one = client.mesh.subscribe(grants, Grants, lambda _, said: first.put_nowait(said.seq))
    two = client.mesh.subscribe(grants, Grants, lambda _, said: second.put_nowait(said.seq))
    await client.request("x", {"robot/a": {}}, min_runtime=60)
    async with asyncio.timeout(HANG):
        heard = await first.get()
        while await second.get() != heard:
            pass
    one.close()
    while not first.empty():
        first.get_nowait()
    async with asyncio.timeout(HANG):
        await second.get()
        await second.get()
    assert first.empty()
    two.close()
