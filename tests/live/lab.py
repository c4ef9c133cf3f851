"""A real mesh for live tests: `zscout-node` processes and client processes of a fleet of their own."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from zscout.behaviors.client import Client
from zscout.config import Fleet, load_fleet
from zscout.keyexpr import new_instance
from zscout.messages import RcmState

START = 20.0
"""Seconds within which anything that is waited for must have come true, on a busy machine."""


class Lab:
    """Nodes of one fleet on this machine, apart from every other mesh by name and multicast port.

    Use as an async context manager; everything that was started is gone afterwards.
    """

    def __init__(self, folder: Path, *, lease: float = 1.0, candidates: Sequence[str] = (), extra: str = "") -> None:
        self.folder = folder
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}
        self.others: list[subprocess.Popen[bytes]] = []
        self.clients: list[Client] = []
        self.fleet_file = folder / "fleet.toml"
        names = ", ".join(f'"{name}"' for name in candidates)
        self.fleet_file.write_text(
            f'[fleet]\nname = "test-{new_instance()}"\ncandidates = [{names}]\n'
            f'[mesh]\nmulticast_address = "224.0.0.224:{random.randint(20_000, 60_000)}"\n'
            f'interface = "lo"\nlease = {lease}\n{extra}'
        )
        self.fleet: Fleet = load_fleet(self.fleet_file)
        self.env = os.environ | {"ZSCOUT_FLEET": str(self.fleet_file)}

    def node(self, host: str, *rcs: str, extra: str = "") -> subprocess.Popen[bytes]:
        """Starts a node. `rcs` are names, or `name:param=bound` for a sharable one with a capacity."""
        text = f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n{extra}\n'
        for rc in rcs:
            name, _, bounds = rc.partition(":")
            text += f'[[rc]]\nname = "{name}"\ndriver = "{"capacity" if bounds else "exclusive"}"\n'
            if bounds:
                text += f"capacity = {{ {bounds} }}\n"
        file = self.folder / f"{host}.toml"
        file.write_text(text)
        self.nodes[host] = self.spawn([sys.executable, "-m", "zscout.node", str(file)], log=f"{host}.log")
        return self.nodes[host]

    def spawn(self, command: Sequence[str], *, log: str | None = None) -> subprocess.Popen[bytes]:
        """Starts a process in this fleet; its output goes to a file of the folder."""
        out: Any = subprocess.DEVNULL
        if log is not None:
            out = (self.folder / log).open("ab")
        process = subprocess.Popen(list(command), env=self.env, stdout=out, stderr=subprocess.STDOUT)
        if log is not None:
            out.close()
        self.others.append(process)
        return process

    def log(self, host: str) -> str:
        return (self.folder / f"{host}.log").read_text()

    async def client(self, name: str | None = None) -> Client:
        client = await Client.connect(name, fleet=self.fleet, host="test")
        self.clients.append(client)
        return client

    async def state(self, client: Client, until: Callable[[RcmState], bool]) -> RcmState:
        """The RCM's state as soon as `until` holds of it; fails after START seconds."""
        seen: RcmState | None = None
        try:
            async with asyncio.timeout(START):
                while True:
                    seen = await client.state(timeout=0.5) or seen
                    if seen is not None and until(seen):
                        return seen
                    await asyncio.sleep(0.02)
        except TimeoutError:
            logs = "\n".join(f"--- {host}\n{self.log(host)}" for host in self.nodes)
            raise AssertionError(f"waited in vain; last seen {seen}\n{logs}") from None

    async def ready(self, client: Client, *rcs: str) -> RcmState:
        """Waits until somebody leads and all these RCs are there."""
        return await self.state(
            client, lambda state: set(rcs) <= {view.rc for view in state.rcs if view.present}
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await asyncio.gather(*(client.close() for client in self.clients), return_exceptions=True)
        for process in self.others:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self.others:
            try:
                await asyncio.to_thread(process.wait, 10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
