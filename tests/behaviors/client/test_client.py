"""A client with an RCM and RCs on a mesh in memory, in virtual time: from a request to its end."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from tests.mesh.kit import run, until
from zscout.behaviors.client.arc import Revoked, hold, holds
from zscout.behaviors.client.client import CONFIRM_TIMEOUT, Client, CommandRefused, RequestRefused
from zscout.behaviors.client.request import OpenArc
from zscout.behaviors.components.component import ComponentContext, SafePointGate
from zscout.behaviors.components.shipped import Counter
from zscout.config.fleet import default_fleet
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Role, Sender, Token
from zscout.lab.faults.memory import Disturbance, MemoryMesh, MemoryNetwork, MemoryTransport
from zscout.lab.faults.virtual_time import START
from zscout.mesh import Declaration, IncomingQuery, ZenohMesh
from zscout.mesh.supervision import StallWatch
from zscout.messages import Ask, Grants, Notice
from zscout.scheduling.model import HOLD_BACK
from zscout.services.rcm import request_handler
from zscout.services.rcm.candidate import Candidate
from zscout.types import SECOND, Place, Term

RC, OTHER = "robot/x", "robot/y"
ECHO = {"name": "echo", "value": 7}
FLEET = default_fleet()


class SmallFleet:
    """Candidates, RC and OTHER on a host of their own, and clients, each with its place on one network."""

    def __init__(self) -> None:
        self.network = MemoryNetwork(lease=FLEET.mesh.lease)
        self.candidates: dict[str, Candidate] = {}
        self.clients: list[Client] = []
        self.devices = self.mesh("devices", "node")
        self.stall = StallWatch(self.devices.now).start()
        self.rcs = [
            ResourceController(
                self.devices, name, ExclusiveDriver(), hold_lease=FLEET.timing.hold_lease / SECOND, stall=self.stall
            )
            for name in (RC, OTHER)
        ]

    def mesh(self, host: str, name: str) -> MemoryMesh:
        return self.network.open(FLEET.name, Sender(host, name))

    def candidate(self, host: str) -> Candidate:
        candidate = self.candidates[host] = Candidate(self.mesh(host, "node"), FLEET)
        candidate.start()
        return candidate

    def client(self, name: str) -> Client:
        client = Client(self.mesh("h", name), FLEET).start()
        self.clients.append(client)
        return client

    def leader(self) -> MemoryMesh:
        (leader,) = [one.mesh for one in self.candidates.values() if one.rcm is not None]
        assert isinstance(leader, MemoryMesh)
        return leader

    async def holders(self, rc: str = RC) -> list[str]:
        state = await self.clients[0].state()
        assert state is not None
        return [view.arc for view in state.holds if rc in view.needs]


@asynccontextmanager
async def small_fleet(*clients: str) -> AsyncIterator[tuple[SmallFleet, list[Client]]]:
    fleet = SmallFleet()
    for rc in fleet.rcs:
        await rc.start()
    fleet.candidate("h0")
    made = [fleet.client(name) for name in clients]
    await until(lambda: made[0].leader == "h0")
    try:
        yield fleet, made
    finally:
        for client in fleet.clients:
            await client.close()
        for candidate in fleet.candidates.values():
            await candidate.stop()
        for rc in fleet.rcs:
            await rc.stop()
        fleet.stall.stop()


def test_a_request_is_granted_obeyed_and_given_back() -> None:
    async def test() -> None:
        async with small_fleet("one", "two") as (_, (one, two)):
            async with hold(one, "first", {RC: {}}, min_runtime=60) as held:
                assert (await held.command(RC, ECHO)).result == 7
                waits = await two.request("second", {RC: {}}, min_runtime=60)
                assert (waits.state, waits.ahead) == ("queued", 0)
            grant = await two.granted(waits)
            assert grant is not None
            with pytest.raises(CommandRefused) as refused:
                await held.command(RC, ECHO)
            assert refused.value.code == "ended"

    run(test())


def test_a_hold_ends_after_its_minimum_runtime_without_an_error() -> None:
    async def test() -> None:
        async with small_fleet("one") as (fleet, (one,)):
            began = one.mesh.now()
            async with hold(one, "first", {RC: {}}, min_runtime=5):
                await asyncio.sleep(3600)
            assert 5 <= (one.mesh.now() - began) / SECOND < 5.1
            assert await fleet.holders() == []

    run(test())


def test_a_timer_that_goes_off_early_ends_a_hold_without_an_error() -> None:
    # A loop's timers may be counted in ms, and on another clock than the host's.
    async def test() -> None:
        async with small_fleet("one") as (fleet, _):
            mesh, loop = fleet.mesh("h", "slow"), asyncio.get_running_loop()
            mesh.now = lambda: round((START + (loop.time() - START) * 0.999) * SECOND)
            slow = Client(mesh, FLEET).start()
            fleet.clients.append(slow)
            async with hold(slow, "first", {RC: {}}, min_runtime=2) as held:
                fleet.network.link(fleet.leader(), mesh).loss = 1.0  # it does not hear that its hold is over
                await asyncio.sleep(3600)
            assert held.completed

    run(test())


def test_who_is_preempted_goes_on_when_it_is_granted_again() -> None:
    async def test() -> None:
        async with small_fleet("low", "high") as (_, (low, high)):
            entered: list[str] = []

            async def work() -> None:
                async for attempt in holds(low, "low", {RC: {}}, min_runtime=60):
                    async with attempt:
                        entered.append("in")
                        await asyncio.sleep(3600)

            working = asyncio.create_task(work())
            await until(lambda: entered)
            async with hold(high, "high", {RC: {}}, priority=5, min_runtime=1):
                await asyncio.sleep(0.5)
                assert entered == ["in"]
            await working
            assert entered == ["in", "in"]

    run(test())


def test_one_entry_that_is_preempted_raises() -> None:
    async def test() -> None:
        async with small_fleet("low", "high") as (_, (low, high)):
            entered = asyncio.Event()

            async def work() -> None:
                async with hold(low, "low", {RC: {}}, min_runtime=60):
                    entered.set()
                    await asyncio.sleep(3600)

            working = asyncio.ensure_future(work())
            await entered.wait()
            taker = await high.request("high", {RC: {}}, priority=5, min_runtime=60)
            with pytest.raises(Revoked) as revoked:
                await working
            assert (revoked.value.outcome, revoked.value.by) == ("preempted", f"h/high/{taker.id}")

    run(test())


def test_a_bad_request_is_refused_and_forgotten() -> None:
    async def test() -> None:
        async with small_fleet("one") as (_, (one,)):
            with pytest.raises(RequestRefused) as refused:
                await one.request("bad", {RC: {}}, priority=10**9)
            assert refused.value.code == "bad_request"
            assert one.open_requests() == []

    run(test())


def test_a_queued_request_that_the_next_leader_refuses_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        async with small_fleet("one", "two") as (fleet, (one, two)):
            fleet.candidate("h1")
            await one.granted(await one.request("first", {RC: {}}, priority=5, min_runtime=600))
            waits = await two.request("second", {RC: {}}, priority=5, min_runtime=600)
            monkeypatch.setattr(request_handler, "MAX_PRIORITY", 4)
            fleet.network.kill(fleet.leader())
            del fleet.candidates["h0"]
            # The new leader does not hear of it while it takes the lead.
            link = fleet.network.link(two.mesh, fleet.candidates["h1"].mesh)
            link.loss = 1.0
            await until(lambda: one.leader == "h1")
            await asyncio.sleep(1)
            link.loss = 0.0
            await until(lambda: waits.state == "ended", within=20)
            assert waits.outcome == "lost"
            assert waits.reason == "the RCM refuses it: priority must lie between -4 and 4"
            assert await two.granted(waits) is None
            assert two.open_requests() == []

    run(test())


def test_holds_and_places_outlive_a_change_of_leader() -> None:
    async def test() -> None:
        async with small_fleet("one", "two", "three") as (fleet, (one, two, three)):
            fleet.candidate("h1")
            async with hold(one, "first", {RC: {}}, min_runtime=60) as held:
                waits = [await client.request("next", {RC: {}}, min_runtime=60) for client in (two, three)]
                places, term = [arc.place for arc in waits], one.term
                fleet.network.kill(fleet.leader())
                del fleet.candidates["h0"]
                await until(lambda: one.leader == "h1" and all(c.term > term for c in (one, two, three)))
                assert held.active
                assert (await held.command(RC, ECHO)).result == 7
                # Each asks again, and keeps its place.
                await asyncio.sleep(7)
                assert [(arc.state, arc.place) for arc in waits] == [("queued", place) for place in places]
            assert await two.granted(waits[0]) is not None

    run(test())


def test_without_an_rcm_a_hold_ends_after_its_lease_and_is_asked_again() -> None:
    async def test() -> None:
        async with small_fleet("one") as (fleet, (one,)):
            arc = await one.request("first", {RC: {}}, min_runtime=600)
            assert await one.granted(arc) is not None
            await fleet.candidates.pop("h0").stop()
            await until(lambda: arc.state == "asking", within=FLEET.timing.hold_lease / SECOND + 1)
            assert arc.ending is not None
            assert arc.ending.outcome == "lost"
            fleet.candidate("h1")
            assert await one.granted(arc) is not None

    run(test())


def test_a_hold_is_over_when_its_rc_says_so_though_no_notice_does() -> None:
    async def test() -> None:
        async with small_fleet("one", "two") as (fleet, (one, two)):
            arc = await one.request("first", {RC: {}}, min_runtime=600)
            grant = await one.granted(arc)
            assert grant is not None
            fleet.network.disturb({"notice": Disturbance(lost=1.0)})
            await two.granted(await two.request("operator", {RC: {}}, priority=9, min_runtime=600))
            with pytest.raises(CommandRefused, match="is over"):
                await one.command(RC, grant, ECHO)
            await until(lambda: arc.grant is None, within=1.5)
            await until(lambda: arc.state == "queued", within=1.0)

    run(test())


def test_an_rcm_far_above_is_followed_once_no_other_is_heard() -> None:
    """As where the fleet had to go above a forged term while this client was cut off."""

    async def test() -> None:
        async with small_fleet("one") as (fleet, (one,)):
            await until(lambda: one.term.counter)
            await fleet.candidates.pop("h0").stop()
            candidate = fleet.candidates["h1"] = Candidate(fleet.mesh("h1", "node"), FLEET)
            candidate.known = far = Term(10**9, "far")
            candidate.start()
            await until(lambda: one.term > far, within=FLEET.timing.hold_lease / SECOND + 3)
            arc = await one.request("first", {RC: {}}, min_runtime=600)
            assert await one.granted(arc) is not None

    run(test())


def test_all_goes_on_in_another_client_though_its_rc_hears_of_it_late() -> None:
    """What a component's move rests on: nobody of equal priority gets in between."""

    async def test() -> None:
        async with small_fleet("old", "new", "rival") as (fleet, (old, new, rival)):
            arc = await old.request("tally", {RC: {}}, min_runtime=3600)
            await old.granted(arc)
            waits = await rival.request("rival", {RC: {}}, min_runtime=1)
            holders: list[str] = []
            states: list[str] = [waits.state]
            rival.watch(lambda arc: states.append(arc.state))
            rival.mesh.subscribe(
                rival.mesh.keys.grants,
                Grants,
                lambda _, grants: holders.extend(holder.arc for holder in grants.rcs.get(RC, [])),
            )
            fleet.network.link(fleet.leader(), fleet.devices).delay = 0.05
            for source, target in [(old, new), (new, old)] * 3:
                source.pause()
                target.expect(source.open_requests())
                await source.hand_over_all(target.mesh.me)
                moved = await target.request("tally", {RC: {}}, min_runtime=3600)
                grant = await target.granted(moved)
                assert grant is not None
                assert (await target.command(RC, grant, ECHO)).result == 7
                source.resume()
            await asyncio.sleep(10)
            assert (set(states), set(holders)) == ({"queued"}, {"tally"})

    run(test())


