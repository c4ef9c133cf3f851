"""Programs at work for takeover tests: some run and command their RCs all the time, others wait behind."""

from __future__ import annotations

import asyncio

from tests.hang import HANG
from tests.live.lab import Lab
from zscout.behaviors.client.arc import Held, hold
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.mesh import clock
from zscout.messages import RcmState
from zscout.types import Grant, Ns

BEAT = 0.02
"""Seconds between two commands of a body."""


class Body:
    """One ARC whose body commands its RC until it is told to stop, and notes every trouble."""

    def __init__(self, client: Client, name: str, rc: str, *, min_runtime: float = 600.0) -> None:
        self.name, self.rc = name, rc
        self.grant: Grant | None = None
        self.beats: list[Ns] = []
        """When each command was answered."""
        self._entered = asyncio.Event()
        self._stop = asyncio.Event()
        self.task = asyncio.create_task(self._run(client, min_runtime))

    async def _run(self, client: Client, min_runtime: float) -> None:
        async with hold(client, self.name, {self.rc: {}}, min_runtime=min_runtime) as held:
            self.grant = held.grant
            self._entered.set()
            while not self._stop.is_set():
                await self._beat(held)

    async def _beat(self, held: Held) -> None:
        number = len(self.beats)
        done = await held.command(self.rc, {"name": "echo", "value": number}, ttl=60)
        assert done.result == number
        self.beats.append(clock.now())
        await asyncio.sleep(BEAT)

    async def entered(self) -> None:
        entered = asyncio.create_task(self._entered.wait())
        await asyncio.wait({entered, self.task}, timeout=HANG, return_when=asyncio.FIRST_COMPLETED)
        entered.cancel()
        if self.task.done():
            self.task.result()
        assert self._entered.is_set(), f"{self.name} did not enter its body"

    async def beats_on(self, after: Ns) -> None:
        """Waits until a command that was given after `after` has been obeyed. Raises what ended the body."""
        async with asyncio.timeout(HANG):
            while not self.beats or self.beats[-1] <= after:
                if self.task.done():
                    self.task.result()
                await asyncio.sleep(BEAT)

    async def finish(self) -> None:
        """Ends the body; raises if it was disturbed before."""
        self._stop.set()
        async with asyncio.timeout(HANG):
            await self.task


class Crew:
    """`bodies` that run, one to an RC, and `waiting` requests behind them, all over several clients."""

    def __init__(self) -> None:
        self.clients: list[Client] = []
        self.bodies: list[Body] = []
        self.waiting: list[OpenArc] = []

    async def assemble(self, lab: Lab, rcs: list[str], *, waiting: int) -> None:
        self.clients = await asyncio.gather(*(lab.client(f"crew{number}") for number in range(len(rcs))))
        self.bodies = [
            Body(client, f"run-{number}", rc) for number, (client, rc) in enumerate(zip(self.clients, rcs, strict=True))
        ]
        await asyncio.gather(*(body.entered() for body in self.bodies))
        for number in range(waiting):
            at = number % len(rcs)
            # Some need two RCs, and ranks differ: the queue is not just the order of arrival.
            needs: dict[str, dict[str, int]] = {rcs[at]: {}}
            if number % 3 == 0:
                needs[rcs[at - 1]] = {}
            runtime = 600 - 50 * (number % 4)
            arc = await self.clients[at].request(f"wait-{number}", needs, min_runtime=runtime)
            self.waiting.append(arc)

    async def checked(self, lab: Lab, client: Client, stood: Stand, *, since: Ns) -> RcmState:
        """Nothing that stood may have suffered under the RCM that leads now; bodies went on after `since`."""
        after = await lab.state(client, lambda state: state.term > stood.term and len(state.queue) == len(stood.queue))
        now = Stand(after)
        assert now.holds == stood.holds
        assert now.queue == stood.queue
        for body in self.bodies:
            await body.beats_on(since)
            (holder,) = (await lab.rc(client, body.rc)).holders
            assert (holder.arc, holder.grant) == (body.name, body.grant)
        assert [arc.state for arc in self.waiting] == ["queued"] * len(self.waiting)
        return after


class Stand:
    """What stood at one moment: holds with their grants and places, and the queue in its order."""

    def __init__(self, state: RcmState) -> None:
        self.term = state.term
        self.holds = {view.arc: (view.grant, view.place) for view in state.holds}
        self.queue = [(view.arc, view.place) for view in state.queue]

    def went_on(self, state: RcmState, *arcs: str) -> None:
        """These have been granted since, as `state` tells."""
        self.holds |= {arc: held for arc, held in Stand(state).holds.items() if arc in arcs}
        self.queue = [(arc, place) for arc, place in self.queue if arc not in arcs]
