"""RCs on a mesh in memory, in virtual time, over a device that can be told to misbehave."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from decimal import Decimal
from types import MappingProxyType
from typing import Any, Final

from zscout.drivers.driver import Driver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import IncomingQuery, Mesh
from zscout.mesh.supervision import StallWatch
from zscout.messages import Amounts, Command, Done, Grants, Holder, HoldView, RcAsk, RcmState, RcState, StateAsk
from zscout.testing.memory import MemoryNetwork
from zscout.types import Grant, Place, Term

TERM = Term(3, "test")
LEASE = 3.0
ECHO: Final[Mapping[str, Any]] = MappingProxyType({"name": "echo", "value": 1})


class Device(Driver):
    """Keeps what is done to it."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.broken: set[str] = set()

    async def _do(self, name: str) -> None:
        self.calls.append(name)
        if name in self.broken:
            raise RuntimeError(f"{name} failed")

    async def begin(self, holder: Holder) -> None:
        await self._do(f"begin {holder.arc}")

    async def end(self, holder: Holder) -> None:
        await self._do(f"end {holder.arc}")

    async def safe(self) -> None:
        await self._do("safe")

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        if do["name"] == "slow":
            await asyncio.sleep(do["seconds"])
        await self._do(f"{do['name']} {do.get('value', '')}".strip())
        return do.get("value")


def holder(number: int, arc: str = "one", client: str = "h/client") -> Holder:
    return Holder(arc, arc, client, Grant(TERM, number), Place(TERM, number), ["robot/x"], Decimal(60), 60.0)


class Rcm:
    """What an RCM publishes and answers, to order. While `hangs` it answers nothing."""

    def __init__(self, network: MemoryNetwork) -> None:
        self.mesh = network.open("f", Sender("rcm", "node"))
        self.seq = 0
        self.hangs = False
        self.asked: list[IncomingQuery[StateAsk]] = []
        self.holds: list[HoldView] = []
        self._served = self.mesh.serve(self.mesh.keys.rcm_state, StateAsk, self._on_asked)
        self.token = self.mesh.alive(Token("rcm", Role.RCM, "node", TERM.rcm))
        self._publisher = self.mesh.publisher(self.mesh.keys.grants, Grants)

    def _on_asked(self, query: IncomingQuery[StateAsk]) -> None:
        self.asked.append(query)
        if not self.hangs:
            query.answer(RcmState(TERM, self.seq, "rcm", self.holds))

    def publish(self, *holders: Holder, rc: str = "robot/x") -> None:
        self.seq += 1
        self._publisher.put(Grants(term=TERM, seq=self.seq, prev=self.seq - 1, every=0.5, rcs={rc: list(holders)}))

    def view(self, number: int) -> HoldView:
        needs: dict[str, Amounts] = {"robot/x": {}}
        return HoldView("one", "one", "h/client", 0, Grant(TERM, number), Place(TERM, 1), needs, Decimal(60), 0, 60)


def grant(number: int) -> Grant:
    return Grant(TERM, number)


async def rc_state(mesh: Mesh) -> RcState:
    reply = await mesh.ask_one(mesh.keys.rc_state("robot/x"), RcAsk(), RcState, timeout=5)
    assert reply is not None
    assert reply.message is not None
    return reply.message


def states_published(mesh: Mesh) -> list[RcState]:
    """All that RCs publish from now on."""
    states: list[RcState] = []
    mesh.subscribe(mesh.keys.rc_state_any, RcState, lambda _key, state: states.append(state))
    return states


async def answer(mesh: Mesh, grant: Grant | None, do: Mapping[str, Any] = ECHO, *, ttl: float = 5.0) -> str:
    """`done`, the code of a refusal, or `unknown`."""
    command = Command(do=dict(do), grant=grant, ttl=ttl)
    reply = await mesh.ask_one(mesh.keys.command("robot/x", mesh.me), command, Done, timeout=60)
    if reply is None:
        return "unknown"
    return "done" if reply.problem is None else reply.problem.code


async def started(network: MemoryNetwork, driver: Driver, **how: Any) -> ResourceController:
    mesh = network.open("f", Sender("host", "node"))
    rc = ResourceController(mesh, "robot/x", driver, hold_lease=LEASE, stall=StallWatch(mesh.now).start(), **how)
    await rc.start()
    return rc


async def close(rc: ResourceController, *others: Mesh) -> None:
    await rc.stop()
    rc.stall.stop()
    for mesh in (rc.mesh, *others):
        await mesh.close()
