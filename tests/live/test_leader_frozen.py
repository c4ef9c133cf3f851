"""The leading RCM hangs and wakes under a successor: it steps down, and no RC obeys its term any more."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from tests.live.crew import Crew, Stand
from tests.live.lab import Lab, LeaderWatch
from tests.live.test_leader_killed import APART, RUNNING, WAITING, grant_of
from zscout.behaviors.client.client import CommandRefused
from zscout.keyexpr import Role
from zscout.mesh import clock
from zscout.messages import Grants
from zscout.types import SECOND, Grant

pytestmark = [pytest.mark.live, pytest.mark.slow]

ROBOTS = [f"robot/r{number}" for number in range(RUNNING)]


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

        stopped = lab.signal("a", signal.SIGSTOP)
        ended = await leaders.lost("a")
        granted = await grant_of(client, "robot/free")
        print(
            f"SIGSTOP of the leader -> its token ends: {(ended - stopped) / SECOND:.2f} s; "
            f"token's end -> next grant: {(granted - ended) / SECOND * 1000:.0f} ms"
        )
        while heir.state != "running":
            await client.changed(heir)
        state = await lab.state(client, lambda state: len(state.holds) == RUNNING + 2)
        stood.went_on(state, "next", "heir")
        del stood.holds["short"]
        after = await crew.checked(lab, client, stood, since=clock.now())
        assert after.host == "b"

        said: list[Grants] = []
        client.mesh.subscribe(client.mesh.keys.grants, Grants, lambda _, grants: said.append(grants))
        lab.signal("a", signal.SIGCONT)
        await lab.logged("a", "stepping down")
        await lab.living(client, Role.RCM, lambda hosts: hosts == ["b"])
        later = await crew.checked(lab, client, stood, since=clock.now())
        assert (later.host, later.term) == ("b", after.term)
        for rc in (*ROBOTS, "robot/free", "robot/short"):
            assert (await lab.rc(client, rc)).term == after.term
        (holder,) = (await lab.rc(client, "robot/short")).holders
        assert holder.grant == heir.grant
        late = sum(1 for grants in said if grants.term == stood.term and grants.rcs)
        print(f"publications of the woken leader about RCs, under its old term: {late}; all were ignored")

        with pytest.raises(CommandRefused) as refused:
            await client.command(ROBOTS[0], Grant(stood.term, 10_000), {"name": "echo", "value": 0})
        assert refused.value.code == "not_holder"
        await asyncio.gather(*(body.finish() for body in crew.bodies))