def test_a_hand_over_that_dies_with_the_leader_once_it_is_answered_is_made_again() -> None:
    """A process that is killed takes along what it has sent and its links have not carried yet."""

    async def test() -> None:
        async with small_fleet("old", "new") as (fleet, (old, new)):
            runs = await old.request("runs", {RC: {}}, min_runtime=3600)
            grant = await old.granted(runs)
            waits = await old.request("waits", {RC: {}}, min_runtime=3600)
            next_leader = fleet.candidate("h1")
            await asyncio.sleep(2)
            before = {arc.id: arc.place for arc in (runs, waits)}
            old.pause()
            new.expect(old.open_requests())
            leader = fleet.leader()
            for other in (fleet.devices, next_leader.mesh, new.mesh):
                fleet.network.link(leader, other).loss = 1.0
            answers: list[str] = []
            fleet.network.link(leader, old.mesh).trace = lambda _source, _target, kind, _: answers.append(kind)
            moving = asyncio.create_task(old.hand_over_all(new.mesh.me))
            await until(lambda: "reply" in answers)
            fleet.network.kill(leader)
            await fleet.candidates.pop("h0").stop()
            await moving
            after = [await new.request(name, {RC: {}}, min_runtime=3600) for name in ("runs", "waits")]
            assert {arc.id: arc.place for arc in after} == before
            granted = await new.granted(after[0])
            assert granted is not None
            assert grant is not None
            assert granted > grant
            assert (await new.command(RC, granted, ECHO)).result == 7
            assert after[1].state == "queued"

    run(test())


