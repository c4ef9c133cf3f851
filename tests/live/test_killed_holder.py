"""A client that dies frees what it held at once, and one that hangs with its lease: the next in the queue has it."""

from __future__ import annotations

import asyncio
import signal
from itertools import pairwise
from pathlib import Path

import pytest

from tests.live.bench import ECHO, answer
from tests.live.lab import PATIENT, HolderProcess, Lab
from tests.thorough import times
from zscout.types import SECOND

pytestmark = pytest.mark.live


@pytest.mark.parametrize(
    ("batches", "rounds"),
    [
        pytest.param(1, 3, marks=pytest.mark.essential, id="few"),
        pytest.param(times(3), 10, marks=pytest.mark.slow, id="many"),
    ],
)
async def test_the_next_in_the_queue_follows_a_holder_killed_with_9(lab: Lab, batches: int, rounds: int) -> None:
    """All processes of a batch wait in the queue before the first one dies."""
    lab.node("a")
    lab.node("b", "robot/x", extra="candidate = false")
    await lab.begun()
    took: list[float] = []
    first = await _queued(lab, "first")
    await first.event("entered")
    for batch in range(batches):
        names = [f"h{batch}-{number}" for number in range(rounds)]
        queue = [first, *await asyncio.gather(*(lab.holder(name) for name in names))]
        for holder in queue[1:]:
            await _ask(holder)
            await holder.event("queued")
        for holder, following in pairwise(queue):
            killed = holder.kill()
            told = await following.event("running")
            took.append((told["at"] - killed) / SECOND)
            await following.event("entered")
        first = queue[-1]
    assert len(took) == batches * rounds
    assert min(took) > 0
    # A leader that stood still itself leaves who is gone a lease to come back.
    late = sum(seconds >= PATIENT for seconds in took)
    assert late <= lab.log("a").count("process stalled"), "it was noticed by the lease, not by the death"


async def _queued(lab: Lab, name: str) -> HolderProcess:
    holder = await lab.holder(name)
    await _ask(holder)
    return holder


async def _ask(holder: HolderProcess) -> None:
    await holder.order("ask", arc=holder.name, needs={"robot/x": {}}, min_runtime=600)


@pytest.mark.slow
async def test_a_holder_stopped_is_followed_and_refused_when_it_goes_on(tmp_path: Path) -> None:
    async with Lab(tmp_path, lease=4.0) as lab:
        lab.node("a")
        lab.node("b", "robot/x", extra="candidate = false")
        client = await lab.begun()
        frozen, following = await asyncio.gather(lab.holder("frozen"), lab.holder("following"))
        await frozen.order("ask", arc="frozen", needs={"robot/x": {}}, min_runtime=600)
        grant = (await frozen.event("entered"))["grant"]
        await following.order("ask", arc="following", needs={"robot/x": {}}, min_runtime=600)
        await following.event("queued")
        await frozen.order("command", rc="robot/x", do=ECHO)
        assert (await frozen.event("command"))["code"] == "done"

        frozen.signal(signal.SIGSTOP)
        # This order waits in the pipe: it is the first thing that the client does when it goes on.
        await frozen.order("command", rc="robot/x", do=ECHO)
        await following.event("running")
        await following.event("entered")

        frozen.signal(signal.SIGCONT)
        # "unknown": no RC has answered it, as it has no link yet. The RC's own word comes by another way, then.
        assert (await frozen.event("command"))["code"] in ("ended", "unknown")
        assert await answer(client.command("robot/x", grant, ECHO)) == "ended"
        await following.order("command", rc="robot/x", do=ECHO)
        assert (await following.event("command"))["code"] == "done"
        state = await lab.rc(client, "robot/x")
        assert [holder.arc for holder in state.holders] == ["following"]
        await following.order("end")
        assert (await frozen.event("entered"))["grant"] > grant
        assert await answer(client.command("robot/x", grant, ECHO)) == "ended"
