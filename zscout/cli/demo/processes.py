"""The processes of a demo: started, watched, and ended with it, however it may end."""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from collections.abc import Awaitable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from zscout.cli import launch
from zscout.cli.common import Failed
from zscout.keyexpr import new_instance

HOSTS: Final = ("anvil", "bellows", "crucible")
RECORDS: Final = "crucible"
"""The host whose node records."""
RECORDINGS: Final = "recordings"
"""The folder of its recording, below the demo's."""
BUILDING: Final = "building"
"""The process that simulates one, where there is one."""
GRACE: Final = 12.0
"""Seconds for the processes to end in order."""
MAX_LINE: Final = 65_536
SHOWN: Final = 600
"""Characters of a log that explain a failure."""


class Processes:
    """Nodes and others, all of one fleet. Use as an async context manager: none is left afterwards."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.fleet_file = folder / "fleet.toml"
        self.failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Has an exception once a process ended that should not have."""
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._ending = False
        self._ends: dict[str, str] = {}
        """Where each host's node listens."""
        self._live = 0
        """The port of the recorder's live view."""

    def write_fleet(self) -> None:
        """Writes the fleet file, for those who begin before the nodes."""
        *ports, self._live = free_ports(len(HOSTS) + 1)
        self._ends = {host: f"tcp/127.0.0.1:{port}" for host, port in zip(HOSTS, ports, strict=True)}
        self.fleet_file.write_text(
            f'[fleet]\nname = "demo-{new_instance()}"\ncandidates = {_list(HOSTS)}\n'
            '[mesh]\nmulticast = false\nlisten = ["tcp/127.0.0.1:0"]\n'
            f"connect = {_list(list(self._ends.values()))}\n"
        )

    async def start_nodes(self, extra: Mapping[str, str], node_table: str = "") -> None:
        """Starts a node on each of HOSTS, in a fleet of their own on this machine's loopback: `extra` is more
        text for the node file of a host, `node_table` more lines of its [node] table."""
        if not self._ends:
            self.write_fleet()
        for host, end in self._ends.items():
            others = [other for other in self._ends.values() if other != end]
            text = f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n{node_table}'
            text += f'[mesh]\nlisten = ["{end}"]\nconnect = {_list(others)}\n'
            if host == RECORDS:
                text += f'[recorder]\npath = "{RECORDINGS}"\nport = {self._live}\n'
            file = self.folder / f"{host}.toml"
            file.write_text(text + extra.get(host, ""))
            # The launcher has the kernel end the node with this process, however that may end.
            start = ["-I", "-S", launch.__file__, str(os.getpid()), "-1", sys.executable, "-m", "zscout.node"]
            await self.start(f"node {host}", [*start, str(file)])

    async def start(
        self, name: str, arguments: Sequence[str], *, speaks: bool = False
    ) -> asyncio.subprocess.Process:
        """Starts a Python process; one that `speaks` does so through pipes, else its output is logged."""
        with self._log(name).open("wb") as log:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                *arguments,
                stdin=asyncio.subprocess.PIPE if speaks else asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE if speaks else log,
                stderr=log,
                env=os.environ | {"ZSCOUT_FLEET": str(self.fleet_file)},
                # Ctrl-C is for this process alone, which then ends the others in their order.
                start_new_session=True,
                limit=MAX_LINE,
            )
        self._processes[name] = process
        self._tasks.append(asyncio.create_task(self._mourn(name, process)))
        return process

    async def watched(self, play: Awaitable[None]) -> None:
        """Runs `play`; raises Failed as soon as a process ends that should not have."""
        task = asyncio.ensure_future(play)
        try:
            await asyncio.wait({task, self.failed}, return_when=asyncio.FIRST_COMPLETED)
            if self.failed.done():
                self.failed.result()
            await task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def within(self, seconds: float, what: Awaitable[object], otherwise: str) -> None:
        """Waits for `what`. Raises Failed with what the logs say, if it takes longer than `seconds`."""
        try:
            async with asyncio.timeout(seconds):
                await what
        except TimeoutError:
            logs = (self._log(name).read_text(errors="replace").strip() for name in self._processes)
            words = next((log for log in logs if "ERROR" in log or "WARN" in log), "")[-SHOWN:]
            raise Failed(f"{otherwise} in time; {words or 'is this machine very busy? try again'}") from None

    async def _mourn(self, name: str, process: asyncio.subprocess.Process) -> None:
        code = await process.wait()
        early = bool(code) or name.startswith("node ")
        if early and not self._ending and not self.failed.done():
            words = self._log(name).read_text(errors="replace").strip()[-SHOWN:]
            self.failed.set_exception(Failed(f"{name} ended with code {code}: {words or 'it said nothing'}"))

    def _log(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.log"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending = True
        try:
            async with asyncio.timeout(GRACE):
                await self._end()
        except TimeoutError:
            pass
        finally:
            for process in self._processes.values():
                if process.returncode is None:
                    process.kill()
        await asyncio.gather(*(process.wait() for process in self._processes.values()))
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.failed.cancel()

    async def _end(self) -> None:
        """The node that records goes first: that the others go is no part of the story. The building of their
        devices, which does not end with its input, is told last."""
        for process in self._processes.values():
            if process.stdin is not None:
                process.stdin.close()
        nodes = [process for name, process in self._processes.items() if name.startswith("node ")]
        recording = self._processes.get(f"node {RECORDS}")
        for process in sorted(nodes, key=lambda process: process is not recording):
            if process.returncode is None:
                process.terminate()
            if process is recording:
                await process.wait()
        building = self._processes.get(BUILDING)
        if building is not None and building.returncode is None:
            building.terminate()
        await asyncio.gather(*(process.wait() for process in self._processes.values()))


def _list(texts: Sequence[str]) -> str:
    return "[" + ", ".join(f'"{text}"' for text in texts) + "]"


def free_ports(count: int) -> list[int]:
    """Ports that nobody has at this moment, all different."""
    with ExitStack() as stack:
        servers = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [int(server.getsockname()[1]) for server in servers]
