"""Components on the move between real nodes: with their state, their ARCs and their holds, or not at all."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Awaitable, Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.behaviors.components.kit import ComponentLab, Hosts, counts, counts_on, gone
from tests.hang import HANG
from tests.live.bench import until
from tests.live.placing import register
from zscout.behaviors.client.client import Client
from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import IncomingQuery
from zscout.messages import (
    MAX_CHECKPOINT,
    ActivateComponent,
    Checkpoint,
    CheckpointComponent,
    ComponentList,
    ComponentOperation,
    ComponentSpec,
    ComponentView,
    Grants,
    HowEnded,
    ListComponents,
    MoveComponent,
    Moved,
    Output,
    Phase,
    Problem,
    ReadOutput,
    RestoreComponent,
    StopComponent,
)

pytestmark = pytest.mark.live

QUICK: dict[str, Any] = {"period": 0.02}


async def went_on(hosts: Hosts, source: str, target: str) -> None:
    """Waits until all that was counted at the source has come out of there, and the target's next after that."""
    await hosts.ended(source, "c")
    old, new = await counts(hosts, source), await counts(hosts, target)
    assert new[0] == old[-1] + 1
    assert old == list(range(old[0], old[-1] + 1))


async def move(hosts: Hosts, source: str, target: str, incarnation: int, kind: str, params: dict[str, Any]) -> Moved:
    """Moves "c" as a placer does."""
    view = await hosts.start(target, "c", kind, params, incarnation=incarnation + 1, standby=True)
    assert view.phase == "standby", view
    order = MoveComponent("c", incarnation, target, incarnation + 1)
    moved = await hosts.get(source, order, Moved)
    assert (moved.component, moved.host, moved.incarnation) == ("c", target, incarnation + 1)
    # Asked again it tells the same.
    assert await hosts.get(source, order, Moved) == moved
    return moved


@pytest.mark.slow
async def test_a_component_without_arcs_moves_there_and_back_and_counts_on(lab: ComponentLab) -> None:
    lab.node("a")
    lab.node("b")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    first = await hosts.start("a", "c", "counter", QUICK)
    await lab.ready(client)
    await counts_on(hosts, "a")
    await move(hosts, "a", "b", 1, "counter", QUICK)
    await counts_on(hosts, "b")
    await went_on(hosts, "a", "b")
    left = await hosts.ended("a", "c")
    assert (left.ended, left.incarnation) == ("moved", 1)
    assert first.pid is not None
    await gone(first.pid)
    await move(hosts, "b", "a", 2, "counter", QUICK)
    await counts_on(hosts, "a")
    await went_on(hosts, "b", "a")
    whole = {"size": MAX_CHECKPOINT}
    await hosts.start("a", "d", "restless", whole)
    await hosts.start("b", "d", "restless", whole, incarnation=2, standby=True)
    await hosts.get("a", MoveComponent("d", 1, "b", 2), Moved)
    state = (await hosts.get("b", CheckpointComponent("d"), Checkpoint)).state
    assert len(state) == MAX_CHECKPOINT


@pytest.mark.essential
async def test_a_component_takes_its_hold_along_and_a_rival_gets_nothing(lab: ComponentLab) -> None:
    register(lab)
    lab.node("a")
    lab.node("b")
    lab.node("r", "robot/x", "robot/y")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    await lab.ready(client, "robot/x", "robot/y")
    params = QUICK | {"rc": "robot/x"}
    await hosts.start("a", "c", "tally", params)
    await counts_on(hosts, "a")
    rival = await client.request("rival", {"robot/x": {}}, min_runtime=1)
    said: list[Grants] = []
    client.mesh.subscribe(client.mesh.keys.grants, Grants, lambda _, grants: said.append(grants))
    for incarnation, (source, target) in enumerate(pairwise("aba"), 1):
        await move(hosts, source, target, incarnation, "tally", params)
        await counts_on(hosts, target)
        await went_on(hosts, source, target)
        assert "lost" not in (await hosts.get(target, ReadOutput("c"), Output)).text
        (holder,) = (await lab.rc(client, "robot/x")).holders
        assert (holder.arc, holder.client) == ("c", f"{target}/c.{incarnation + 1}")
    # Each hand-over was one publication, and there was no other word about who holds it.
    # All that is published comes to this client later than to the RC, and perhaps the first grant too.
    await until(lambda: sum(len(grants.revoked) for grants in said) >= 2)
    told = [[(one.arc, one.client) for one in grants.rcs["robot/x"]] for grants in said if grants.rcs]
    told = told[1:] if told[0] == [("c", "a/c.1")] else told
    assert told == [[("c", f"{host}/c.{number}")] for number, host in enumerate("ba", 2)]
    ends = [(one.outcome, one.client) for grants in said for one in grants.revoked]
    assert ends == [("handed_over", f"{host}/c.{number}") for number, host in enumerate("ab", 1)]
    assert rival.state == "queued"
    await hosts.stop("a", "c")
    await lab.held_by(client, "robot/x", "rival")


