"""Sharable RCs vote, live: capacities, rules that change, and a voter that does not answer."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest

from tests.live.bench import ECHO, SharedBench, Stand, answer, comes_to, ended, running
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc, RequestRefused
from zscout.messages import ProposedHolder

pytestmark = pytest.mark.live


class Picky(SharedBench):
    """Carries `most` holders, and keeps what it was asked."""

    most = 1

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[list[str]] = []

    def vote(self, holders: list[ProposedHolder]) -> str:
        self.asked.append(sorted(holder.arc for holder in holders))
        return f"it carries {self.most}" if len(holders) > self.most else ""


async def ask(client: Client, name: str, rate: str, *, priority: int = 0, runtime: float = 600) -> OpenArc:
    needs = {"radio/rf": {"rate": rate}}
    return await client.request(name, needs, priority=priority, min_runtime=runtime)


@pytest.mark.essential
async def test_a_capacity_is_filled_and_never_exceeded(lab: Lab) -> None:
    lab.node("a", "video/v:lines=1")
    lab.node("c", "radio/rf:rate=0.3", extra="candidate = false")
    client = await lab.begun()

    one, two = await ask(client, "one", "0.1"), await ask(client, "two", "0.2")
    # One tenth and two tenths are three tenths, and not a bit more.
    await comes_to(one, "running")
    await comes_to(two, "running")
    three = await ask(client, "three", "0.1")
    await comes_to(three, "queued", ": radio/rf refuses more: rate would be 0.4 of 0.3")
    with pytest.raises(RequestRefused, match=r"can never start: rate 0\.31 of 0\.3 at radio/rf; request less"):
        await ask(client, "too-much", "0.31", priority=9)
    # What asks for nothing that is scarce fits beside them.
    await comes_to(await ask(client, "idle", "0"), "running")
    await lab.held_by(client, "radio/rf", "idle", "one", "two")

    # An operator takes what is needed and no more: in rank order, whoever fits beside it stays.
    await comes_to(await ask(client, "operator", "0.2", priority=10), "running")
    await comes_to(two, "queued")
    assert one.state == "running"
    await lab.held_by(client, "radio/rf", "idle", "one", "operator")
    assert ended(two) == "preempted"

    await client.end(one)
    await comes_to(three, "running")
    assert two.state == "queued"
    await lab.held_by(client, "radio/rf", "idle", "operator", "three")

    # Where two vote, both must agree: nothing is held of the one that does.
    needs: dict[str, dict[str, Any]] = {"radio/rf": {"rate": "0.1"}, "video/v": {"lines": 1}}
    both = await client.request("both", needs, min_runtime=600)
    await comes_to(both, "queued", ": radio/rf refuses more")
    await lab.held_by(client, "video/v")
    await client.end(three)
    await comes_to(both, "running")
    more = await client.request("more", {"video/v": {"lines": 1}}, min_runtime=600)
    await comes_to(more, "queued", ": video/v refuses more: lines would be 2 of 1")
    await lab.held_by(client, "radio/rf", "both", "idle", "operator")
    await lab.held_by(client, "video/v", "both")


async def test_answers_stand_until_the_rules_change(lab: Lab, stand: Stand) -> None:
    lab.node("a", "robot/a")
    client = await lab.client()
    picky = Picky()
    rc = await stand.rc("video/v", picky)
    await lab.ready(client, "video/v", "robot/a")
    await running(client, "one", "video/v")
    two = await client.request("two", {"video/v": {}}, min_runtime=600)
    await comes_to(two, "queued", ": video/v refuses more: it carries 1")
    asked = list(picky.asked)
    assert asked[0] == ["one"]
    assert asked[-1] == ["one", "two"]
    # Passes run on, for others; what was answered is not asked again.
    for _ in range(3):
        arc, _ = await running(client, "other", "robot/a")
        await client.end(arc)
    assert picky.asked == asked
    picky.most = 2
    rc.rules_changed()
    await comes_to(two, "running")
    assert picky.asked[len(asked)] == ["one", "two"]


async def test_a_voter_that_does_not_answer_stops_nobody_else(tmp_path: Path) -> None:
    # With so long a lease nobody takes the frozen node for gone while this lasts.
    async with Lab(tmp_path, lease=30, extra="[timing]\nhold_lease = 60\nvote_timeout = 0.25\n") as lab:
        lab.node("a", "robot/a", "robot/b")
        lab.node("v", "radio/rf:rate=1", extra="candidate = false")
        client = await lab.begun()
        worker, grant = await running(client, "worker", "robot/a")
        lab.signal("v", signal.SIGSTOP)

        # It would take robot/a from the worker, if only the radio answered.
        needs = {"robot/a": {}, "radio/rf": {"rate": 1}}
        boss = await client.request("boss", needs, priority=5, min_runtime=600)
        await comes_to(boss, "queued", "radio/rf does not answer")
        for number in range(10):
            arc, _ = await running(client, f"other-{number}", "robot/b")
            await client.end(arc)
        assert worker.grant == grant
        assert await answer(client.command("robot/a", grant, ECHO)) == "done"
        await lab.state(client, lambda state: [one.reason for one in state.queue] == ["radio/rf does not answer"])
        # A lower rank may have what the boss would take: it waits for the radio, not for robot/a.
        await client.end(worker)
        late, late_grant = await running(client, "late", "robot/a", priority=1)

        lab.signal("v", signal.SIGCONT)
        await comes_to(boss, "running")
        await comes_to(late, "queued")
        assert ended(late) == "preempted"
        assert await answer(client.command("robot/a", late_grant, ECHO)) == "ended"
        await lab.held_by(client, "radio/rf", "boss")
