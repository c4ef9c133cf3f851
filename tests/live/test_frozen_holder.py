"""A client that hangs loses its hold with its lease. When it wakes, the RC does not obey its old grant, and the client
waits for a new one."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from tests.live.bench import ECHO, answer
from tests.live.lab import Lab
from zscout.types import SECOND

pytestmark = [pytest.mark.live, pytest.mark.slow]


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

        stopped = frozen.signal(signal.SIGSTOP)
        # This order waits in the pipe: it is the first thing that the client does when it goes on.
        await frozen.order("command", rc="robot/x", do=ECHO)
        told = await following.event("running")
        took = (told["at"] - stopped) / SECOND
        print(f"SIGSTOP of a holder at a lease of 4 s -> the next one granted: {took:.2f} s")
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
