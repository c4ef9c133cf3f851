"""A client process for live tests: asks for ARCs, holds or waits, and can be killed or frozen.

    python -m tests.live.holder NAME [HOST]     (the fleet is the one that ZSCOUT_FLEET names)

Orders come as JSON lines on stdin, what happens goes out as JSON lines on stdout, with `at` in ns of this host's clock.
Orders: {"order": "ask", "arc", "needs", "priority", "min_runtime", "keep"}, {"order": "command", "rc", "do", "ttl"}
under the last grant of this process, with "anew" one without an id, {"order": "work", "rcs"}: commands these RCs all
the time, until one refuses it or the hold is lost ("disturbed"); {"order": "beats"}: how often they have obeyed since
it was asked last; {"order": "state"}: the RCM's; {"order": "time", "rc"}: how long it takes from a request to the
confirmed grant; {"order": "end"}. It ends when its stdin does.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import sys
from collections.abc import Iterable
from typing import Any

import msgspec

from zscout.behaviors.client import confirmation
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.client.request import OpenArc
from zscout.keyexpr import Role, Token
from zscout.mesh import Mesh, clock
from zscout.messages import Command, Done
from zscout.types import Grant

HOST = sys.argv[2] if len(sys.argv) > 2 else None
BEAT = 0.02
"""Seconds between two commands of a program at work."""
PATIENT = 10.0
"""Seconds that an RC may take to answer."""


def say(event: str, **details: Any) -> None:
    sys.stdout.write(json.dumps({"event": event, "at": clock.now(), **details}) + "\n")
    sys.stdout.flush()


async def linked(mesh: Mesh, rcs: Iterable[str]) -> None:
    """Waits until `mesh` sees these RCs: a link to their hosts may come later than that to the RCM."""
    missing, complete = set(rcs), asyncio.Event()

    def seen(token: Token, alive: bool) -> None:
        if alive:
            missing.discard(token.name)
        if not missing:
            complete.set()

    if missing:
        watch = mesh.watch(mesh.keys.alive_any(Role.RC), seen)
        await complete.wait()
        watch.close()


class Holder:
    def __init__(self, client: Client) -> None:
        self.client = client
        self.arc: OpenArc | None = None
        self.grant: Grant | None = None
        self.tasks: set[asyncio.Task[None]] = set()
        self.beats = 0
        client.internals.watch(self._told)

    def _told(self, arc: OpenArc) -> None:
        """A new word of the RCM: `queued`, `running` or `ended`."""
        say(arc.state, arc=arc.name, reason=arc.reason, outcome=arc.outcome, grant=arc.grant, place=arc._place)

    async def obey(self, order: dict[str, Any]) -> None:
        match order.pop("order"):
            case "ask":
                await self._ask(**order)
            case "command":
                await self._command(**order)
            case "work":
                await self._work(**order)
            case "beats":
                say("beats", beats=self.beats)
                self.beats = 0
            case "state":
                say("state", state=msgspec.to_builtins(await self.client.state(timeout=0.5)))
            case "time":
                await self._time(**order)
            case "end" if self.arc is not None:
                await self.client.end(self.arc)
                say("given_up")

    async def _ask(self, arc: str, needs: dict[str, Any], **how: Any) -> None:
        await linked(self.client.mesh, needs)
        try:
            self.arc = await self.client.request(arc, needs, **how)
        except RequestRefused as refused:
            say("refused", code=refused.code)
            return
        asked = self.arc
        while asked.open:
            try:
                grant = await self.client.granted(asked, confirmed=True)
            except CommandRefused as refused:
                say("not_entered", code=refused.code, reason=str(refused))
                return
            if grant is None:
                return
            self.grant = grant
            say("entered", arc=asked.name, grant=grant)
            while asked.grant == grant:
                await self.client.changed(asked)

    async def _command(self, rc: str, do: dict[str, Any], ttl: float = PATIENT, *, anew: bool = False) -> None:
        assert self.grant is not None
        if anew:
            key = self.client.mesh.keys.command(rc, self.client.mesh.me)
            await self.client.mesh.ask_one(key, Command(do, self.grant, ttl), Done, timeout=ttl)
            say("command", code="done")
            return
        try:
            done = await self.client.command(rc, self.grant, do, ttl=ttl, timeout=ttl)
        except CommandRefused as refused:
            say("command", code=refused.code, reason=str(refused))
        else:
            say("command", code="done", result=done.result)

    async def _work(self, rcs: list[str]) -> None:
        assert self.arc is not None
        grant, commands = self.grant, itertools.cycle(rcs)
        assert grant is not None
        while self.arc.grant == grant:
            try:
                await self.client.command(
                    next(commands), grant, {"name": "echo", "value": 1}, ttl=PATIENT, timeout=PATIENT
                )
            except CommandRefused as refused:
                say("disturbed", code=refused.code, reason=str(refused))
                return
            self.beats += 1
            await asyncio.sleep(BEAT)
        if self.arc.open:
            say("disturbed", code="lost", reason=self.arc.reason)

    async def _time(self, rc: str) -> None:
        began = clock.now()
        asked = await self.client.request("timed", {rc: {}}, min_runtime=600)
        await self.client.granted(asked, confirmed=True)
        took = clock.now() - began
        await self.client.end(asked)
        say("timed", took=took)

    def start(self, line: bytes) -> None:
        task = asyncio.get_running_loop().create_task(self.obey(json.loads(line)))
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)


async def main() -> None:
    confirmation.CONFIRM_TIMEOUT = PATIENT / 2
    loop = asyncio.get_running_loop()
    orders = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(orders), sys.stdin)
    async with await Client.connect(sys.argv[1], host=HOST) as client:
        holder = Holder(client)
        say("up")
        while line := await orders.readline():
            holder.start(line)


if __name__ == "__main__":
    asyncio.run(main())
