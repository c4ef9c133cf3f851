"""A command without --min-runtime keeps its devices from equals for long: over a change of leader, before a booking."""

from __future__ import annotations

import asyncio
import re
import signal
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from tests.cli.tools import end
from tests.hang import HANG
from tests.live.lab import Lab, LeaderWatch
from tests.live.test_tokens import started
from tests.mesh.kit import until
from zscout.behaviors.client.bookings import BookingsClient
from zscout.messages import RcmState

pytestmark = [pytest.mark.live, pytest.mark.slow]


def is_held_for_an_hour(state: RcmState) -> bool:
    return any(hold.arc == "job" and hold.runtime == 3600 and hold.remaining > 3400 for hold in state.holds)


async def test_an_equal_waits_for_a_command_under_the_next_leader_too_and_a_higher_priority_does_not(
    tmp_path: Path,
) -> None:
    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("c", "robot/x", "robot/y", extra="candidate = false")
        lab.node("a")
        client = await lab.begun()
        await lab.ready(client, "robot/x", "robot/y")
        lab.node("b")
        await lab.candidates(client, "a", "b")
        watch = LeaderWatch(client)
        begun = tmp_path / "begun"
        script = f"touch {begun}; exec sleep 3000"
        running = started(lab, "request", "robot/*", "robot/*#2", "--name", "job", "--", "sh", "-c", script)
        try:
            await lab.state(client, is_held_for_an_hour)
            # A program that has not confirmed its grant yet waits again instead of ending.
            await until(begun.exists, within=HANG)
            equal = await client.request("next", {"robot/*": {}}, min_runtime=60)
            lab.signal("a", signal.SIGKILL)
            await watch.lost("a")
            await lab.state(client, lambda state: state.host == "b" and is_held_for_an_hour(state))
            assert equal.state == "queued"
            higher = await client.request("high", {"robot/x": {}}, min_runtime=60, priority=1)
            assert await client.granted(higher) is not None
            said, _ = await asyncio.to_thread(running.communicate, timeout=HANG)
        finally:
            end(running)
        assert re.search(r"job holds robot/. for robot/.*, robot/. for robot/.*: yours for 1 h \(until ", said)
        assert running.returncode == 75


async def test_it_is_cut_to_the_next_booking_and_says_so(tmp_path: Path) -> None:
    async with Lab(tmp_path) as lab:
        lab.node("c", "robot/x")
        client = await lab.begun()
        await lab.ready(client, "robot/x")
        begins = datetime.now(UTC) + timedelta(minutes=10)
        await BookingsClient(client).book({"robot/x": {}}, begins, 300, name="demo")
        done = await lab.zscout("request", "robot/x", "--name", "job", "--", "true")
        assert done.returncode == 0, done.stderr
        assert (
            ", when it is booked or reserved), then until a request of priority 0 or more waits for it" in done.stderr
        )
