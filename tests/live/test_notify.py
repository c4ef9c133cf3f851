"""Real nodes tell a real receiver what happens: the one that leads, once each."""

from __future__ import annotations

import asyncio
import re
import signal
from pathlib import Path

import pytest

from tests.live.bench import comes_to
from tests.live.lab import Lab
from tests.services.notify.receiver import Receiver
from zscout.behaviors.client.client import Client

pytestmark = [pytest.mark.live, pytest.mark.slow]


def node(lab: Lab, host: str, receiver: Receiver, *rcs: str) -> None:
    lab.node(host, *rcs, extra=f'[notify]\nurls = ["{receiver.url}"]\nafter = 0.001')


async def take_turns(client: Client, name: str) -> None:
    """One ARC is preempted by another, and has its device again after that."""
    first = await client.request(f"{name}-first", {"robot/a": {}}, min_runtime=60)
    await client.granted(first)
    second = await client.request(f"{name}-second", {"robot/a": {}}, priority=5, min_runtime=60)
    await client.granted(second)
    await comes_to(first, "queued")  # what it is told of its own may come after that
    await client.end(second)
    await client.granted(first)
    await client.end(first)


async def test_who_leads_tells_each_thing_once_and_the_next_leader_goes_on(tmp_path: Path) -> None:
    with Receiver() as receiver:
        async with Lab(tmp_path, candidates=("a", "b")) as lab:
            node(lab, "a", receiver)
            client = await lab.client("worker")
            await lab.state(client, lambda state: state.host == "a")
            node(lab, "b", receiver, "robot/a")
            await lab.ready(client, "robot/a")
            await lab.candidates(client, "a", "b")
            await take_turns(client, "one")
            await asyncio.to_thread(receiver.until, lambda: len(receiver.heard) == 2)
            lab.signal("a", signal.SIGKILL)
            await lab.state(client, lambda state: state.host == "b")
            await lab.ready(client, "robot/a")
            await take_turns(client, "two")
            await asyncio.to_thread(receiver.until, lambda: len(receiver.heard) == 4)
            logs = lab.log("a") + lab.log("b")
        fleet = lab.fleet.name
        assert receiver.titles == [
            f"zscout {fleet}: one-first was preempted",
            f"zscout {fleet}: one-first is yours now",
            f"zscout {fleet}: two-first was preempted",
            f"zscout {fleet}: two-first is yours now",
        ]
        assert re.fullmatch(
            r"\S+ \(.*\) held robot/a for [\d.]+ s: preempted by \S+ \(.*\), priority 5; it waits again",
            receiver.heard[0]["message"],
        )
        assert Receiver.SECRET not in logs
