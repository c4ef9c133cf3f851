"""A resource controller on the mesh in memory: the order of its work, what it reads, how it ends."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any, cast

import pytest
from msgspec.structs import replace

from tests.drivers.rcs import (
    ECHO,
    LEASE,
    TERM,
    Device,
    Rcm,
    answer,
    close,
    grant,
    holder,
    rc_state,
    started,
    states_published,
)
from tests.hang import HANG
from tests.mesh.kit import until
from zscout.drivers.confirm_server import CommandQuery, ConfirmServer
from zscout.drivers.holds import HoldChange
from zscout.drivers.repeated import MAX_HOSTS, MAX_PER_HOST, MAX_WAITING, CommandMemory
from zscout.drivers.resource_controller import REPUBLISH_PERIOD_S, ResourceController
from zscout.drivers.work_queue import COMMANDS_PER_HOST, EARLY_PER_HOST, WorkQueue
from zscout.keyexpr import Role, Sender
from zscout.mesh import IncomingQuery, Mesh, Refused
from zscout.messages import (
    Ballot,
    Command,
    Confirm,
    Confirmed,
    Done,
    Grants,
    Holder,
    Malformed,
    Problem,
    Proposal,
    ProposedHolder,
    RcAsk,
    RcmState,
    RcState,
)
from zscout.testing.link import Disturbance
from zscout.testing.memory import MemoryMesh, MemoryNetwork
from zscout.types import SECOND, Grant, Term


@asynccontextmanager
async def play(kind: type[Device] = Device, **how: Any) -> AsyncIterator[tuple[Rcm, ResourceController, Device, Mesh]]:
    """An RCM, an RC that `one` holds under grant 1, and its client `h/client`."""
    network = MemoryNetwork()
    rcm, device = Rcm(network), kind()
    client = network.open("f", Sender("h", "client"))
    rc = await started(network, device, **how)
    rcm.publish(holder(1))
    await until(lambda: device.calls == ["begin one"])
    try:
        yield rcm, rc, device, client
    finally:
        await close(rc, rcm.mesh, client)


async def test_the_safe_state_waits_for_no_command_though_the_rcm_hangs() -> None:
    async with play() as (rcm, rc, device, client):
        rcm.hangs = True
        # Under a grant that nobody knows: each made the RC read `rcm/state` for half a second.
        early = [asyncio.create_task(answer(client, grant(99), ttl=60)) for _ in range(20)]
        await until(lambda: rc.queue.commands == EARLY_PER_HOST)
        await until(lambda: len(rcm.asked) == 2)  # one when it started, and one for all of these
        asked, ended = len(rcm.asked), rcm.mesh.now()
        rcm.publish()
        await until(lambda: device.calls == ["begin one", "end one", "safe"])
        assert rcm.mesh.now() - ended < 0.01 * SECOND
        assert await asyncio.gather(*early) == ["not_yet"] * EARLY_PER_HOST + ["busy"] * (20 - EARLY_PER_HOST)
        assert len(rcm.asked) == asked


class Picky(Device):
    sharable = True

    def vote(self, holders: list[ProposedHolder]) -> str:
        raise ValueError("no such parameter: pace")


async def test_a_driver_that_can_not_read_a_proposal_votes_against_it() -> None:
    async with play(Picky) as (_, _, _, client):
        reply = await client.ask_one(client.keys.vote("robot/x"), Proposal(7, TERM, []), Ballot, timeout=1)
        assert reply is not None
        assert reply.message == Ballot(7, accept=False, reason="no such parameter: pace")


class Carrying(Device):
    """Says, too, what goes on in what."""

    async def carry_on(self, before: Holder, after: Holder) -> None:
        await self._do(f"{before.arc} of {before.client} goes on in {after.arc} of {after.client}")


@pytest.mark.parametrize("kind", [Carrying, Device])
async def test_what_goes_on_in_another_hold_is_neither_ended_nor_made_safe(kind: type[Device]) -> None:
    network = MemoryNetwork()
    rcm, device = Rcm(network), kind()
    client = network.open("f", Sender("h", "client"))

    rc = await started(network, device)
    warm, turn = holder(1, "warm"), replace(holder(2, "turn"), continues="warm")
    moved = replace(turn, client="h/other", grant=grant(3))
    begins = ["begin turn", "begin turn"]
    if kind is Carrying:
        begins = ["warm of h/client goes on in turn of h/client", "turn of h/client goes on in turn of h/other"]
    expected = ["begin warm", *begins, "end turn", "safe", "begin last"]
    for one, calls in (warm, 1), (turn, 2), (moved, 3), (holder(4, "last", "h/other"), 6):
        rcm.publish(one)
        await until(lambda: len(device.calls) >= calls)  # noqa: B023 - awaited here
    assert (device.calls, await answer(client, turn.grant)) == (expected, "ended")
    await close(rc, rcm.mesh, client)


async def test_a_hold_that_was_held_back_begins_in_the_one_that_continues_it() -> None:
    """And what was the device's still is made safe before it: nothing was warm yet."""

    class Slow(Carrying):
        async def safe(self) -> None:
            await asyncio.sleep(1)
            await super().safe()

    async with play(Slow, settle=2.0) as (rcm, _rc, device, _client):
        rcm.publish(holder(2, "warm"))
        await asyncio.sleep(0.5)
        rcm.publish(replace(holder(3, "turn"), continues="warm"))
        await until(lambda: len(device.calls) >= 4)
        assert device.calls == ["begin one", "end one", "safe", "begin turn"]


