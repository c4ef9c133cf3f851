"""A component that has handed over, and whose successor does not go on: the test plays that one's host."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable

import pytest

from tests.behaviors.components.kit import ComponentLab, Hosts, counts, counts_on
from tests.hang import HANG
from tests.live.placing import register
from zscout.behaviors.client.client import Client
from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import IncomingQuery
from zscout.messages import (
    ActivateComponent,
    ComponentOperation,
    ComponentSpec,
    ComponentView,
    HowEnded,
    MoveComponent,
    Moved,
    Phase,
    Problem,
    RestoreComponent,
    StopComponent,
)

pytestmark = pytest.mark.live

QUICK = {"period": 0.02, "rc": "robot/x"}


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
        mesh.serve(mesh.keys.component("b", mesh.me), ComponentOperation, self._asked)

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
                    self.component.expect(requests)
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
                await client.leave()


@pytest.mark.slow
async def test_who_handed_over_takes_back_what_the_new_one_does_not_take_on(lab: ComponentLab) -> None:
    register(lab)
    lab.node("a", "robot/x")
    client = await lab.client()
    hosts = Hosts(client)
    await lab.ready(client, "robot/x")
    await hosts.start("a", "c", "tally", QUICK)
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
    target = await Target.there(lab.fleet, 2, component=False)
    assert "refused the hand-over" in await fails(target)
    assert not target.activated.is_set()
    assert grants[1] == grants[0]

    failed = await Target.there(lab.fleet, 3)
    failed.answer = lambda request: request.answer(failed.view("ended", "failed"))
    failed.at_last = failed.gives_back
    assert "asked anew here" in await fails(failed)
    unknown = await Target.there(lab.fleet, 4)
    unknown.answer = lambda request: request.refuse(Problem("unknown_component", "what?"))
    unknown.at_last = unknown.gives_back
    assert "asked anew here" in await fails(unknown)
    # This one dies with all that it holds, and says nothing.
    silent = await Target.there(lab.fleet, 5)
    silent.answer = lambda _: silent.token.close()
    silent.at_last = silent.leave
    assert "asked anew here" in await fails(silent)
    assert sorted(set(grants)) == grants[1:]


async def test_who_handed_over_does_nothing_until_it_is_known_that_the_new_one_runs(lab: ComponentLab) -> None:
    register(lab)
    lab.node("a", "robot/x")
    client = await lab.client()
    hosts = Hosts(client)
    await lab.ready(client, "robot/x")
    await hosts.start("a", "c", "tally", QUICK)
    await counts_on(hosts, "a")
    target = await Target.there(lab.fleet, 2)
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
