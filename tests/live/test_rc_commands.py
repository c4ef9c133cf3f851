"""What an RC obeys, live: refusals, failing drivers, what it missed, and one that died while the lead was taken."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from tests.hang import HANG
from tests.live.bench import ECHO, Bench, SharedBench, Stand, answer, granted, running, until
from tests.live.lab import Lab
from zscout.drivers import resource_controller
from zscout.drivers.resource_controller import MAX_TTL
from zscout.drivers.work_queue import COMMANDS_PER_HOST
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import IncomingQuery, ZenohMesh, clock
from zscout.messages import Done, Grants, HoldView, RcmState, RcState, StateAsk
from zscout.rcm.recovery import RecoveredState
from zscout.rcm.terms import BELIEVED
from zscout.services.rcm.rcm import Rcm
from zscout.types import SECOND, Grant, Place, Term

pytestmark = pytest.mark.live

WAIT = {"name": "wait"}


async def test_every_refusal(lab: Lab, stand: Stand) -> None:
    lab.node("a")
    client, other = await asyncio.gather(lab.client(), lab.client())
    bench, warm = Bench(), Bench(activation=600)
    rc = await stand.rc("robot/bench", bench)
    await stand.rc("robot/warm", warm)
    state = await lab.ready(client, "robot/bench", "robot/warm")
    never = Grant(state.term, 0)

    def echo(grant: Grant, **how: Any) -> Coroutine[Any, Any, Done]:
        return client.command("robot/bench", grant, ECHO, **how)

    assert await answer(echo(never)) == "free"

    arc, grant = await running(client, "one", "robot/bench")
    assert (await echo(grant)).result == 1
    assert await answer(echo(never)) == "not_holder"
    assert await answer(other.command("robot/bench", grant, ECHO)) == "wrong_client"
    assert await answer(other.command("robot/bench", grant, {"name": "confirm"})) == "wrong_client"
    assert await answer(echo(Grant(grant.term, grant.seq + 1000))) == "not_yet"
    for ttl in (0, -1, MAX_TTL + 1):
        assert await answer(echo(grant, ttl=ttl)) == "bad_command"
    for name in ("no such thing", 7, None):
        assert await answer(client.command("robot/bench", grant, {"name": name})) == "unknown_command"
    assert await answer(client.command("robot/bench", grant, {"name": "crash"})) == "failed"

    # While one command takes its time, those behind it grow stale, and too many are refused.
    slow = asyncio.create_task(client.command("robot/bench", grant, WAIT, timeout=HANG))
    await bench.waiting.wait()
    stale = asyncio.create_task(echo(grant, ttl=0.05, timeout=HANG))
    many = [asyncio.create_task(echo(grant, ttl=60, timeout=HANG)) for _ in range(COMMANDS_PER_HOST - 1)]
    await until(lambda: rc.queue.commands == COMMANDS_PER_HOST)
    assert await answer(echo(grant)) == "busy"
    sent = clock.now()
    await until(lambda: clock.now() - sent > 0.1 * SECOND)
    bench.go_on.set()
    assert (await slow).result is None
    assert await answer(stale) == "stale"
    assert {await answer(task) for task in many} == {"done"}

    _, warming = await running(client, "warm", "robot/warm")
    done = await client.command("robot/warm", warming, {"name": "confirm"})
    assert 300 < done.warming <= 600
    assert await answer(client.command("robot/warm", warming, ECHO)) == "warming"

    await client.end(arc)
    await lab.held_by(client, "robot/bench")
    assert await answer(echo(grant)) == "ended"
    await until(lambda: bench.calls == ["begin one", "safe"])
    assert warm.calls == ["begin warm"]


async def test_what_piles_up_while_a_node_stands_still_is_refused(lab: Lab) -> None:
    lab.node("a")
    lab.node("c", "robot/x", extra="candidate = false")
    client = await lab.begun()
    arc, grant = await running(client, "one", "robot/x")
    lab.signal("c", signal.SIGSTOP)
    sent = clock.now()
    old = [asyncio.create_task(client.command("robot/x", grant, ECHO, ttl=0.3, timeout=HANG)) for _ in range(5)]
    await until(lambda: clock.now() - sent > 0.8 * SECOND)
    assert not any(task.done() for task in old)
    lab.signal("c", signal.SIGCONT)
    assert [await answer(task) for task in old] == ["stale"] * 5
    assert await answer(client.command("robot/x", grant, ECHO)) == "done"
    assert arc.grant == grant


async def test_a_failing_device_ends_the_whole_gang_which_waits_for_it(lab: Lab, stand: Stand) -> None:
    lab.node("a", "robot/a")
    client = await lab.client()
    bench = Bench()
    rc = await stand.rc("robot/bench", bench)
    await lab.ready(client, "robot/a", "robot/bench")
    arc, grant = await running(client, "gang", "robot/a", "robot/bench")
    place = arc._place

    rc.fail("smoke comes out of it")
    await until(lambda: arc.state == "queued")
    assert arc._ending is not None
    assert (arc._ending.outcome, arc._place) == ("lost", place)
    assert "smoke comes out of it" in arc._ending.reason
    await until(lambda: bench.calls == ["begin gang", "safe"])
    why = "robot/bench is lost: smoke comes out of it"
    await lab.state(client, lambda state: [(wait.arc, wait.reason) for wait in state.queue] == [("gang", why)])
    await lab.held_by(client, "robot/a")
    for name in ("robot/a", "robot/bench"):
        assert await answer(client.command(name, grant, ECHO)) == "ended"
    # What the gang does not hold any more is there for others.
    brief, _ = await running(client, "brief", "robot/a")
    await client.end(brief)

    bench.broken = True
    rc.recover()
    # It is granted, its driver can't begin, and the gang is queued again.
    await until(lambda: bench.calls.count("begin gang") == 2 and rc.health != "ok")
    assert "no power" in (await lab.rc(client, "robot/bench")).health
    await lab.state(client, lambda state: not state.holds and len(state.queue) == 1)
    bench.broken = False
    rc.recover()
    again = await granted(client, arc)
    assert again > grant
    assert arc._place == place


async def test_one_of_two_holders_ends_and_the_device_serves_the_other(lab: Lab, stand: Stand) -> None:
    lab.node("a")
    client = await lab.client()
    bench = SharedBench(activation=0.3)
    await stand.rc("radio/bench", bench)
    await lab.ready(client, "radio/bench")
    _, first = await running(client, "first", "radio/bench")
    async with asyncio.timeout(HANG):
        while await answer(client.command("radio/bench", first, ECHO)) == "warming":
            pass
    arc, second = await running(client, "second", "radio/bench")
    # The device is warm: one more holder changes nothing for those who are at work.
    assert await answer(client.command("radio/bench", first, ECHO)) == "done"
    assert await answer(client.command("radio/bench", second, ECHO)) == "done"
    await client.end(arc)
    await lab.held_by(client, "radio/bench", "first")
    assert await answer(client.command("radio/bench", second, ECHO)) == "ended"
    assert await answer(client.command("radio/bench", first, ECHO)) == "done"
    assert bench.calls == ["begin first", "begin second"]


TERM = Term(1, "test")


def view(client: str, seq: int) -> HoldView:
    return HoldView(
        id="one",
        arc="one",
        client=client,
        priority=0,
        grant=Grant(TERM, seq),
        place=Place(TERM, 1),
        needs={"robot/x": {}},
        min_runtime=Decimal(60),
        held=0,
        remaining=60,
    )


def said(seq: int, prev: int) -> Grants:
    return Grants(term=TERM, seq=seq, prev=prev, every=0.5, rcs={"robot/other": []})


async def test_a_snapshot_that_was_overtaken_is_read_again(
    lab: Lab, stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resource_controller, "REREAD_TIMEOUT", HANG)
    client = await lab.client()
    mesh = await lab.manager(client)
    keys = mesh.keys
    waiting: list[IncomingQuery[StateAsk]] = []
    seq = 3

    def on_asked(request: IncomingQuery[StateAsk]) -> None:
        if not waiting:
            # The first answer is held back until more has been published.
            waiting.append(request)
        else:
            request.answer(RcmState(TERM, seq, "test", [view(str(client.mesh.me), 5)]))

    rc = await stand.rc("robot/x", Bench())
    mesh.serve(keys.rcm_state, StateAsk, on_asked)
    publisher = mesh.publisher(keys.grants, Grants)
    leads = mesh.alive(Token(mesh.me.host, Role.RCM, mesh.me.client, TERM.rcm))
    while rc.holds.seq != 3:
        publisher.put(said(3, 0))
        await asyncio.sleep(0.02)
    await until(lambda: bool(waiting))
    # Its new term made it read; the grant with number 5 is published and gets lost, 7 arrives.
    seq = 7
    publisher.put(said(7, 6))
    await until(lambda: rc.holds.seq == 7)
    waiting[0].answer(RcmState(TERM, 3, "test"))
    await until(lambda: set(rc.holds.held) == {Grant(TERM, 5)})
    assert await answer(client.command("robot/x", Grant(TERM, 5), ECHO)) == "done"
    leads.close()


@pytest.mark.slow
async def test_an_rc_that_died_while_the_lead_was_taken_is_lost_within_a_lease(tmp_path: Path) -> None:
    async with Lab(tmp_path, lease=4) as lab, Stand(lab) as stand:
        rc = await stand.rc("robot/real", Bench())
        client = await lab.client()
        leader = await ZenohMesh.open(lab.fleet_of("leader"), Sender("leader", "node"))
        rcm = Rcm(leader, lab.fleet, Term(1, "test"), lambda _: BELIEVED, lambda _: None)
        try:
            # Both answered when they were asked; then one of them died, and nobody saw its token go.
            ghost = RcState(rc="robot/ghost", host="h", instance="gone", sharable=False)
            real = await lab.rc(client, "robot/real")
            rcm.start(RecoveredState(rcs={"robot/real": real, "robot/ghost": ghost}))
            _, grant = await running(client, "real", "robot/real")
            lost = await client.request("ghost", {"robot/ghost": {}}, min_runtime=600, wait_for_device=True)
            await until(lambda: lost.reason == "robot/ghost is lost: the node of h is gone")
            assert lost.state == "queued"
            assert await answer(client.command("robot/real", grant, ECHO)) == "done"
            assert set(rc.holds.held) == {grant}
        finally:
            rcm.stop()
            await leader.close()