@pytest.mark.slow
async def test_what_waits_for_its_arc_moves_with_its_place(lab: ComponentLab) -> None:
    register(lab)
    lab.node("a")
    lab.node("b", "robot/x")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    await lab.ready(client, "robot/x")
    first = await client.request("first", {"robot/x": {}}, min_runtime=600)
    assert await client.granted(first) is not None
    params = {"rc": "robot/x"}
    await hosts.start("a", "c", "tally", QUICK | params)
    await lab.state(client, lambda state: [view.arc for view in state.queue] == ["c"])
    # It waits in `async with`, where it comes to no safe point.
    await hosts.start("b", "c", "tally", QUICK | params, incarnation=2, standby=True)
    assert await hosts.refused("a", MoveComponent("c", 1, "b", 2, patience=0.2)) == "not_safe"
    await client.end(first)
    await counts_on(hosts, "a")
    assert (await hosts.get("a", ListComponents("c"), ComponentList)).components[0].incarnation == 1
    moved = await hosts.get("a", MoveComponent("c", 1, "b", 2), Moved)
    assert moved.host == "b"
    await counts_on(hosts, "b")


@pytest.mark.slow
async def test_a_move_that_fails_before_the_commit_changes_nothing(tmp_path: Path) -> None:
    async with ComponentLab(tmp_path, candidates=["a"]) as lab:
        register(lab)
        lab.node("a", "robot/x")
        lab.node("b")
        client = await lab.client()
        hosts = Hosts(await lab.manager(client))
        await lab.ready(client, "robot/x")
        await hosts.start("a", "c", "tally", QUICK | {"rc": "robot/x"})
        await counts_on(hosts, "a")
        (holder,) = (await lab.rc(client, "robot/x")).holders

        async def fails(host: str, incarnation: int) -> str:
            problem = await hosts.ask("a", MoveComponent("c", 1, host, incarnation), Moved)
            assert isinstance(problem, Problem)
            assert problem.code == "move_failed"
            await counts_on(hosts, "a")
            return problem.message

        assert 'there is no component "c" on this host' in await fails("b", 2)
        await hosts.start("b", "c", "still", incarnation=2, standby=True)
        assert "no checkpoint() and restore()" in await fails("b", 2)
        await hosts.stop("b", "c")
        assert "it is ended on this host" in await fails("b", 2)
        await hosts.start("b", "c", "restless", {"broken": True}, incarnation=3, standby=True)
        assert "this state is rotten" in await fails("b", 3)
        assert (await hosts.ended("b", "c")).ended == "failed"
        await hosts.start("b", "c", "tally", QUICK | {"rc": "robot/x"}, incarnation=4, standby=True)
        lab.signal("b", signal.SIGKILL)
        assert "b did not answer" in await fails("b", 4)

        lost = [line for line in (await hosts.get("a", ReadOutput("c"), Output)).text.splitlines() if "lost" in line]
        assert lost == []
        numbers = await counts(hosts, "a")
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        assert (await lab.rc(client, "robot/x")).holders[0].grant == holder.grant


TALLY = {"period": 0.02, "rc": "robot/x"}