async def test_the_safe_state_goes_before_commands_that_wait() -> None:
    async with play() as (rcm, _rc, device, client):
        slow = asyncio.create_task(answer(client, grant(1), {"name": "slow", "seconds": 0.5}))
        await asyncio.sleep(0.1)
        waiting = [asyncio.create_task(answer(client, grant(1))) for _ in range(5)]
        await asyncio.sleep(0.1)
        rcm.publish(holder(2, "two"))
        assert (await slow, {await task for task in waiting}) == ("done", {"ended"})
        assert device.calls == ["begin one", "slow", "end one", "safe", "begin two"]


async def test_early_commands_are_obeyed_in_their_order_once_the_grant_is_known() -> None:
    async with play() as (rcm, rc, device, client):
        rcm.hangs = True
        told = [asyncio.create_task(answer(client, grant(2), {"name": "echo", "value": number})) for number in range(3)]
        await until(lambda: rc.queue.commands == 3)
        assert await answer(client, grant(1)) == "done"  # nothing else waits for them
        rcm.publish(holder(2))
        told.append(asyncio.create_task(answer(client, grant(2), {"name": "echo", "value": 3})))
        assert await asyncio.gather(*told) == ["done"] * 4
        assert device.calls[-5:] == ["begin one", *(f"echo {number}" for number in range(4))]
        assert "safe" not in device.calls[-5:]


async def test_an_early_command_makes_the_rc_read_what_it_missed() -> None:
    async with play() as (rcm, _rc, device, client):
        rcm.publish()
        await until(lambda: device.calls[-1] == "safe")
        rcm.seq = 5
        rcm.holds = [rcm.view(5)]
        assert await asyncio.gather(*(answer(client, grant(5)) for _ in range(2))) == ["done", "done"]
        assert await answer(client, grant(6)) == "not_yet"
        assert await answer(client, grant(5), ttl=0) == "bad_command"


