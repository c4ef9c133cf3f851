"""The leading RCM dies, or hangs and wakes: nobody who runs is disturbed, nobody who waits loses the place."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from tests.live.bench import granted, running, until
from tests.live.crew import Crew, Stand
from tests.live.lab import PATIENT, Lab, LeaderWatch
from tests.live.unpublished import deaths
from tests.thorough import times
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.keyexpr import Role
from zscout.mesh import clock
from zscout.types import Grant

pytestmark = pytest.mark.live

ROBOTS = [f"robot/r{number}" for number in range(5)]
RUNNING, WAITING = 5, 10
APART = "candidate = false"


async def grant_of(client: Client, rc: str) -> None:
    """Asks for a free RC, and has it granted."""
    await granted(client, await client.request("next", {rc: {}}, min_runtime=600))


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

        lab.signal("a", signal.SIGKILL)
        await leaders.lost("a")
        await grant_of(client, "robot/free")
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
    found = await deaths(tmp_path, times(3))
    assert {one.trouble for one in found} == {""}
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


@pytest.mark.slow
async def test_a_frozen_leader_is_followed_and_steps_down_when_it_wakes(tmp_path: Path) -> None:
    timing = "[timing]\nhold_lease = 30\n"
    async with Lab(tmp_path, lease=4.0, candidates=("a", "b"), extra=timing) as lab:
        lab.node("c", *ROBOTS, "robot/free", "robot/short", extra=APART)
        lab.node("a")
        client = await lab.begun("asker")
        lab.node("b")
        leaders = LeaderWatch(client)
        crew = Crew()
        await crew.assemble(lab, ROBOTS, waiting=WAITING)
        await lab.candidates(client, "b")
        # Its time is over while the leader sleeps; at its waking the leader would give the RC away.
        short = await client.request("short", {"robot/short": {}}, min_runtime=10, keep=False)
        heir = await client.request("heir", {"robot/short": {}}, min_runtime=600)
        assert (short.state, heir.state) == ("running", "queued")
        before = await lab.state(client, lambda state: len(state.queue) == WAITING + 1)
        stood = Stand(before)
        assert before.host == "a"

        lab.signal("a", signal.SIGSTOP)
        await leaders.lost("a")
        await grant_of(client, "robot/free")
        while heir.state != "running":
            await client.changed(heir)
        state = await lab.state(client, lambda state: len(state.holds) == RUNNING + 2)
        stood.went_on(state, "next", "heir")
        del stood.holds["short"]
        after = await crew.checked(lab, client, stood, since=clock.now())
        assert after.host == "b"

        lab.signal("a", signal.SIGCONT)
        await lab.logged("a", "stepping down")
        await lab.living(client, Role.RCM, lambda hosts: hosts == ["b"])
        later = await crew.checked(lab, client, stood, since=clock.now())
        assert (later.host, later.term) == ("b", after.term)
        for rc in (*ROBOTS, "robot/free", "robot/short"):
            assert (await lab.rc(client, rc)).term == after.term
        (holder,) = (await lab.rc(client, "robot/short")).holders
        assert holder.grant == heir.grant

        with pytest.raises(CommandRefused) as refused:
            await client.command(ROBOTS[0], Grant(stood.term, 10_000), {"name": "echo", "value": 0})
        assert refused.value.code == "not_holder"
        await asyncio.gather(*(body.finish() for body in crew.bodies))