@pytest.mark.parametrize("cut", [0.9, 1.5, 8.0])
def test_a_client_that_sees_its_rc_anew_is_granted_at_once(cut: float) -> None:
    """Not when what was held back longer each time is over: nobody else was cut off."""

    async def test() -> None:
        async with small_fleet("one") as (fleet, (one,)):
            network, (client, rc) = fleet.network, (one.mesh, fleet.devices)
            for source, target in ((client, rc), (rc, client)):
                network.cut(source, target)
            arc = await one.request("first", {RC: {}}, min_runtime=600)
            granting = asyncio.create_task(one.granted(arc))
            await asyncio.sleep(cut)
            assert not granting.done()
            network.heal()
            await asyncio.wait_for(granting, 0.3 if cut > CONFIRM_TIMEOUT else HOLD_BACK / SECOND)

    run(test())


def test_what_lost_its_rcm_as_it_is_handed_over_is_handed_over_all_the_same() -> None:
    """For the hold lease: that ends the hold, and its ARC is asked for again, by whoever has it."""

    async def test() -> None:
        async with small_fleet("old", "new") as (fleet, (old, new)):
            arc = await old.request("runs", {RC: {}}, min_runtime=3600)
            await old.granted(arc)
            old.pause()
            new.expect(old.open_requests())
            before, link = (arc.id, arc.place), fleet.network.link(fleet.leader(), old.mesh)
            link.loss = 1.0
            await until(lambda: arc.state == "asking")
            link.loss = 0.0
            await old.hand_over_all(new.mesh.me)
            after = await new.request("runs", {RC: {}}, min_runtime=3600)
            assert (after.id, after.place) == before

    run(test())


