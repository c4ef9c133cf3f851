"""What a demo waits for before it begins."""

from __future__ import annotations

import asyncio
from pathlib import Path

from tests.mesh.kit import run
from zscout.keyexpr import Role, Sender, Token
from zscout.simulation.demo.runner import RECORDS, DemoRunner
from zscout.testing.memory import MemoryNetwork


class Demo(DemoRunner):
    async def play(self) -> None: ...

    async def close(self) -> None: ...


def test_it_begins_when_the_recorder_has_read_the_state_not_when_its_process_is_there(tmp_path: Path) -> None:
    async def story() -> None:
        network = MemoryNetwork()
        leader, recorder = (network.open("lab", Sender(*me)) for me in (("anvil", "node"), (RECORDS, "recorder")))
        recorder.watch_links()
        tokens = [leader.alive(Token("anvil", Role.RCM, "node", "i1"))]
        here = network.open("lab", Sender("demo", "watch"))
        there = asyncio.create_task(Demo(tmp_path, lambda *_: None).all_there(here))
        await asyncio.sleep(5)
        assert not there.done()
        tokens.append(recorder.alive(Token(RECORDS, Role.RECORDER, "recorder", "i1")))
        async with asyncio.timeout(5):
            await there

    run(story())
