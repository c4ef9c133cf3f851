"""What a command that has just joined knows of its fleet, and how soon: in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from tests.mesh.kit import run, until
from tests.services.rcm.kit import FakeFleet
from zscout.behaviors.client.client import Client
from zscout.cli.fleet.fleet_view import QUIET_S, Devices, FleetView
from zscout.keyexpr import Keys, Role, Sender, Token
from zscout.mesh import Reply
from zscout.messages import HostRanking, LoadReport, RankAsk, RcAsk, RcState
from zscout.services.placement.load_balancer import READ_EVERY, LoadBalancer
from zscout.types import SECOND

SOON = 0.1
"""Seconds in which some questions are answered, and no load report comes."""


def report(fleet: FakeFleet, host: str, load: float) -> list[object]:
    """A host that is there for as long as what this returns, and publishes its load once."""
    mesh = fleet.mesh(host)
    there = [mesh.alive(Token(host, role, str(role), "i1")) for role in (Role.NODE, Role.LOAD)]
    mesh.put(mesh.keys.load(host), LoadReport(host, 1, 4, (load, load, load), 0.0, 10**9, 10**10))
    return [mesh, *there]


@asynccontextmanager
async def looking(fleet: FakeFleet) -> AsyncIterator[FleetView]:
    async with Client.on(fleet.mesh("here", "status-1"), fleet.fleet) as client:
        with FleetView(client) as view:
            yield view


@asynccontextmanager
async def led(*candidates: str) -> AsyncIterator[FakeFleet]:
    """A fleet that `candidates[0]` leads, and that knows the loads of two hosts."""
    fleet = FakeFleet(*candidates)
    leading = fleet.candidate(candidates[0])
    await until(lambda: leading.rcm)
    there = [report(fleet, "anvil", 1.5), report(fleet, "bellows", 0.5)]
    await asyncio.sleep(2 * READ_EVERY)
    yield fleet
    await leading.stop()
    there.clear()


def test_loads_come_from_the_balancer_and_are_not_waited_for() -> None:
    async def story() -> None:
        async with led("x") as fleet, looking(fleet) as view:
            await asyncio.sleep(1.0)
            began = view.mesh.now()
            await view.settled()
            assert (view.mesh.now() - began) / SECOND < SOON
            loads = {name: host.load.load_average[0] for name, host in view.hosts.items() if host.load is not None}
            assert loads == {"anvil": 1.5, "bellows": 0.5}
            age = (view.mesh.now() - view.hosts["anvil"].reported) / SECOND
            assert 1.0 <= age <= 1.0 + 3 * READ_EVERY, "as old as they were there"

    run(story())


def test_a_balancer_of_a_former_version_tells_none_and_they_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story() -> None:
        async with led("x") as fleet, looking(fleet) as view:
            settling = asyncio.ensure_future(view.settled())
            await asyncio.sleep(0.5)
            assert not settling.done()
            for host in ("anvil", "bellows"):
                fleet.watcher.put(
                    fleet.watcher.keys.load(host), LoadReport(host, 2, 4, (2.0, 2.0, 2.0), 0.0, 10**9, 10**10)
                )
            await asyncio.sleep(SOON)
            assert settling.done()
            assert all(host.load is not None for host in view.hosts.values() if host.has(Role.LOAD))

    def answered(_: LoadBalancer, query: object) -> None:
        query.answer(HostRanking([], "composite", "as asked"))  # type: ignore[attr-defined]

    assert RankAsk().reports is False
    monkeypatch.setattr(LoadBalancer, "_on_query", answered)
    run(story())


def test_a_candidate_that_is_not_there_is_not_waited_for_long() -> None:
    async def story() -> None:
        async with led("x", "nowhere") as fleet, looking(fleet) as view:
            began = view.mesh.now()
            await view.settled()
            assert QUIET_S <= (view.mesh.now() - began) / SECOND < QUIET_S + SOON
            assert not view.all_hosts()["nowhere"].tokens

    run(story())


class SlowNode:
    """A secured mesh on which one node has many RCs and answers one question after the other."""

    keys, me = Keys("test", closed=True), Sender("here", "status-1")

    def __init__(self, rcs: list[str]) -> None:
        self.tokens_of = {Role.RC: [Token("anvil", Role.RC, rc, "i1") for rc in rcs]}
        self.mesh, self._turn = self, asyncio.Lock()

    def tokens(self, role: str) -> list[Token]:
        return self.tokens_of[role]

    def subscribe(self, *_: object) -> None: ...

    async def ask_one(self, key: str, _: RcAsk, __: type, *, timeout: float) -> Reply[RcState] | None:
        try:
            async with asyncio.timeout(timeout), self._turn:
                await asyncio.sleep(0.002)
                return Reply(key, RcState(self.keys.rc_of(key), "anvil", "i1", False))
        except TimeoutError:
            return None


def test_each_of_many_devices_of_a_secured_node_tells_its_state() -> None:
    """All asked at once, most would be answered too late."""

    async def story() -> None:
        rcs = [f"robot/r{number}" for number in range(1_000)]
        devices = Devices(SlowNode(rcs))  # type: ignore[arg-type]
        await devices.ask()
        assert devices.known().keys() == set(rcs)

    run(story())