def test_what_was_given_up_unheard_is_withdrawn_once_an_rcm_answers() -> None:
    async def test() -> None:
        async with small_fleet("one", "two") as (fleet, (one, two)):
            arc = await one.request("first", {RC: {}}, min_runtime=600, keep=True)
            await one.granted(arc)
            waits = await two.request("second", {RC: {}}, min_runtime=600)
            link = fleet.network.link(one.mesh, fleet.leader())
            link.loss = 1.0
            await one.end(arc)
            link.loss = 0.0
            assert await fleet.holders() == ["first"]
            await until(lambda: waits.state == "running", within=7)

    run(test())


@asynccontextmanager
async def granted_unheard() -> AsyncIterator[tuple[SmallFleet, Client, OpenArc, list[Declaration]]]:
    """A client that is told of its grant only when it asks, and another RCM, of an older term, whose token it sees."""
    async with small_fleet("one", "two") as (fleet, (one, two)):
        mesh, old = fleet.mesh("old", "node"), Term(0, "old")

        def answer(asked: IncomingQuery[Ask]) -> None:
            asked.answer(Notice(asked.message.id, "second", "h/two", "queued", term=old, step=1, place=Place(old, 1)))

        declared = [mesh.serve(mesh.keys.schedule_any, Ask, answer), mesh.alive(Token("old", Role.RCM, "node", "old"))]
        first = await one.request("first", {RC: {}}, min_runtime=600, keep=True)
        waits = await two.request("second", {RC: {}}, min_runtime=600)
        await asyncio.sleep(0.5)
        fleet.network.disturb({"notice": Disturbance(lost=1.0)})
        await one.end(first)
        assert (await fleet.holders(), waits.state) == (["second"], "queued")
        yield fleet, two, waits, declared


