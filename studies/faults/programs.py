"""The programs of a simulated fleet: they request random devices, and command the devices that they hold."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from contextvars import Context
from dataclasses import dataclass
from typing import Any, Final

from msgspec.structs import replace

from studies.faults.device import Device
from zscout.behaviors.client.arc import Held, Revoked, hold, holds
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.client.direct import DirectHold
from zscout.keyexpr import RANDOM, Role, Token, new_instance
from zscout.mesh import Mesh
from zscout.messages import Ask, ClientRequests, Notice, OpenRequest, RcAsk, RcmState, StateAsk, carried
from zscout.testing.virtual_time import PROCESS
from zscout.types import SECOND, Place

LONG: Final = 4
STEALS_EVERY: Final = 0.5
CLEARS_UP: Final = (0.0, 0.0, 0.2, 1.0, 60.0)
"""Seconds that a program takes to end on request. With the last value it is killed first."""


class Program:
    """Uses devices past their RCs; with its guardian, which keeps the deadline. A process of its own: it neither stops
    nor dies with its client."""

    def __init__(self, devices: Mapping[str, Device], direct: DirectHold, client: str, now: Callable[[], int]) -> None:
        self._devices = [devices[rc] for rc in direct.rcs]
        self._grant, self._now = direct.grant, now
        self._timer: asyncio.TimerHandle | None = None
        for device in self._devices:
            device.touch(direct.grant, client)
        direct.watch(self.keep)
        self.keep(direct)

    def keep(self, direct: DirectHold) -> None:
        """Give the guardian a new deadline."""
        if self._timer is not None:
            self._timer.cancel()
        left = max(0.0, (direct.gone_by - self._now()) / SECOND)
        # The guardian is not part of the client's process, and has its own clock.
        self._timer = Context().run(asyncio.get_running_loop().call_later, left, self.end)

    def end(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        for device in self._devices:
            device.leave(self._grant)


async def steal_places(mesh: Mesh, over: Callable[[], bool]) -> None:
    """Request at the places of others that wait, and claim these places to new leaders, until the run is `over`."""
    rng, listed, seals = RANDOM.get(), list[OpenRequest](), dict[Place | None, str | None]()
    collect = lambda _, notice: seals.update({notice.place: notice.seal})  # noqa: E731
    answer = lambda query: query.answer(ClientRequests(str(mesh.me), listed))  # noqa: E731
    declared = [
        mesh.subscribe(mesh.keys.notice_any, Notice, collect),
        mesh.serve(mesh.keys.requests(mesh.me), RcAsk, answer),
        mesh.alive(Token(mesh.me.host, Role.CLIENT, mesh.me.client, new_instance())),
    ]
    while not over():
        await asyncio.sleep(rng.uniform(0, 2 * STEALS_EVERY))
        state = await mesh.ask_one(mesh.keys.ask_state(mesh.me), StateAsk(), RcmState, timeout=STEALS_EVERY)
        others = (
            [wait for wait in state.message.queue if wait.client != str(mesh.me)] if state and state.message else []
        )
        if others:
            wait = rng.choice(others)
            id_ = rng.choice((new_instance(), wait.id))
            stolen = OpenRequest(id_, "stolen", wait.needs, wait.priority, wait.min_runtime, seal=seals.get(wait.place))
            listed[:] = [replace(stolen, place=wait.place, was=rng.choice((None, wait.id)))]
            ask = carried(listed[0], Ask)
            await mesh.ask_one(mesh.keys.schedule(mesh.me), ask, Notice, timeout=STEALS_EVERY)
    for left in declared:
        left.close()
    await mesh.close()


@dataclass(slots=True)
class Work:
    """The work of all programs: to request `devices` until `over`, with up to `pause` seconds in between."""

    devices: Mapping[str, Mapping[str, object] | None]
    """By RC: its capacity; None if it is exclusive."""
    pause: float
    counts: Counter[str]
    log: Callable[[str], None]
    broken: Callable[[str], None]
    commands: bool = False
    """Many requests are for commands: they give no minimum runtime, and are protected for longer."""
    touched: Mapping[str, Device] | None = None
    """By RC: its device, if programs use devices past their RCs."""
    over: bool = False
    commanded: int = 0

    async def run(self, client: Client, arc: str, busy: set[str]) -> None:
        """Request ARCs one after the other, all named `arc`. The name is in `busy` while an ARC is open."""
        rng = RANDOM.get()
        await asyncio.sleep(rng.uniform(0, 3))
        while not self.over:
            rcs = rng.sample(sorted(self.devices), rng.choice((1, 1, 2, 2, 3)))
            needs = {rc: {"rate": rng.choice((2, 4, 6))} if self.devices[rc] else {} for rc in rcs}
            # Some last longer than any fault.
            times = LONG if rng.random() < 0.15 else 1
            how: dict[str, Any] = {
                "priority": rng.choice((0, 0, 0, 1, 5)),
                "min_runtime": round(rng.uniform(0.3, 3) * times, 3),
                "keep": rng.random() < 0.1,
            }
            if self.commands and rng.random() < 0.6:
                how |= {"min_runtime": None, "keep": True, "until_done": True}
            if self.touched is not None:
                how["direct"] = rng.random() < 0.6
            self.counts["requests"] += 1
            self.log(f"{arc} asks for {' '.join(rcs)} {how}")
            busy.add(arc)
            try:
                if rng.random() < 0.5:
                    async with hold(client, arc, needs, **how) as held:
                        await self._use(client, held, times)
                else:
                    async for attempt in holds(client, arc, needs, **how):
                        async with attempt as held:
                            await self._use(client, held, times)
            except Revoked as revoked:
                self.counts[f"revoked {revoked.outcome}"] += 1
            except (RequestRefused, CommandRefused) as refused:
                self.broken(f"{arc} was thrown away: {refused.code}: {refused}")
            busy.discard(arc)
            await asyncio.sleep(rng.uniform(0.05, self.pause))

    async def _use(self, client: Client, held: Held, times: int) -> None:
        direct = client.internals.direct_hold(held.grant)
        if direct is None or self.touched is None:
            await self._body(held, times)
            return
        self.counts["programs"] += 1
        program, process = Program(self.touched, direct, str(client.mesh.me), client.mesh.now), PROCESS.get()
        try:
            await self._body(held, times)
        finally:
            # A killed client ends nothing: the guardian does.
            if process is not None and not process.dead:
                try:
                    # A program that ends by itself takes no time to end.
                    await asyncio.sleep(RANDOM.get().choice(CLEARS_UP) if direct.over else 0)
                finally:
                    if not process.dead:
                        program.end()

    async def _body(self, held: Held, times: int) -> None:
        rng = RANDOM.get()
        self.counts["grants"] += 1
        for _ in range(rng.randrange(1, 12) * times):
            try:
                self.commanded += 1
                await held.command(rng.choice(held.rcs), {"name": "echo", "value": f"command {self.commanded}"})
                self.counts["commands"] += 1
            except CommandRefused as refused:
                self.counts[f"refused {refused.code}"] += 1
            await asyncio.sleep(rng.uniform(0.02, 0.3))
