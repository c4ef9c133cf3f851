"""Holders learn to whom they yield, by real commands on a real mesh: plain and secured, over a change of leader."""

from __future__ import annotations

import asyncio
import json
import re
import signal
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from tests.cli.tools import end, read_until
from tests.hang import HANG
from tests.live.closed import ClosedLab
from tests.live.lab import Lab, LeaderWatch, awaited
from tests.live.test_tokens import started
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.bookings import BookingsClient
from zscout.keyexpr import of_host
from zscout.messages import WINDOW

pytestmark = [pytest.mark.live, pytest.mark.slow]

CATCHES = "trap 'echo caught' USR1; echo begun; while :; do sleep 0.05; done"


def notices(path: Path) -> list[dict[str, Any]]:
    events = map(json.loads, path.read_text().splitlines()) if path.exists() else []
    return [event for event in events if event["event"] == "notice"]


async def noticed(path: Path, count: int) -> list[dict[str, Any]]:
    async def look() -> list[dict[str, Any]]:
        return await asyncio.to_thread(notices, path)

    return await awaited(look, lambda found: len(found) >= count)


async def test_a_command_learns_who_waits_by_signal_and_over_a_change_of_leader(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("c", "robot/x", extra="candidate = false")
        lab.node("a")
        client = await lab.begun()
        await lab.ready(client, "robot/x")
        lab.node("b")
        await lab.candidates(client, "a", "b")
        watch, events = LeaderWatch(client), tmp_path / "events"
        options = ("--name", "test", "--min-runtime", "10m", "--notify-signal", "USR1", "--json-file", str(events))
        running = started(lab, "request", "robot/x", *options, "--", "sh", "-c", CATCHES)
        try:
            await lab.held_by(client, "robot/x", "test")
            waiting = await client.request("next", {"robot/x": {}}, min_runtime=60)
            (first,) = await noticed(events, 1)
            assert (first["code"], first["withdrawn"], first["rcs"]) == ("waits", False, ["robot/x"])
            assert (first["by"]["arc"], 500 < first["safe"] <= 600) == ("next", True)
            lab.signal("a", signal.SIGKILL)
            await watch.lost("a")
            await lab.held_by(client, "robot/x", "test")
            await asyncio.sleep(3)  # nothing is told again meanwhile
            assert notices(events) == [first]
            await client.end(waiting)
            assert (await noticed(events, 2))[1]["withdrawn"]
            running.terminate()
            said, _ = await asyncio.to_thread(running.communicate, timeout=HANG)
        finally:
            end(running)
        assert re.search(r"test: .*next.* waits for robot/x: yours until \d\d:\d\d", said)
        assert "test: no request waits for robot/x any more" in said
        assert said.count("caught") == 1


async def test_a_drain_reaches_the_holder_and_a_command_under_a_token_as_it_begins(tmp_path: Path) -> None:
    async with Lab(tmp_path) as lab:
        lab.env["XDG_RUNTIME_DIR"] = str(tmp_path)
        lab.node("c", "robot/x")
        client = await lab.begun()
        await lab.ready(client, "robot/x")
        done = await lab.zscout("acquire", "robot/x", "--for", "1h", "--name", "job")
        token = done.stdout.strip()
        running = started(lab, "run", token, "--notify-signal", "USR1", "--", "sh", "-c", CATCHES)
        try:
            await asyncio.to_thread(read_until, running, "begun")
            await lab.zscout("drain", "c", "--timeout", "1ms", "--comment", "new disk")
            lines = await asyncio.to_thread(read_until, running, "caught")
            assert any("maintenance of robot/x" in line and "new disk" in line for line in lines)
            await lab.zscout("uncordon", "c")
            await asyncio.to_thread(read_until, running, "does not end the hold")
        finally:
            await lab.zscout("release", token)
            end(running)


async def test_in_a_secured_fleet_a_holder_learns_who_waits_and_of_maintenance(tmp_path: Path) -> None:
    async with ClosedLab(tmp_path) as lab:
        lab.node("anvil", "robot/a", "robot/b")
        bob, eve, ada = await lab.person("bob"), await lab.person("eve"), await lab.person("ada")
        await lab.ready(bob, "robot/a", "robot/b")
        needs: dict[str, dict[str, Any]] = {"robot/*": {}, "robot/*#2": {}}
        async with hold(bob, "test", needs, min_runtime=600) as held:
            waiting = await eve.request("next", {"robot/*": {}}, min_runtime=60)
            first = await held.noticed()
            assert first is not None
            assert (first.code, first.by.arc, first.by.client.partition("/")[0]) == ("waits", "next", "eve")
            now = datetime.now(UTC)
            booking = await BookingsClient(ada).book(
                {of_host("anvil"): {}}, now, WINDOW, name="drain", priority=10, maintenance=True, lasting=True
            )
            second = await held.noticed()
            assert second is not None
            assert (second.code, second.by.arc, second.rcs) == ("maintenance", "drain", ["robot/a", "robot/b"])
            await BookingsClient(ada).unbook(booking.id)
            await eve.end(waiting)
            ends = [await held.noticed(), await held.noticed()]
            assert {(end.code, end.withdrawn) for end in ends if end} == {("waits", True), ("maintenance", True)}