async def test_a_command_that_arrives_again_is_carried_out_once() -> None:
    async with play() as (rcm, _rc, device, client):
        rcm.publish(holder(1))
        await until(lambda: device.calls and device.calls[-1] == "begin one")
        key, other = client.keys.command("robot/x", client.me), client.keys.command("robot/x", Sender("h", "other"))

        async def told(number: int, *, id_: str | None, key: str = key, name: str = "echo") -> object:
            do = {"name": name, "value": number, "seconds": 1.0}
            command = Command(do=do, grant=grant(1), ttl=5.0, id=id_)
            reply = await client.ask_one(key, command, Done, timeout=60)
            assert reply is not None
            return reply.message.result if reply.message is not None else reply.problem and reply.problem.code

        assert [await told(1, id_="a"), await told(2, id_="a"), await told(3, id_="b")] == [1, 1, 3]
        slow = [told(4, id_="c", name="slow") for _ in range(3)]
        assert await asyncio.gather(*slow) == [4, 4, 4]
        assert device.calls[-3:] == ["echo 1", "echo 3", "slow 4"]
        # What was refused stays so, and an id is its sender's.
        assert [await told(5, id_="d", key=other), await told(5, id_="d", key=other)] == ["wrong_client"] * 2
        assert [await told(5, id_="d"), await told(6, id_=None), await told(6, id_=None)] == [5, 6, 6]
        assert device.calls[-3:] == ["echo 5", "echo 6", "echo 6"]


def test_one_host_fills_no_others_memory_of_commands() -> None:
    memory = CommandMemory()

    def is_new(host: str, id_: str) -> bool:
        query = IncomingQuery(None, "", "", Command(do={}, id=id_), 0)
        return memory.is_new(Sender(host, "one"), query)

    assert is_new("mine", "a")
    assert all(is_new("stranger", str(number)) for number in range(2 * MAX_PER_HOST))
    assert not is_new("mine", "a")
    assert is_new("stranger", "0")  # forgotten
    waiting = [is_new("mine", "a") for _ in range(MAX_WAITING - 1)]
    assert waiting == [False] * (MAX_WAITING - 1)
    with pytest.raises(Refused):
        is_new("mine", "a")
    assert all(is_new(f"host{number}", "a") for number in range(MAX_HOSTS))
    assert is_new("mine", "a")  # others commanded later


async def test_a_hold_ends_when_no_rcm_was_heard_for_the_lease() -> None:
    async with play() as (rcm, rc, device, client):
        ended: list[str] = []
        client.subscribe(
            client.keys.rc_state_any, RcState, lambda _key, state: ended.extend(hold.why for hold in state.ended)
        )
        begun = rcm.mesh.now()
        await until(lambda: device.calls[-1] == "safe")
        assert abs(rcm.mesh.now() - begun - LEASE * SECOND) < 0.1 * SECOND
        await until(lambda: ended == ["lease"])
        assert (await answer(client, grant(1)), rc.health) == ("ended", "ok")


@pytest.mark.parametrize("where", ["begin two", "safe"])
async def test_a_driver_that_raises_fails_its_rc_which_recovers(where: str) -> None:
    async with play() as (rcm, rc, device, client):
        device.broken = {where}
        rcm.publish(holder(2, "two"))
        await until(lambda: rc.health == f"its driver failed: {where} failed")
        assert await answer(client, grant(2)) == "ended"
        device.broken = set()
        rc.recover()
        rcm.publish(holder(3, "three"))
        await until(lambda: device.calls[-1] == "begin three")


async def test_an_rc_that_fails_leaves_the_mesh_with_its_device_safe_and_tells_its_owner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    failures, tokens = list[Exception](), dict[str, bool]()

    def fault(*_args: object, **_how: object) -> None:
        raise KeyError("a fault of ours")

    async with play(on_failure=failures.append) as (rcm, rc, device, client):
        watch = client.watch(client.keys.alive_any(Role.RC), lambda token, alive: tokens.update({token.name: alive}))
        await until(lambda: tokens == {"robot/x": True})
        monkeypatch.setattr(rc.holds, "apply_grants", fault)
        rcm.publish()
        await until(lambda: device.calls[-1] == "safe")
        assert [type(error) for error in failures] == [KeyError]
        assert "its resource controller failed" in rc.health
        await until(lambda: tokens == {"robot/x": False})
        watch.close()
    assert device.calls.count("safe") == 1


