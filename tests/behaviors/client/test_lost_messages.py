"""What a client holds while notices, questions, publications or tokens do not arrive."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import Any

import pytest
from msgspec.structs import replace

from tests.behaviors.client.small_fleet import ECHO, FLEET, RC, held, small_fleet, transport_of
from tests.mesh.kit import until
from zscout.behaviors.client import rcm_link
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.confirmation import CONFIRM_TIMEOUT
from zscout.behaviors.client.internals import NOTICE_TIMEOUT, REJOIN_TIMEOUT
from zscout.behaviors.client.rcm_link import RcmLink
from zscout.behaviors.client.request import CommandRefused
from zscout.keyexpr import Role, Token
from zscout.mesh import Reply
from zscout.messages import Command, Notice, Operation
from zscout.scheduling.model import HOLD_BACK
from zscout.testing.link import Disturbance
from zscout.types import SECOND


async def test_a_hold_is_over_when_its_rc_says_so_though_no_notice_does() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        arc, grant = await held(one, "first")
        fleet.network.disturb({"notice": Disturbance(lost=1.0)})
        await two.granted(await two.request("operator", {RC: {}}, priority=9, min_runtime=600))
        with pytest.raises(CommandRefused, match="is over"):
            await one.command(RC, grant, ECHO)
        await until(lambda: arc.grant is None, within=1.5)
        await until(lambda: arc.state == "queued", within=1.0)


@pytest.mark.parametrize("cut", [0.9, 1.5, 8.0])
async def test_a_client_that_sees_its_rc_anew_is_granted_at_once(cut: float) -> None:
    """Not when what was held back longer each time is over: nobody else was cut off."""
    async with small_fleet("one") as (fleet, (one,)):
        network, (client, rc) = fleet.network, (one.mesh, fleet.devices)
        for source, target in ((client, rc), (rc, client)):
            network.cut(source, target)
        arc = await one.request("first", {RC: {}}, min_runtime=600)
        granting = asyncio.create_task(one.granted(arc, confirmed=True))
        await asyncio.sleep(cut)
        assert not granting.done()
        network.heal()
        await asyncio.wait_for(granting, 0.3 if cut > CONFIRM_TIMEOUT else HOLD_BACK / SECOND)


async def test_what_was_given_up_unheard_is_withdrawn_once_an_rcm_answers() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        arc, _ = await held(one, "first", keep=True)
        waits = await two.request("second", {RC: {}}, min_runtime=600)
        link = fleet.network.link(one.mesh, fleet.leader())
        link.loss = 1.0
        await one.end(arc)
        link.loss = 0.0
        assert await fleet.holders() == ["first"]
        await until(lambda: waits.state == "running", within=7)


async def test_what_had_its_time_before_its_client_heard_of_it_is_asked_for_anew_at_its_place() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        first = await one.request("first", {RC: {}}, min_runtime=600, keep=True)
        waits = await two.request("second", {RC: {}}, min_runtime=0.5, keep=False)
        known_as, place = waits.id, waits._place
        fleet.network.disturb({"notice": Disturbance(lost=1.0)})
        await one.end(first)
        assert await fleet.holders() == ["second"]
        await asyncio.sleep(1)
        fleet.network.disturb({})
        assert waits.state == "queued"
        assert await two.granted(waits) is not None
        assert (waits.id != known_as, waits._place) == (True, place)


async def test_a_client_that_hears_no_publication_of_an_rcm_that_it_sees_joins_the_mesh_anew(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING, "zscout.mesh"):
        async with small_fleet("one") as (fleet, (one,)):
            await one.request("absent", {"robot/z": {}}, min_runtime=60)
            await asyncio.sleep(60)
            assert not caplog.records
            before = one.mesh._transport.id()
            fleet.network.disturb({"grants": Disturbance(lost=1.0)})
            await until(lambda: one.mesh._transport.id() != before)
            fleet.network.disturb({})
    said = {record.message.partition(": reopening the mesh session")[0] for record in caplog.records}
    assert "an RCM is seen that does not publish" in said


@pytest.mark.parametrize("lease", [3, 12, 60])
async def test_a_leaders_death_reopens_no_session(lease: int, caplog: pytest.LogCaptureFixture) -> None:
    """Its last publication counts as recent for half a hold lease, but does not contradict its missing token."""
    timing = replace(FLEET.timing, hold_lease=lease * SECOND)
    with caplog.at_level(logging.WARNING, "zscout.mesh"):
        async with small_fleet("one", "two", config=replace(FLEET, timing=timing)) as (fleet, (one, two)):
            await held(one, "first")
            waits = await two.request("second", {RC: {}}, min_runtime=60)
            await fleet.lose_leader()
            # None of its questions is answered.
            for _ in range(2 * lease + 10):
                await two.internals.rcm.ask(waits)
                await asyncio.sleep(1)
    assert [record.message for record in caplog.records] == []


@pytest.mark.parametrize("whose", ["client", "RC"])
async def test_a_hold_goes_on_under_a_leader_that_does_not_know_who_listens_to_it(whose: str) -> None:
    """Links came back without the subscription of what RCMs publish, long before this one led."""
    async with small_fleet("one") as (fleet, (one,)):
        arc, grant = await held(one, "first")
        next_leader = await fleet.standby()
        listening = one.mesh if whose == "client" else fleet.devices
        hidden = [known for known in transport_of(listening).subscribers.all if known[0] == listening.keys.grants]
        assert hidden
        fleet.network.link(listening, next_leader).hidden = {*hidden}
        await fleet.lose_leader()
        states: list[str] = []
        one.internals.watch(lambda arc: states.append(arc.state))
        await until(lambda: one.leader == "h1")
        await asyncio.sleep(10)
        assert (arc.grant, {*states}) == (grant, {"running"})


async def test_a_leader_that_is_asked_by_whom_it_does_not_see_joins_the_mesh_anew() -> None:
    """Links came back without its token, its subscription of notices and its `requests`: what it asks arrives, and it
    hears what is published."""
    async with small_fleet("one", "two") as (fleet, (one, _)):
        arc, _ = await held(one, "first")
        leader = fleet.leader()
        before, client = transport_of(leader), transport_of(one.mesh)
        heard = [known for known in client.subscribers.all if known[0] == one.mesh.keys.grants]
        fleet.network.link(one.mesh, leader).hidden = {*client.declarations()} - {*heard}
        before.disconnected(client)
        await until(lambda: leader._transport.current is not before)
        await asyncio.sleep(FLEET.mesh.lease + 1)
        outcomes: list[str | None] = []
        one.internals.watch(lambda arc: outcomes.append(arc.outcome))
        await asyncio.sleep(10)
        assert arc.state == "running"
        assert "client_lost" not in outcomes


async def test_a_holder_that_does_not_see_the_leader_it_receives_soon_asks_it() -> None:
    """Links came back without the token of the leader, and without all that this client declared but its subscription
    of publications: the leader has ended its hold, and nothing but the answer to a request tells the client."""
    async with small_fleet("one") as (fleet, (one,)):
        arc, grant = await held(one, "first")
        leader, client = transport_of(fleet.leader()), transport_of(one.mesh)
        heard = [known for known in client.subscribers.all if known[0] == one.mesh.keys.grants]
        fleet.network.link(one.mesh, fleet.leader()).hidden = {*client.declarations()} - {*heard}
        fleet.network.link(fleet.leader(), one.mesh).hidden = {
            token for token in leader.declared if fleet.leader().keys.token_of(token).role == Role.RCM
        }
        leader.disconnected(client)
        client.disconnected(leader)
        await until(lambda: one.leader is None)
        await until(lambda: not fleet.rcs[0].holds.held, within=2.0)
        await until(lambda: arc.grant != grant, within=1.5)


async def test_an_answer_in_an_absurd_term_counts_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulator, seed 318605: after a forged term a client asked its leader only seconds after it had accepted it."""
    asked = 0

    async def counted(link: RcmLink, operation: Operation) -> Reply[Notice] | None:
        nonlocal asked
        asked += 1
        return await query(link, operation)

    query = RcmLink.query
    async with small_fleet("one") as (_, (one,)):
        arc, _ = await held(one, "first")
        monkeypatch.setattr(RcmLink, "query", counted)
        monkeypatch.setattr(rcm_link, "absurd", lambda *_, **__: True)
        one.internals.rcm._on_leader(Token("b", Role.RCM, "rcm", "forger"), alive=True)
        await until(lambda: asked >= 3, within=2.5)
        assert arc.open


