"""A client that hangs loses its hold with its lease, and the RC obeys it no more when it wakes."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.lab import Lab
from zscout.types import SECOND

pytestmark = pytest.mark.live

ECHO = {"name": "echo", "value": 1}


def test_a_holder_stopped_is_followed_and_refused_when_it_goes_on(tmp_path: Path) -> None:
    async def story() -> None:
        async with Lab(tmp_path, lease=1.0) as lab:
            lab.node("a")
            lab.node("b", "robot/x", extra="candidate = false")
            client = await lab.client()
            await lab.ready(client, "robot/x")
            frozen, following = await asyncio.gather(lab.holder("frozen"), lab.holder("following"))
            for holder in (frozen, following):
                await holder.order("ask", arc=holder.name, needs={"robot/x": {}}, min_runtime=600)
                await holder.event("entered" if holder is frozen else "queued")
            await frozen.order("command", rc="robot/x", do=ECHO)
            assert (await frozen.event("command"))["code"] == "done"

            stopped = frozen.signal(signal.SIGSTOP)
            # This order waits in the pipe: it is the first thing that the client does when it goes on.
            await frozen.order("command", rc="robot/x", do=ECHO)
            told = await following.event("running")
            took = (told["at"] - stopped) / SECOND
            print(f"SIGSTOP of a holder at a lease of 1 s -> the next one granted: {took:.2f} s")
            await following.event("entered")

            frozen.signal(signal.SIGCONT)
            codes = [(await frozen.event("command"))["code"]]
            async with asyncio.timeout(HANG):
                # "unknown" is what it is told while it has no link: no RC has answered it then.
                while codes[-1] == "unknown":
                    await frozen.order("command", rc="robot/x", do=ECHO)
                    codes.append((await frozen.event("command"))["code"])
            assert codes[-1] == "ended", codes
            assert set(codes[:-1]) <= {"unknown"}, codes
            await following.order("command", rc="robot/x", do=ECHO)
            assert (await following.event("command"))["code"] == "done"
            state = await lab.rc(client, "robot/x")
            assert [holder.arc for holder in state.holders] == ["following"]

    asyncio.run(story())


def test_a_holder_that_wakes_learns_that_its_hold_is_over(tmp_path: Path) -> None:
    async def story() -> None:
        async with Lab(tmp_path, lease=0.5) as lab:
            lab.node("a", "robot/x")
            client = await lab.client()
            await lab.ready(client, "robot/x")
            frozen = await lab.holder("frozen")
            await frozen.order("ask", arc="frozen", needs={"robot/x": {}}, min_runtime=600)
            await frozen.event("entered")
            frozen.signal(signal.SIGSTOP)
            await lab.state(client, lambda state: not state.holds)
            frozen.signal(signal.SIGCONT)
            told = await frozen.event("ended")
            assert told["outcome"] == "client_lost"

    asyncio.run(story())
