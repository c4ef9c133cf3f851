"""Leaders that are killed between the answer to a grant and its publication, again and again.

A client asks for two RCs. The leader answers that they are granted, and is gone before any RC hears of it; the body has
been entered by then. The successor must find that nobody holds them: the client is told so, and has both from the
successor, at its place, before a rival who asked later. No RC carries out a command under a grant that never was.

`python -m tests.live.unpublished node FILE` is the node: one that is killed so once `<host>.dies` lies beside FILE."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from tests.hang import HANG
from tests.live.bench import answer
from tests.live.lab import Lab
from zscout.behaviors.client.request import CommandRefused, OpenArc
from zscout.config.node import load_node
from zscout.messages import Grants
from zscout.node import run_node
from zscout.services.rcm.rcm import Rcm
from zscout.types import Grant

RCS = ("robot/a", "robot/b")
HOSTS = ("h1", "h2")
OUT = 1.0
"""Seconds for which the answer may take to leave the process: nothing else leaves it meanwhile."""
ECHO = {"name": "echo", "value": 1}
BOTH: dict[str, dict[str, int]] = {rc: {} for rc in RCS}


async def node(file: Path) -> None:
    """Runs a node that kills itself so."""
    settings = load_node(file)
    flag = file.with_suffix(".dies")
    publish = Rcm._publish

    def dies_first(self: Rcm, grants: Grants) -> None:
        if flag.exists() and any(grants.rcs.values()):
            flag.unlink()
            time.sleep(OUT)
            os.kill(os.getpid(), signal.SIGKILL)
        publish(self, grants)

    Rcm._publish = dies_first  # type: ignore[method-assign]
    await run_node(settings, asyncio.Event())


@dataclass(frozen=True, slots=True)
class Death:
    """Of one leader."""

    answered: bool
    """Whether the client had the answer."""
    trouble: str = ""


class Deaths:
    """A fleet whose leader is killed so, and started again."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab

    async def assemble(self) -> None:
        self._lab.node("devices", *RCS, extra="candidate = false")
        for host in HOSTS:
            self._start(host)
        self.client, self.rival = await self._lab.client("first"), await self._lab.client("rival")
        await self._lab.ready(self.client, *RCS)

    def _start(self, host: str) -> None:
        file = self._lab.folder / f"{host}.toml"
        file.write_text(f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n{self._lab.security_of(host)}')
        command = [sys.executable, "-m", "tests.live.unpublished", "node", str(file)]
        self._lab.nodes[host] = self._lab.spawn(command, log=f"{host}.log")

    async def death(self) -> Death:
        """One more."""
        await self._lab.candidates(self.client, *HOSTS)
        leader = (await self._lab.state(self.client, lambda state: bool(state.host))).host
        (self._lab.folder / f"{leader}.dies").touch()
        arc = await self.client.request("pair", BOTH, min_runtime=600)
        first = arc.grant
        rivals = await self.rival.request("pair", BOTH, min_runtime=600)
        trouble = "" if first is None else await self._obeyed(first)
        async with asyncio.timeout(HANG):
            grant = await self.client.granted(arc, confirmed=True)
        self._lab.nodes[leader].wait(HANG)
        trouble = trouble or await self._found(arc, first, grant, rivals)
        for client, one in ((self.client, arc), (self.rival, rivals)):
            await client.end(one)
        self._start(leader)
        return Death(first is not None, trouble)

    async def _obeyed(self, first: Grant) -> str:
        """Whether an RC carried out a command of the body under the grant of which it never heard."""
        for rc in RCS:
            try:
                await self.client.command(rc, first, ECHO, ttl=0.2, timeout=1)
            except CommandRefused:
                continue
            return f"{rc} obeyed {first}, which was never published"
        return ""

    async def _found(self, arc: OpenArc, first: Grant | None, grant: Grant | None, rivals: OpenArc) -> str:
        """What is wrong once the successor has granted, if anything."""
        if grant is None or (first is not None and grant <= first):
            return f"{first} is followed by {grant}"
        if rivals.state != "queued":
            return f"who asked later is {rivals.state}"
        for rc in RCS:
            said = await answer(self.client.command(rc, grant, ECHO, ttl=5, timeout=HANG))
            if said != "done":
                return f"{rc} says {said} to {grant}, which it confirmed"
        state = await self._lab.state(self.client, lambda state: bool(state.holds))
        holds = [(hold.client, hold.grant) for hold in state.holds]
        return "" if holds == [(str(self.client.mesh.me), grant)] else f"the RCM lists {holds}"


async def deaths(folder: Path, times: int) -> list[Death]:
    async with Lab(folder, candidates=HOSTS) as lab:
        fleet = Deaths(lab)
        await fleet.assemble()
        return [await fleet.death() for _ in range(times)]


if __name__ == "__main__":
    asyncio.run(node(Path(sys.argv[2])))