async def test_what_was_granted_again_unheard_is_given_back_by_who_had_its_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All notices are lost while an RC is lost and well again: the client believes in its first grant, which ends."""
    monkeypatch.setattr(rcm_link, "ASK_AGAIN", 60.0)  # the answer would tell it of the second grant
    async with small_fleet("one") as (fleet, (one,)):
        body = asyncio.create_task(_hold_for(one, 5.0))
        await until(lambda: fleet.rcs[0].holds.held)
        fleet.network.disturb({"notice": Disturbance(lost=1.0)})
        await asyncio.sleep(4)
        fleet.rcs[0].fail("a cable is out")
        fleet.rcs[0].recover()
        await until(lambda: fleet.rcs[0].holds.held)
        await body
        fleet.network.disturb({})
        await asyncio.sleep(NOTICE_TIMEOUT + 0.5)
        assert not fleet.rcs[0].holds.held
        assert not (await fleet.state()).holds


async def _hold_for(client: Client, seconds: float) -> None:
    async with hold(client, "first", {RC: {}}, min_runtime=seconds, keep=False):
        await asyncio.sleep(2 * seconds)


@pytest.mark.parametrize("direct", [False, True])
async def test_who_can_confirm_and_not_command_joins_the_mesh_anew(direct: bool) -> None:
    """Links came back without the key of an RC's commands: its host confirms each grant, and nobody takes a command."""
    async with small_fleet("one") as (fleet, (one,)):
        await until(lambda: one.leader is not None)
        hidden: set[object] = {
            known for known in transport_of(fleet.devices).queryables.all if f"{RC}/command" in str(known)
        }
        assert hidden
        fleet.network.link(fleet.devices, one.mesh).hidden = hidden
        arc = await one.request("first", {RC: {}}, direct=direct)
        done: list[object] = []
        began = one.mesh.now()
        while not done and one.mesh.now() - began < 30 * SECOND:
            if (grant := await one.granted(arc)) is not None and not direct:
                with suppress(CommandRefused):
                    done.append((await one.command(RC, grant, ECHO)).result)
            elif grant is not None:
                # A direct hold lasts only while it is confirmed by command.
                await asyncio.sleep(2 * FLEET.timing.hold_lease / SECOND)
                done += [ECHO["value"]] if arc.grant == grant else []
        assert done == [ECHO["value"]]


