"""What an RC obeys, live: every refusal, failing drivers, and the end of holds that nobody ends."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from typing import Any

import pytest

from tests.hang import HANG
from tests.live.bench import ECHO, Bench, SharedBench, Stand, answer, running, until
from tests.live.lab import Lab
from zscout.drivers.resource_controller import MAX_TTL
from zscout.drivers.work_queue import COMMANDS_PER_HOST
from zscout.mesh import clock
from zscout.messages import Done
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
