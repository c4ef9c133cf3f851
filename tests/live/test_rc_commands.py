"""What an RC obeys, live: every refusal, failing drivers, and the end of holds that nobody ends."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.hang import HANG
from tests.live.bench import ECHO, Bench, SharedBench, Stand, answer, running, until
from tests.live.lab import Lab
from zscout.behaviors.client.arc import Revoked, hold
from zscout.behaviors.client.client import Client
from zscout.drivers.resource_controller import MAX_TTL
from zscout.drivers.work_queue import COMMANDS_PER_HOST
from zscout.mesh import clock
from zscout.mesh.zenoh_mesh import zenoh_config
from zscout.messages import Done, EndedHold, Problem, RcState, decode
from zscout.types import SECOND, Grant

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
    await _malformed(lab, client, grant)

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
    _, brief = await running(client, "brief", "robot/bench", min_runtime=5, keep=False)
    await until(lambda: not rc.holds.held)
    assert await answer(echo(brief)) == "ended"
    assert warm.calls == ["begin warm"]


async def _malformed(lab: Lab, client: Client, grant: Grant) -> None:
    key = client.mesh.keys.command("robot/bench", client.mesh.me)
    good = f'"grant": [[{grant.term.counter}, "{grant.term.rcm}"], {grant.seq}]'
    payloads = {
        b"": "malformed",
        b"not JSON": "malformed",
        b"[]": "malformed",
        b"{}": "malformed",
        b'{"grant": null, "do": {}}': "no_grant",
        b'{"do": {"name": "halt"}}': "no_grant",
        f'{{{good}, "do": "echo"}}'.encode(): "malformed",
        f'{{{good}, "do": {{}}, "ttl": "1"}}'.encode(): "malformed",
        f'{{{good}, "do": {{}}, "ttl": NaN}}'.encode(): "malformed",
        f'{{{good}, "do": {{}}}}'.encode(): "unknown_command",
    }

    def raw() -> dict[bytes, str]:
        codes = {}
        with zenoh.open(zenoh_config(lab.fleet.mesh)) as session:
            for payload in payloads:
                got: list[zenoh.Reply] = []
                while not got:
                    got = list(session.get(key, payload=payload, timeout=HANG))
                (reply,) = got
                assert reply.err is not None
                problem: Problem = decode(reply.err.payload.to_bytes(), Problem)
                codes[payload] = problem.code
        return codes

    assert await asyncio.to_thread(raw) == payloads


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
    place = arc.place

    rc.fail("smoke comes out of it")
    await until(lambda: arc.state == "queued")
    assert arc.ending is not None
    assert (arc.ending.outcome, arc.place) == ("lost", place)
    assert "smoke comes out of it" in arc.ending.reason
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
    again = await client.granted(arc)
    assert again is not None
    assert again > grant
    assert arc.place == place


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


async def test_holds_end_at_rc_and_client_when_no_rcm_is_heard_for_the_hold_lease(tmp_path: Path) -> None:
    lease = 8.0
    async with Lab(tmp_path, lease=lease / 2, extra=f"[timing]\nhold_lease = {lease}\n") as lab:
        lab.node("a")
        lab.node("c", "robot/x", "robot/y", extra="candidate = false")
        client = await lab.client()
        async with Stand(lab) as stand:
            bench = Bench()
            await stand.rc("robot/bench", bench)
            await lab.ready(client, "robot/x", "robot/y", "robot/bench")
            ended: dict[str, list[EndedHold]] = {}

            def on_state(_key: str, state: RcState) -> None:
                ended.setdefault(state.rc, []).extend(state.ended)

            client.mesh.subscribe(client.mesh.keys.rc_state_any, RcState, on_state)
            kept, kept_grant = await running(client, "kept", "robot/y", min_runtime=0.1, keep=True)
            grants: list[Grant] = []
            with pytest.raises(Revoked) as revoked:  # noqa: PT012
                async with hold(client, "gang", {"robot/x": {}, "robot/bench": {}}, min_runtime=600) as held:
                    assert await held.confirmed()
                    grants.append(held.grant)
                    killed = lab.signal("a", signal.SIGKILL)
                    async with asyncio.timeout(HANG):
                        await asyncio.Event().wait()
            assert revoked.value.outcome == "lost"
            # The last word may have been half a second old when the RCM died, and some more where it stood still.
            assert lease / 2 < (clock.now() - killed) / SECOND
            await until(lambda: {rc for rc, holds in ended.items() if holds} == {"robot/x", "robot/y", "robot/bench"})
            assert {(hold.why, hold.grant) for holds in ended.values() for hold in holds} == {
                ("lease", grants[0]),
                ("lease", kept_grant),
            }
            await until(lambda: bench.calls == ["begin gang", "safe"] and kept.grant is None)
            for name, grant in (("robot/x", grants[0]), ("robot/y", kept_grant)):
                await lab.held_by(client, name)
                assert await answer(client.command(name, grant, ECHO)) == "ended"

            # What is still wanted is granted anew as soon as somebody leads.
            lab.nodes["a"].wait()
            lab.node("a")
            again = await client.granted(kept)
            assert again is not None
            assert again > kept_grant