async def test_commands_go_on_while_the_process_of_an_rc_joins_the_mesh_anew() -> None:
    """Until others know its new session, what they send arrives on the old one, which serves no more."""
    async with small_fleet("one") as (fleet, (one,)):
        _, grant = await held(one, "first")
        fleet.network.delay = 0.1  # of links that are made from now on
        renewable = fleet.devices._transport
        renewable.renew()
        done = 0
        while renewable._renewing is not None:
            assert (await one.command(RC, grant, ECHO)).result == ECHO["value"]
            done += 1
            await asyncio.sleep(0.01)
        assert done > 1


async def test_a_command_that_is_sent_again_has_what_is_left_of_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive command is not carried out for longer, or later, than it was meant."""
    async with small_fleet("one") as (_, (one,)):
        _, grant = await held(one, "first")
        sent = []

        async def ends_early(_key: str, command: Command, *_: object, **__: object) -> None:
            sent.append((one.mesh.now(), command))

        monkeypatch.setattr(one.mesh, "ask_one", ends_early)
        with pytest.raises(CommandRefused, match="no answer"):
            await one.command(RC, grant, ECHO, ttl=0.2)
        assert len(sent) > 1
        assert len({command.id for _, command in sent}) == 1
        ends = [at / SECOND + command.ttl for at, command in sent]
        assert ends == pytest.approx(ends[:1] * len(ends))


async def test_a_command_that_was_long_under_way_as_its_session_closed_is_sent_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """This client joined the mesh anew, and the RC was slow to answer."""
    async with small_fleet("one") as (_, (one,)):
        _, grant = await held(one, "first")
        ask_one, asked = one.mesh.ask_one, list[str]()

        async def closes_first(key: str, *args: Any, **kwargs: Any) -> Any:
            asked.append(key)
            if len(asked) == 1:
                await asyncio.sleep(REJOIN_TIMEOUT + 0.1)
                return None
            return await ask_one(key, *args, **kwargs)

        monkeypatch.setattr(one.mesh, "ask_one", closes_first)
        assert (await one.command(RC, grant, ECHO)).result == ECHO["value"]
        assert len(asked) == 2
