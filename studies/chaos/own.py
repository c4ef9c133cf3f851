"""A client of zscout's own, with the same jobs and logged events as the foreign client.

python -m studies.chaos.own FLEET_FILE HOST SEED"""

from __future__ import annotations

import asyncio
import random
import signal
import sys
from pathlib import Path
from typing import Any

from studies.chaos.work import CLIENT, JOBS, PULSE, Json, draw, now, say
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.behaviors.client.request import OpenArc
from zscout.config.fleet import load_fleet
from zscout.types import SECOND, Grant

NOT_MINE = ("ended", "free", "not_holder", "wrong_client")


class Worker:
    def __init__(self, client: Client, seed: str) -> None:
        self.client, self.rng = client, random.Random(seed)  # noqa: S311
        self.quiet = asyncio.Event()
        self._believed: dict[str, Grant | None] = {}
        self._ids: dict[str, str] = {}
        """The id of each ARC in the last event."""
        client.internals.watch(self._on_change)

    def _on_change(self, arc: OpenArc) -> None:
        if (known_as := self._ids.setdefault(arc.name, arc.id)) != arc.id:
            say("anew", id=known_as, new=arc.id)
            self._ids[arc.name] = arc.id
        before, self._believed[arc.id] = self._believed.get(arc.id), arc.grant
        state = "lost" if arc.state == "asking" else arc.state
        known = {"place": arc._place, "grant": arc.grant, "rcs": arc.rcs, "outcome": arc.outcome, "reason": arc.reason}
        say(state, id=arc.id, before=before, **known, term=arc._last[0], step=arc._last[1], ahead=arc.ahead)

    async def job(self, name: str) -> None:
        rng = random.Random(f"{name} {self.rng.random()}")  # noqa: S311
        while True:
            try:
                async with asyncio.timeout(PULSE[name] * rng.uniform(0.5, 1.5)):
                    await self.quiet.wait()
            except TimeoutError:
                await self._serve(*draw(rng, name, self.client.mesh.me.host))
            else:
                break
        say("quiet", job=name)

    async def _serve(self, asked: Json, lasts: float) -> None:
        asked.pop("id")
        client, how = self.client, {name: value for name, value in asked.items() if name not in ("arc", "needs")}
        asking = asyncio.create_task(client.request(asked["arc"], asked["needs"], **how))
        await asyncio.sleep(0)
        mark = next(arc.id for arc in client._store.open if arc.name == asked["arc"])
        self._ids[asked["arc"]] = mark
        say("asked", id=mark, **asked)
        arc = await asking
        while arc.open:
            if (grant := await client.granted(arc)) is None:
                break
            say("entered", id=arc.id, grant=grant)
            if await self._use(arc, grant, lasts):
                break
        say("gave_up", id=arc.id, grant=arc.grant, ended=not arc.open)
        if arc.open:
            await client.end(arc)
            say("given_up", id=arc.id)
        self._believed.pop(arc.id, None)

    async def _use(self, arc: OpenArc, grant: Grant, lasts: float) -> bool:
        until = now() + round(lasts * SECOND)
        while arc.grant == grant:
            if now() >= until or (now() >= arc.end and not arc.keep):
                return True
            rc, sent, code = self.rng.choice(arc.rcs), now(), ""
            try:
                await self.client.command(rc, grant, {"name": "echo", "value": 1})
            except CommandRefused as refused:
                code = refused.code
            say("commanded", rc=rc, grant=grant, sent=sent, code=code)
            try:
                async with asyncio.timeout(1.0 if code in NOT_MINE else 0.05):
                    while arc.grant == grant:
                        await self.client.changed(arc)
            except TimeoutError:
                if code in NOT_MINE:
                    return True
        return False


async def main() -> None:
    file, host, seed = sys.argv[1:]
    fleet = load_fleet(Path(file))
    over, loop = asyncio.Event(), asyncio.get_running_loop()
    async with await Client.connect(CLIENT, fleet=fleet, host=host) as client:
        worker = Worker(client, seed)
        loop.add_signal_handler(signal.SIGUSR1, worker.quiet.set)
        loop.add_signal_handler(signal.SIGTERM, over.set)
        jobs: list[asyncio.Task[Any]] = [asyncio.create_task(worker.job(job)) for job in JOBS]
        say("up")
        stop: asyncio.Task[Any] = asyncio.create_task(over.wait())
        work = asyncio.ensure_future(asyncio.gather(*jobs))
        waited: list[asyncio.Future[Any]] = [stop, work]
        await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
        if work.done():
            work.result()
            await stop
        work.cancel()


if __name__ == "__main__":
    asyncio.run(main())