def test_when_one_of_two_rcms_goes_the_other_is_asked_at_once() -> None:
    """Its answer may have come second, and nobody read it."""

    async def test() -> None:
        async with granted_unheard() as (_, _, waits, old):
            for one in old:
                one.close()
            await until(lambda: waits.state == "running", within=0.1)

    run(test())


def test_what_changes_while_all_is_asked_for_again_has_it_asked_once_more() -> None:
    async def test() -> None:
        async with small_fleet("one", "two") as (fleet, (one, two)):
            first = await one.request("first", {RC: {}}, min_runtime=600, keep=True)
            waits = await two.request("second", {RC: {}}, min_runtime=600)
            await asyncio.sleep(0.5)
            fleet.network.disturb({"notice": Disturbance(lost=1.0)})
            fleet.network.link(fleet.leader(), two.mesh).delay = 0.5
            token = fleet.mesh("other", "node").alive(Token("other", Role.RCM, "node", "other"))
            await asyncio.sleep(0.1)  # the question is answered, and the answer on its way
            await one.end(first)
            token.close()
            await until(lambda: waits.state == "running", within=1.5)

    run(test())


def test_the_answer_of_an_rcm_that_has_been_replaced_is_none() -> None:
    async def test() -> None:
        async with granted_unheard() as (fleet, two, waits, _):
            answers = fleet.network.link(fleet.leader(), two.mesh)
            answers.loss = 1.0
            fleet.mesh("third", "node").alive(Token("third", Role.RCM, "node", "third"))
            await asyncio.sleep(0.5)
            answers.loss = 0.0
            await until(lambda: waits.state == "running", within=1.3)

    run(test())


def test_what_had_its_time_before_its_client_heard_of_it_is_asked_for_anew_at_its_place() -> None:
    async def test() -> None:
        async with small_fleet("one", "two") as (fleet, (one, two)):
            first = await one.request("first", {RC: {}}, min_runtime=600, keep=True)
            waits = await two.request("second", {RC: {}}, min_runtime=0.5)
            known_as, place = waits.id, waits.place
            fleet.network.disturb({"notice": Disturbance(lost=1.0)})
            await one.end(first)
            assert await fleet.holders() == ["second"]
            await asyncio.sleep(1)
            fleet.network.disturb({})
            assert waits.state == "queued"
            assert await two.granted(waits) is not None
            assert (waits.id != known_as, waits.place) == (True, place)

    run(test())


def test_a_request_that_is_cancelled_before_its_answer_is_withdrawn() -> None:
    async def test() -> None:
        async with small_fleet("one") as (fleet, (one,)):
            fleet.network.link(fleet.leader(), one.mesh).delay = 0.2
            asking = asyncio.create_task(one.request("first", {RC: {}}, min_runtime=600, keep=True))
            await asyncio.sleep(0.1)
            assert granted(fleet) == ["first"]
            asking.cancel()
            await asyncio.gather(asking, return_exceptions=True)
            await asyncio.sleep(1)
            assert granted(fleet) == []

    def granted(fleet: SmallFleet) -> list[str]:
        (candidate,) = fleet.candidates.values()
        assert candidate.rcm is not None
        return [arc.name for arc in candidate.rcm.core.holders(RC)]

    run(test())


def test_a_client_that_is_cancelled_while_it_leaves_leaves_all_the_same() -> None:
    async def test() -> None:
        async with small_fleet("watch", "one") as (fleet, (_, one)):
            arc = await one.request("first", {RC: {}}, min_runtime=600, keep=True)
            await one.granted(arc)
            closed: list[bool] = []
            close = one.mesh.close

            async def closing() -> None:
                await close()
                closed.append(True)

            one.mesh.close = closing  # type: ignore[method-assign]
            fleet.network.link(one.mesh, fleet.leader()).loss = 1.0
            leaving = asyncio.create_task(one.close())
            await asyncio.sleep(0.1)
            leaving.cancel()
            await asyncio.gather(leaving, return_exceptions=True)
            await until(lambda: closed, within=1)
            await asyncio.sleep(FLEET.mesh.lease)
            assert await fleet.holders() == []

    run(test())


