"""The leading RCM hangs and wakes under a successor: it steps down, and no RC obeys its term any more."""

from __future__ import annotations

import asyncio
import signal
from decimal import Decimal
from pathlib import Path

import msgspec
import pytest
import zenoh

from tests.hang import HANG
from tests.live.crew import Crew, Stand
from tests.live.lab import PATIENT, Lab, LeaderWatch
from tests.live.test_leader_killed import APART, RUNNING, WAITING, grant_of
from zscout.behaviors.client.client import CommandRefused
from zscout.keyexpr import Role, Sender
from zscout.mesh import clock
from zscout.mesh.zenoh_mesh import zenoh_config
from zscout.messages import Ask, Grants, Notice, RcState, Revocation, encode
from zscout.types import SECOND, Grant, Term

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

        await _forgeries_are_ignored(lab, crew, stood, after.term)
        await asyncio.gather(*(body.finish() for body in crew.bodies))


async def _forgeries_are_ignored(lab: Lab, crew: Crew, stood: Stand, newest: Term) -> None:
    """A raw session speaks under the term of the RCM that was replaced."""
    client, body = lab.clients[0], crew.bodies[0]
    keys, old = client.mesh.keys, stood.term
    (real,) = (await lab.rc(client, body.rc)).holders
    thief = Grant(old, 10_000)
    stolen = msgspec.structs.replace(real, id="thief", arc="thief", client=str(client.mesh.me), grant=thief)
    revoked = Revocation(real.id, real.arc, real.client, real.grant, real.rcs, "preempted", "forged")
    answers: list[RcState] = []
    heard = asyncio.Event()

    def on_state(_key: str, state: RcState) -> None:
        answers.append(state)
        heard.set()

    client.mesh.subscribe(keys.rc_state(body.rc), RcState, on_state)
    owner = next(arc for arc in crew.waiting if list(arc.needs) == [body.rc])
    notice = Notice(
        id=owner.id,
        arc=owner.name,
        client=str(crew.clients[0].mesh.me),
        state="running",
        term=old,
        step=1_000_000,
        grant=thief,
        rcs=[body.rc],
        remaining=60,
    )
    with zenoh.open(zenoh_config(lab.fleet.mesh)) as stranger:
        # Its links are there once it is answered.
        async with asyncio.timeout(HANG):
            while not await asyncio.to_thread(_get, stranger, keys.rc_state(body.rc)):
                pass
        for forged in (
            Grants(term=old, seq=10_000, prev=9_999, every=0.5, rcs={body.rc: [stolen]}, revoked=[revoked]),
            Grants(term=old, seq=10_001, prev=10_000, every=0.5, rcs={body.rc: []}, revoked=[revoked]),
        ):
            heard.clear()
            stranger.put(keys.grants, encode(forged))
            # The RC answers the outdated with its newer term: it has read the forgery by then.
            async with asyncio.timeout(HANG):
                await heard.wait()
            assert answers[-1].term == newest
            assert [holder.grant for holder in answers[-1].holders] == [real.grant]
        stranger.put(keys.notice(Sender(*notice.client.split("/"))), encode(notice))
        # A request of the same session is answered after what it published was read.
        raw = await asyncio.to_thread(_get, stranger, keys.schedule(Sender("test", "stranger")), _any_request())
        assert raw
    with pytest.raises(CommandRefused) as refused:
        await client.command(body.rc, thief, {"name": "echo", "value": 0})
    assert refused.value.code == "not_holder"
    await crew.checked(lab, client, stood, since=clock.now())


def _any_request() -> bytes:
    return encode(Ask(id="none", arc="none", needs={}, priority=0, min_runtime=Decimal(1)))


def _get(session: zenoh.Session, key: str, payload: bytes = b"{}") -> list[zenoh.Reply]:
    return list(session.get(key, payload=payload, timeout=PATIENT))
