"""Whoever dies around a hand-over: all is at one of both clients, once, and the other knows."""

from __future__ import annotations

import asyncio
import signal
import sys
from pathlib import Path

import msgspec
import pytest

from tests.hang import HANG
from tests.live.bench import ECHO, answer
from tests.live.handing_over import NEEDS, claimed, holding, me, settle_down
from tests.live.lab import Lab
from zscout.keyexpr import Sender
from zscout.types import Grant

pytestmark = pytest.mark.live

ENCODER = msgspec.json.Encoder(decimal_format="number")


@pytest.mark.slow
async def test_the_leader_dies_around_a_hand_over(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("a", "b", "c")) as lab:
        lab.node("rcs", "robot/x", "radio/f:rate=5", extra="candidate = false")
        lab.node("a")
        old, new = await lab.client("old"), await lab.client("new")
        await lab.ready(old, "robot/x", "radio/f")
        for host in ("b", "c"):
            lab.node(host)
        await lab.candidates(old, "b", "c")
        before = await claimed(old, list(NEEDS))

        place = before["later"].place

        # Right after it: the next leader has it from the new client and the RCs.
        after = await settle_down(old, new, list(NEEDS))
        lab.signal("a", signal.SIGKILL)
        state = await lab.state(
            new, lambda state: state.host == "b" and len(state.holds) == 2 and len(state.queue) == 1
        )
        stood = {name: ("test/new", after[name].grant) for name in ("drive", "talk")}
        assert holding(state) == stood
        assert [(view.client, view.place) for view in state.queue] == [("test/new", place)]
        grant = after["drive"].grant
        assert grant is not None
        assert await answer(new.command("robot/x", grant, ECHO)) == "done"

        # Right before it, and again in the middle: it ends at one of both.
        old.resume()
        await lab.candidates(old, "c")
        lab.signal("b", signal.SIGKILL)
        back = await settle_down(new, old, list(NEEDS))
        state = await lab.state(
            old, lambda state: state.host == "c" and len(state.holds) == 2 and len(state.queue) == 1
        )
        assert {client for client, _ in holding(state).values()} == {"test/old"}
        assert [(view.client, view.place) for view in state.queue] == [("test/old", place)]
        assert [arc.place for arc in back.values()] == [arc.place for arc in before.values()]


@pytest.mark.parametrize("delay", [0.003, *(pytest.param(delay, marks=pytest.mark.slow) for delay in (0.0, 0.001))])
async def test_the_leader_dies_in_a_hand_over(tmp_path: Path, delay: float) -> None:
    """Whenever that is: all is at one of both, once, and the other knows."""
    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("rcs", "robot/x", "radio/f:rate=5", extra="candidate = false")
        lab.node("a")
        old, new = await lab.client("old"), await lab.client("new")
        await lab.ready(old, "robot/x", "radio/f")
        lab.node("b")
        await lab.candidates(old, "b")
        before = await claimed(old, list(NEEDS))
        old.pause()
        new.expect(old.open_requests())
        moving_ = asyncio.create_task(old.hand_over_all(me(new)))
        await asyncio.sleep(delay)
        lab.signal("a", signal.SIGKILL)
        await moving_
        after = await claimed(new, list(NEEDS))
        assert [arc.id for arc in after.values()] == [arc.id for arc in before.values()]
        await asyncio.wait_for(new.granted(after["drive"]), HANG)
        await asyncio.wait_for(new.granted(after["talk"]), HANG)
        state = await lab.state(
            new, lambda state: state.host == "b" and len(state.holds) == 2 and len(state.queue) == 1
        )
        clients = [*(view.client for view in state.holds), *(view.client for view in state.queue)]
        assert clients == ["test/new"] * 3
        assert [view.place for view in state.queue] == [before["later"].place]


async def test_the_old_process_dies_right_after_it(lab: Lab) -> None:
    lab.node("a", "robot/x", "radio/f:rate=5")
    old = await lab.begun("old")
    await claimed(old, list(NEEDS))
    grants = holding(await lab.state(old, lambda state: len(state.holds) == 2))
    heir = await asyncio.create_subprocess_exec(
        sys.executable,
        *("-m", "tests.live.heir", "new"),
        env=lab.env,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert heir.stdin is not None
        assert heir.stdout is not None
        old.pause()
        heir.stdin.write(ENCODER.encode(old.open_requests()) + b"\n")
        assert await asyncio.wait_for(heir.stdout.readline(), HANG) == b"ready\n"
        await old.hand_over_all(Sender("test", "new"))
        await old.leave()
        line = await asyncio.wait_for(heir.stdout.readline(), HANG)
        told = msgspec.json.decode(line, type=dict[str, Grant])
        watcher = await lab.client("watcher")
        await lab.living(watcher, "client", lambda hosts: len(hosts) == 2)
        state = await lab.state(watcher, lambda state: len(state.holds) == 2)
        assert {client for client, _ in holding(state).values()} == {"test/new"}
        for name, (_, grant) in holding(state).items():
            assert grant > grants[name][1]
            assert grant == told[name]
        assert [view.arc for view in state.queue] == ["later"]
    finally:
        heir.kill()
        await heir.wait()