async def test_a_command_under_a_grant_that_was_missed_waits_until_that_was_read() -> None:
    async with play() as (rcm, rc, _device, client):
        rcm.publish()
        await until(lambda: not rc.holds.held)
        rcm.hangs, rcm.seq = True, rcm.seq + 2
        granted = rcm.seq
        rcm.publish(rc="robot/another")
        await until(lambda: rcm.asked and rc.holds.seq == rcm.seq)
        asking = asyncio.create_task(answer(client, grant(granted)))
        await until(lambda: rc.queue.commands)
        rcm.asked[-1].answer(RcmState(TERM, rcm.seq, "rcm", [rcm.view(granted)]))
        assert await asking == "done"


async def test_an_rc_that_has_missed_something_does_not_say_that_it_knows_all() -> None:
    """Its RCM would take a hold for lost of which it has yet to read."""
    async with play() as (rcm, rc, _device, client):
        states = states_published(client)
        rcm.hangs = True
        rcm.seq += 1
        rcm.publish(rc="robot/y")
        await until(lambda: rc.holds.seq == rcm.seq)
        rc.publish()
        await until(lambda: bool(states))
        assert states[-1].seq == 0
        rcm.hangs = False
        await asyncio.sleep(2)  # what it asked in vain is over
        rcm.publish(rc="robot/y")
        await until(lambda: not rc._missed)
        rc.publish()
        await until(lambda: states[-1].seq == rcm.seq)


async def test_figures_are_published_when_they_change() -> None:
    network, device = MemoryNetwork(), Device()
    watcher = network.open("f", Sender("w", "watcher"))
    seen: list[float] = []
    figures = {"packets": 1.0}
    device.figures = figures.copy  # type: ignore[method-assign]
    rc = await started(network, device)
    watcher.subscribe(watcher.keys.rc_state_any, RcState, lambda _key, state: seen.append(state.figures["packets"]))
    await asyncio.sleep(5)
    assert seen == []
    figures["packets"] = 2.0
    await asyncio.sleep(5)
    assert seen == [2.0]
    await close(rc, watcher)


async def test_how_long_it_was_used_is_told_within_a_second_of_the_end() -> None:
    async with play() as (rcm, _rc, device, client):
        states = states_published(client)
        assert await answer(client, grant(1), {"name": "confirm"}) == "done"
        await asyncio.sleep(0.2)
        assert await answer(client, grant(1), {"name": "slow", "seconds": 0.5}) == "done"
        await asyncio.sleep(1)
        rcm.publish(holder(1))  # the hold lease goes on
        for _ in range(10):
            assert await answer(client, grant(1)) == "done"
        # What is refused, confirmed or another's is no use.
        await asyncio.sleep(0.5)
        device.broken.add("echo 1")
        assert await answer(client, grant(1)) == "failed"
        assert await answer(client, grant(1), {"name": "confirm"}) == "done"
        assert await answer(client, grant(2)) == "not_holder"
        # Commands have nothing published.
        assert states == []
        rcm.publish(holder(2, "two"))
        await until(lambda: states, within=1.1)
        uses = [(use.grant, use.seconds) for use in states[0].used]
        assert uses == [(grant(1), pytest.approx(1.5, abs=0.01)), (grant(2), 0.0)]
        await asyncio.sleep(1.9)
        assert len(states) == 1


async def test_a_command_that_takes_its_time_counts_once_it_is_carried_out() -> None:
    class Slow(Device):
        """Answers a command some seconds later, beside others."""

        async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
            async def take() -> str:
                await asyncio.sleep(do["seconds"])
                if do["name"] == "fail":
                    raise Refused("failed", "in vain")
                return "done"

            return asyncio.ensure_future(take())

    async def used(client: Mesh) -> float:
        (use,) = (await rc_state(client)).used
        return use.seconds

    async with play(Slow) as (_rcm, _rc, _device, client):
        assert await answer(client, grant(1), {"name": "fail", "seconds": 1}) == "failed"
        assert await used(client) == 0.0
        long = asyncio.create_task(answer(client, grant(1), {"name": "do", "seconds": 1}))
        assert await answer(client, grant(1), {"name": "do", "seconds": 0.5}) == "done"
        assert await used(client) == pytest.approx(0.5, abs=0.01)
        assert await long == "done"
        assert await used(client) == pytest.approx(1.0, abs=0.01)


