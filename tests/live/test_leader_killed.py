"""The leading RCM dies: nobody who runs is disturbed, nobody who waits loses the place."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from tests.live.bench import running, until
from tests.live.crew import Crew, Stand
from tests.live.lab import PATIENT, Lab, LeaderWatch
from tests.live.unpublished import deaths
from zscout.behaviors.client.client import Client
from zscout.mesh import clock
from zscout.types import SECOND, Ns

pytestmark = pytest.mark.live

ROBOTS = [f"robot/r{number}" for number in range(5)]
RUNNING, WAITING = 5, 10
APART = "candidate = false"


async def grant_of(client: Client, rc: str) -> Ns:
    """Asks for a free RC; returns when it was granted, as the asker saw it."""
    arc = await client.request("next", {rc: {}}, min_runtime=600)
    while arc.state != "running":
        await client.changed(arc)
    granted = clock.now()
    await client.granted(arc)
    return granted


@pytest.mark.essential
async def test_a_successor_carries_everything_on(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("c", *ROBOTS, "robot/free", extra=APART)
        lab.node("a")
        client = await lab.begun("asker")
        lab.node("b")
        leaders = LeaderWatch(client)
        crew = Crew()
        await crew.assemble(lab, ROBOTS, waiting=WAITING)
        before = await lab.state(client, lambda state: len(state.queue) == WAITING)
        stood = Stand(before)
        assert before.host == "a"
        assert len(stood.holds) == RUNNING
        await lab.candidates(client, "b")

        killed = lab.signal("a", signal.SIGKILL)
        ended = await leaders.lost("a")
        granted = await grant_of(client, "robot/free")
        print(
            f"kill -9 of the leader -> its token ends: {(ended - killed) / SECOND * 1000:.0f} ms; "
            f"token's end -> next grant: {(granted - ended) / SECOND * 1000:.0f} ms"
        )
        stood.went_on(await lab.state(client, lambda state: len(state.holds) > RUNNING), "next")
        after = await crew.checked(lab, client, stood, since=clock.now())
        assert after.host == "b"

        # The queue is not only remembered but works: the first in it follows a body that ends.
        heirs = [view.arc for view in after.queue if set(view.needs) == {ROBOTS[1]}]
        await crew.bodies[1].finish()
        state = await lab.state(client, lambda state: len(state.queue) == WAITING - 1)
        assert [hold.arc for hold in state.holds if hold.arc in dict(stood.queue)] == heirs[:1]
        await asyncio.gather(*(body.finish() for body in crew.bodies if body is not crew.bodies[1]))


@pytest.mark.slow
async def test_a_leader_killed_between_answer_and_publication_has_granted_nothing(tmp_path: Path) -> None:
    found = await deaths(tmp_path, 3, lambda _: None)
    assert [one.trouble for one in found] == [""] * 3
    assert any(one.answered for one in found)


@pytest.mark.slow
async def test_the_only_rcm_killed_and_started_again_finds_everything(tmp_path: Path) -> None:
    # A process takes its time to start on a busy machine; holds must last that long.
    async with Lab(tmp_path, lease=PATIENT, extra="[timing]\nhold_lease = 60\n") as lab:
        lab.node("c", *ROBOTS, extra=APART)
        lab.node("a")
        client = await lab.begun("asker")
        leaders = LeaderWatch(client)
        crew = Crew()
        await crew.assemble(lab, ROBOTS, waiting=WAITING)
        before = await lab.state(client, lambda state: len(state.queue) == WAITING)
        lab.signal("a", signal.SIGKILL)
        await leaders.lost("a")
        alone = clock.now()
        for body in crew.bodies:
            await body.beats_on(alone)
        lab.nodes["a"].wait()
        lab.node("a")
        after = await crew.checked(lab, client, Stand(before), since=clock.now())
        assert after.term.counter > before.term.counter
        await asyncio.gather(*(body.finish() for body in crew.bodies))


async def test_what_is_given_up_while_nobody_leads_is_free_under_the_next_rcm(tmp_path: Path) -> None:
    async with Lab(tmp_path, lease=PATIENT, extra="[timing]\nhold_lease = 60\n") as lab:
        lab.node("c", "robot/x", "robot/y", extra=APART)
        lab.node("a")
        client = await lab.begun("asker")
        _, stays = await running(client, "stays", "robot/y", min_runtime=0.1, keep=True)
        arc, _ = await running(client, "kept", "robot/x", min_runtime=0.1, keep=True)
        lab.signal("a", signal.SIGKILL)
        await until(lambda: client.leader is None)
        await client.end(arc)
        await lab.held_by(client, "robot/x", "kept")
        lab.nodes["a"].wait()
        lab.node("a")
        await lab.ready(client, "robot/x", "robot/y")
        await lab.state(client, lambda state: [(hold.arc, hold.grant) for hold in state.holds] == [("stays", stays)])
        await lab.held_by(client, "robot/x")
        await lab.held_by(client, "robot/y", "stays")