def test_a_client_whose_own_work_fails_ends_its_holds_and_leaves() -> None:
    async def test() -> None:
        async with small_fleet("watch", "one") as (fleet, (_, one)):

            async def broken(_arc: OpenArc) -> None:
                raise RuntimeError("broken")

            async def work() -> None:
                async with hold(one, "first", {RC: {}}, min_runtime=600):
                    one._rcm.ask = broken  # type: ignore[method-assign, assignment]
                    await asyncio.sleep(3600)

            with pytest.raises(Revoked, match="this client failed: RuntimeError"):
                await work()
            await asyncio.sleep(FLEET.mesh.lease)
            assert await fleet.holders() == []

    run(test())


def test_connecting_can_be_awaited_entered_and_run_as_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        async with small_fleet("watch") as (fleet, _):

            async def opened(name: str, me: Sender, *_: object) -> MemoryMesh:
                return fleet.network.open(name, me)

            monkeypatch.setattr(ZenohMesh, "open", opened)
            async with Client.connect("entered", fleet=FLEET, host="h") as entered:
                await until(lambda: entered.leader == "h0")
            awaited = await Client.connect("awaited", fleet=FLEET, host="h")
            task = await asyncio.create_task(Client.connect("task", fleet=FLEET, host="h"))
            async with awaited, task:
                assert [client.mesh.me.client for client in (awaited, task)] == ["awaited", "task"]

    run(test())


def test_a_client_that_hears_no_publication_of_an_rcm_that_answers_joins_the_mesh_anew(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def test() -> None:
        async with small_fleet("one") as (fleet, (one,)):
            await one.request("absent", {"robot/z": {}}, min_runtime=60)
            await asyncio.sleep(60)
            assert not caplog.records
            before = one.mesh._transport.id()
            fleet.network.disturb({"grants": Disturbance(lost=1.0)})
            await until(lambda: one.mesh._transport.id() != before)
            fleet.network.disturb({})

    with caplog.at_level(logging.WARNING, "zscout.mesh"):
        run(test())
    said = {record.message.partition(": this process")[0] for record in caplog.records}
    assert "an RCM answers that does not publish" in said


@pytest.mark.parametrize("at_once", [False, True])
def test_a_counter_keeps_its_hold_where_a_command_is_not_answered(
    monkeypatch: pytest.MonkeyPatch, at_once: bool
) -> None:
    """Be it that no answer comes for two seconds, or none at once, as where there is no link."""

    async def nobody(*_: object, **__: object) -> None: ...

    async def test() -> None:
        async with small_fleet("one") as (fleet, (one,)):
            counter = Counter({"rc": RC})
            counting = asyncio.create_task(counter.run(ComponentContext(one, "count", 1, SafePointGate())))
            await until(lambda: counter.count == 3)
            before = [arc.grant for arc in one._store.open]
            with monkeypatch.context() as patch:
                if at_once:
                    patch.setattr(one.mesh, "ask_one", nobody)
                else:
                    fleet.network.disturb({"command": Disturbance(lost=1.0)})
                await asyncio.sleep(5)
            fleet.network.disturb({})
            assert counter.count == 3
            await until(lambda: counter.count == 6)
            assert [arc.grant for arc in one._store.open] == before
            counting.cancel()

    run(test())


def test_a_leader_that_is_asked_by_whom_it_does_not_see_joins_the_mesh_anew() -> None:
    """Links came back without its token, its subscription of notices and its `requests`: only what it asks arrives."""

    async def test() -> None:
        async with small_fleet("one", "two") as (fleet, (one, _)):
            arc = await one.request("first", {RC: {}}, min_runtime=600)
            await one.granted(arc)
            leader, asking = fleet.leader(), one.mesh
            assert isinstance(asking, MemoryMesh)
            before, client = leader._transport.current, asking._transport.current
            assert isinstance(before, MemoryTransport)
            assert isinstance(client, MemoryTransport)
            fleet.network.link(one.mesh, leader).hidden = {*client.declarations()}
            before.disconnected(client)
            await until(lambda: leader._transport.current is not before)
            await asyncio.sleep(FLEET.mesh.lease + 1)
            outcomes: list[str | None] = []
            one.watch(lambda arc: outcomes.append(arc.outcome))
            await asyncio.sleep(10)
            assert arc.state == "running"
            assert "client_lost" not in outcomes

    run(test())