async def test_who_missed_that_an_rc_works_again_hears_it_later() -> None:
    network, device = MemoryNetwork(), Device()
    watcher = network.open("f", Sender("w", "watcher"))
    seen: list[str] = []
    rc = await started(network, device)
    watcher.subscribe(watcher.keys.rc_state_any, RcState, lambda _key, state: seen.append(state.health))
    rc.fail("no power")
    await until(lambda: seen == ["no power"])
    network.disturb({"rc/state": Disturbance(lost=1.0)})
    rc.recover()
    await asyncio.sleep(1)
    network.disturb({})
    assert seen == ["no power"]
    await until(lambda: seen[-1] == "ok", within=REPUBLISH_PERIOD_S + 2)
    await close(rc, watcher)


async def test_a_publication_of_an_older_term_is_answered_by_the_state() -> None:
    async with play() as (_rcm, _rc, _device, client):
        states, old = states_published(client), type(TERM)(1, "old")
        client.publisher(client.keys.grants, Grants).put(Grants(term=old, seq=9, prev=8, every=0.5))
        await until(lambda: bool(states))
        assert (states[0].term, await answer(client, grant(1), dict(ECHO))) == (TERM, "done")


@pytest.mark.parametrize(
    "sign",
    [
        None,
        "an RCM is seen that does not publish",
        "the RCM publishes and is not seen",
        "the RCM publishes and has not asked for its promise",
        "the RCM publishes and has not asked for its promise; another instance was asked",
    ],
)
async def test_an_rc_that_an_rcm_and_the_mesh_contradict_joins_the_mesh_anew(
    sign: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    """What the RCM answers is no sign that it is heard."""
    with caplog.at_level(logging.WARNING, "zscout.mesh"):
        async with play() as (rcm, rc, _device, client):
            if sign is not None and "not seen" in sign:
                rcm.token.close()
            if sign is None or "not asked" not in sign or "another" in sign:
                ask = RcAsk(promise=TERM, instance=rc.instance if sign is None or "another" not in sign else "i2")
                await rcm.mesh.ask(rcm.mesh.keys.rc_state(rc.name), ask, RcState, timeout=1)
            mesh = cast("MemoryMesh", rc.mesh)
            before = mesh._transport.id()
            for _ in range(12):
                if sign is None or "not publish" not in sign:
                    rcm.publish(holder(1))
                # It reads what it may have missed.
                await answer(client, grant(99), ttl=0.1)
                await asyncio.sleep(0.5)
            assert (mesh._transport.id() != before) == (sign is not None)
    said = [record.message for record in caplog.records if "reopening the mesh session" in record.message]
    told = sign and sign.partition(";")[0]
    assert said == ([f"robot/x: {told}: reopening the mesh session"] if sign is not None else [])


# The queue alone


def query(name: str) -> CommandQuery:
    return cast("CommandQuery", name)


def drained(queue: WorkQueue, count: int) -> list[Any]:
    async def take() -> list[Any]:
        return [await asyncio.wait_for(queue.get(), HANG) for _ in range(count)]

    return asyncio.run(take())


def test_changes_go_before_all_commands_and_keep_their_order() -> None:
    queue, first, second = WorkQueue(), HoldChange(stayed=True), HoldChange(reread=True)
    for name in ("a", "b"):
        assert queue.put_command(query(name), "host")
    queue.put_change(first)
    queue.put_change(second)
    assert drained(queue, 4) == [first, second, "a", "b"]


def test_what_was_set_aside_comes_back_before_other_commands_in_its_order() -> None:
    queue = WorkQueue()
    for name in ("one", "two", "three"):
        assert queue.set_aside(query(name), "host")
    assert queue.put_command(query("late"), "host")
    assert queue.commands == 4
    queue.resume(lambda command: cast("str", command) != "two")
    assert (queue.drop_early(), queue.commands) == ([query("two")], 3)
    assert drained(queue, 3) == ["one", "three", "late"]


@pytest.mark.parametrize("take", ["set_aside", "put_command"])
def test_one_host_can_not_fill_the_queue_or_what_is_set_aside(take: str) -> None:
    put, limit = getattr(WorkQueue(), take), EARLY_PER_HOST if take == "set_aside" else COMMANDS_PER_HOST
    assert all(put(query(str(number)), "stranger") for number in range(limit))
    assert not put(query("more"), "stranger")
    assert put(query("mine"), "host")


def test_who_waits_is_woken() -> None:
    async def story() -> None:
        queue = WorkQueue()
        queue.set_aside(query("early"), "host")
        waiting = asyncio.create_task(queue.get())
        await asyncio.sleep(0)
        assert not waiting.done()
        queue.resume(lambda _command: True)
        assert await asyncio.wait_for(waiting, HANG) == query("early")

    asyncio.run(story())


async def test_figures_that_are_no_numbers_are_left_out() -> None:
    """In a message they would make all of it unreadable."""

    class Odd(Device):
        def figures(self) -> dict[str, float]:
            return {"good": 1.5, "nan": float("nan"), "endless": float("inf")}

    async with play(Odd) as (*_, client):
        assert (await rc_state(client)).figures == {"good": 1.5}


async def test_what_its_driver_declares_amiss_is_told_before_anybody_is_offered_it() -> None:
    class Amiss(Device):
        def parameters(self) -> list[Any]:
            return ["voltage"]

    with pytest.raises(Malformed):
        await started(MemoryNetwork(), Amiss())


# One question to all RCs of a process, and to two processes of one host

GRANT = Grant(Term(1, "a"), 2)
BUSY = Refused("busy", "ask again")


async def test_each_rc_answers_for_itself_and_nothing_is_said_of_others() -> None:
    network = MemoryNetwork()
    server, other = (ConfirmServer(network.open("f", Sender("bench", name))) for name in ("node", "drivers"))
    client = network.open("f", Sender("desk", "one"))
    asked: list[CommandQuery] = []

    def refuse(_: CommandQuery) -> None:
        raise BUSY

    for rc, take in (("robot/a", asked.append), ("robot/b", asked.append), ("robot/c", refuse)):
        server.serve(rc, take)
    gone = server.serve("robot/gone", asked.append)
    gone.close()
    other.serve("radio/r", lambda query: query.answer(Done(warming=2.0)))
    rcs = ["robot/a", "robot/b", "robot/a", "robot/c", "robot/gone", "robot/foreign", "radio/r"]
    key = client.keys.confirm("bench", client.me)
    asking = asyncio.create_task(client.ask(key, Confirm(GRANT, rcs, ttl=0.5), Confirmed, timeout=1))
    await asyncio.sleep(0.1)
    for query in asked:
        assert (query.message.grant, query.message.do, query.message.ttl) == (GRANT, {"name": "confirm"}, 0.5)
        assert client.keys.sender_of(query.key) == client.me
    first, second = asked
    second.refuse(Problem("settling", "it settles", left=1.0))
    await asyncio.sleep(0.1)
    assert not asking.done()
    first.answer(Done(settle=5.0))
    first.answer(Done(settle=9.0))
    replies = [reply.message for reply in await asking]
    assert Confirmed({"radio/r": Done(warming=2.0)}) in replies
    settles = {"robot/b": Problem("settling", "it settles", left=1.0), "robot/c": BUSY.problem}
    assert Confirmed({"robot/a": Done(settle=5.0)}, settles) in replies