class Target:
    """Host "b", its node and its component "c", which stands by."""

    def __init__(self, node: Client, component: Client | None, incarnation: int) -> None:
        self.node, self.component, self.incarnation = node, component, incarnation
        self.activated = asyncio.Event()
        self.answer: Callable[[IncomingQuery[ComponentOperation]], None] = lambda _: None
        """To an activation."""
        self.at_last: Callable[[], Awaitable[None]] = self._nothing
        """What becomes of it then."""
        self.count = 0
        """To which the other had come."""
        mesh = node.mesh
        self.token = mesh.alive(Token("b", Role.NODE, "node", "x"))
        for key in mesh.keys.served_component("b"):
            mesh.serve(key, ComponentOperation, self._asked)

    @classmethod
    async def there(cls, fleet: Fleet, incarnation: int, *, component: bool = True) -> Target:
        node = await Client.connect("node", fleet=fleet, host="b")
        client = await Client.connect(f"c.{incarnation}", fleet=fleet, host="b") if component else None
        target, source = cls(node, client, incarnation), ("a", "c.1")
        clients = node.mesh.keys.alive_any(Role.CLIENT)
        linked = asyncio.Event()
        watch = node.mesh.watch(clients, lambda one, _: linked.set() if (one.host, one.name) == source else None)
        async with asyncio.timeout(HANG):  # it has a link to what is to move
            await linked.wait()
        watch.close()
        async with asyncio.timeout(HANG):  # the RCM sees its client
            while client is not None and await client.state() is None:
                pass
        return target

    def _asked(self, request: IncomingQuery[ComponentOperation]) -> None:
        match request.message:
            case RestoreComponent(requests=requests, state=state):
                self.count = json.loads(state)["count"]
                if self.component is not None:
                    self.component.internals.expect(requests)
                request.answer(self.view("standby"))
            case ActivateComponent():
                self.activated.set()
                self.answer(request)
                self._ends = asyncio.ensure_future(self.at_last())
            case StopComponent():
                request.answer(self.view("ended", "stopped"))

    def view(self, phase: Phase, ended: HowEnded | None = None) -> ComponentView:
        return ComponentView("c", self.incarnation, "b", ComponentSpec("counter"), phase, ended=ended)

    async def _nothing(self) -> None:
        pass

    async def gives_back(self) -> None:
        assert self.component is not None
        await self.component.close()

    async def leave(self) -> None:
        for client in (self.node, self.component):
            if client is not None:
                await client.internals.leave()


@pytest.mark.slow
async def test_who_handed_over_takes_back_what_the_new_one_does_not_take_on(lab: ComponentLab) -> None:
    register(lab)
    lab.node("a", "robot/x")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    await lab.ready(client, "robot/x")
    await hosts.start("a", "c", "tally", TALLY)
    await counts_on(hosts, "a")

    async def fails(target: Target) -> str:
        problem = await hosts.ask("a", MoveComponent("c", 1, "b", target.incarnation), Moved)
        assert isinstance(problem, Problem), problem
        assert problem.code == "move_failed"
        await counts_on(hosts, "a")
        numbers = await counts(hosts, "a")
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        (holder,) = (await lab.rc(client, "robot/x")).holders
        assert (holder.arc, holder.client) == ("c", "a/c.1")
        grants.append(holder.grant)
        await target.leave()
        return problem.message

    grants = [(await lab.rc(client, "robot/x")).holders[0].grant]
    # Refused at the commit: nothing has changed.
    target = await Target.there(lab.fleet_of("b"), 2, component=False)
    assert "refused the hand-over" in await fails(target)
    assert not target.activated.is_set()
    assert grants[1] == grants[0]

    failed = await Target.there(lab.fleet_of("b"), 3)
    failed.answer = lambda request: request.answer(failed.view("ended", "failed"))
    failed.at_last = failed.gives_back
    assert "submitted again here" in await fails(failed)
    unknown = await Target.there(lab.fleet_of("b"), 4)
    unknown.answer = lambda request: request.refuse(Problem("unknown_component", "what?"))
    unknown.at_last = unknown.gives_back
    assert "submitted again here" in await fails(unknown)
    # This one dies with all that it holds, and says nothing.
    silent = await Target.there(lab.fleet_of("b"), 5)
    silent.answer = lambda _: silent.token.close()
    silent.at_last = silent.leave
    assert "submitted again here" in await fails(silent)
    assert sorted(set(grants)) == grants[1:]


@pytest.mark.slow
async def test_who_handed_over_does_nothing_until_it_is_known_that_the_new_one_runs(lab: ComponentLab) -> None:
    register(lab)
    lab.node("a", "robot/x")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    await lab.ready(client, "robot/x")
    await hosts.start("a", "c", "tally", TALLY)
    await counts_on(hosts, "a")
    target = await Target.there(lab.fleet_of("b"), 2)
    answers: list[ComponentView | None] = [target.view("running"), target.view("standby"), None]
    moving = asyncio.create_task(hosts.get("a", MoveComponent("c", 1, "b", 2), Moved))

    def answer(request: IncomingQuery[ComponentOperation]) -> None:
        # At first none, then one that says: not yet.
        view = answers.pop()
        if view is not None:
            request.answer(view)

    target.answer = answer
    await target.activated.wait()
    async with asyncio.timeout(HANG):  # the RC may hear of it later
        while [one.client for one in (await lab.rc(client, "robot/x")).holders] != ["b/c.2"]:
            pass
    moved = await moving
    assert answers == []
    assert (await hosts.ended("a", "c")).ended == "moved"
    # When it has ended all that it wrote is read: it has not counted on.
    assert (await counts(hosts, "a"))[-1] == target.count
    assert moved.dead > 0
    # It gave up nothing when it left.
    (holder,) = (await lab.rc(client, "robot/x")).holders
    assert holder.client == "b/c.2"
    await target.leave()
