"""Shared by all demos: nodes in a fleet of their own, watched, recorded, and ended with the demo's process."""

from __future__ import annotations

import asyncio
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from zscout.behaviors.launch import LAUNCH
from zscout.config.fleet import Fleet, load_fleet
from zscout.keyexpr import Role, Token, new_instance
from zscout.mesh import Mesh, Supervisor, clock
from zscout.ports import free_port
from zscout.simulation import DemoFailed
from zscout.types import SECOND, Ns

HOSTS: Final = ("anvil", "bellows", "crucible")
RECORDS: Final = "crucible"  # the host whose node records
RECORDINGS: Final = "recordings"  # its folder below the demo's
BUILDING: Final = "building"  # name of the process that simulates a building
GRACE: Final = 45.0  # s for the processes to end in order and finish the recording
LIVE: Final = 40.0  # s until the recorder must serve
MAX_LINE: Final = 65_536
SHOWN: Final = 600  # characters of a log in a failure's message


class DemoRunner(ABC):
    """A run of a demo; an async context manager, which leaves no process behind. `show(at, text)` receives each event,
    `at` in seconds since `zero`; `on_live` the address of the live view, before anything is shown."""

    def __init__(
        self, folder: Path, show: Callable[[float, str], None], on_live: Callable[[str], Awaitable[None]] | None = None
    ) -> None:
        self.folder = folder
        self.zero: Ns | None = None  # origin of the shown times
        self._fleet_file = folder / "fleet.toml"
        self._show = show
        # Has an exception once a process ends unexpectedly.
        self._failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._supervisor = Supervisor("the demo", self._fail)
        self._ending = False
        self._ends: dict[str, str] = {}  # address of each host's node
        self._live = 0  # port of the recorder's live view
        self._on_live = on_live

    @abstractmethod
    async def play(self) -> None:
        """Raises DemoFailed, MeshError, BadInput."""

    @abstractmethod
    async def close(self) -> None:
        """Leave the mesh, before the processes end."""

    async def run(self) -> None:
        """Raises as `play` does, and DemoFailed as soon as a process ends unexpectedly."""
        task = asyncio.ensure_future(self.play())
        try:
            await asyncio.wait({task, self._failed}, return_when=asyncio.FIRST_COMPLETED)
            if self._failed.done():
                self._failed.result()
            await task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    def event(self, text: str, at: Ns | None = None) -> None:
        self._show(self.elapsed(at), text)

    def elapsed(self, at: Ns | None = None) -> float:
        """Seconds since `zero`, 0 before."""
        return ((clock.now() if at is None else at) - self.zero) / SECOND if self.zero is not None else 0.0

    def fleet(self) -> Fleet:
        return load_fleet(self._fleet_file)

    def write_fleet(self) -> None:
        """Write the fleet file, for processes that start before the nodes."""
        *ports, self._live = free_ports(len(HOSTS) + 1)
        self._ends = {host: f"tcp/127.0.0.1:{port}" for host, port in zip(HOSTS, ports, strict=True)}
        self._fleet_file.write_text(
            f'[fleet]\nname = "demo-{new_instance()}"\ncandidates = {_list(HOSTS)}\n'
            '[mesh]\nmulticast = false\nlease = 5\nlisten = ["tcp/127.0.0.1:0"]\n'
            f"connect = {_list(list(self._ends.values()))}\n"
            # Failures are noticed otherwise, and on a busy machine a process may stall for a second.
            "[timing]\nhold_lease = 10\n"
        )

    async def start_nodes(self, extra: Mapping[str, str], node_table: str = "") -> None:
        """A node for each of HOSTS, on loopback. `extra`: text for a host's node file; `node_table`: for [node]."""
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
            # The launcher has the kernel end the node with this process, even if that is killed.
            node = [*LAUNCH[1:], str(os.getpid()), sys.executable, "-m", "zscout.node", str(file)]
            await self.start(f"node {host}", node)
        if self._on_live is not None:
            await self.within(LIVE, self._served(), "the recorder did not begin")
            await self._on_live(f"rerun+http://127.0.0.1:{self._live}/proxy")

    async def _served(self) -> None:
        """Return once the live view answers."""
        while True:
            with suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", self._live)
                writer.close()
                return
            await asyncio.sleep(0.1)

    async def start(self, name: str, arguments: Sequence[str], *, piped: bool = False) -> asyncio.subprocess.Process:
        """Start a Python process. `piped`: through pipes; otherwise its output is logged."""
        with self._log(name).open("wb") as log:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                *arguments,
                stdin=asyncio.subprocess.PIPE if piped else asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE if piped else log,
                stderr=log,
                env=os.environ | {"ZSCOUT_FLEET": str(self._fleet_file)},
                # Ctrl-C reaches this process alone, which then ends the others in order.
                start_new_session=True,
                limit=MAX_LINE,
            )
        self._processes[name] = process
        self._supervisor.spawn(self._watch_end(name, process))
        return process

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        self._supervisor.spawn(work)

    async def all_there(self, mesh: Mesh, *others: str) -> None:
        """Wait for the tokens of an RCM, the recorder, and `others` (hosts of nodes, names of RCs)."""
        missing, complete = {Role.RCM, Role.RECORDER, *others}, asyncio.Event()

        def seen(token: Token, alive: bool) -> None:
            if alive:
                # By role: until a recorder has read anything, its session is named like an RC.
                missing.difference_update((token.role, {Role.NODE: token.host, Role.RC: token.name}.get(token.role)))
            if not missing:
                complete.set()

        watch = mesh.watch(mesh.keys.alive_any(), seen)
        await complete.wait()
        watch.close()

    async def within(self, seconds: float, what: Awaitable[object], otherwise: str) -> None:
        """Wait for `what`. Raises DemoFailed with a log's end if that takes longer than `seconds`."""
        try:
            async with asyncio.timeout(seconds):
                await what
        except TimeoutError:
            logs = (self._log(name).read_text(errors="replace").strip() for name in self._processes)
            words = next((log for log in logs if "ERROR" in log or "WARN" in log), "")[-SHOWN:]
            raise DemoFailed(f"{otherwise} in time; {words or 'is this machine very busy? try again'}") from None

    async def _watch_end(self, name: str, process: asyncio.subprocess.Process) -> None:
        code = await process.wait()
        if (code or name.startswith("node ")) and not self._ending:
            words = self._log(name).read_text(errors="replace").strip()[-SHOWN:]
            self._fail(DemoFailed(f"{name} ended with code {code}: {words or 'it printed nothing'}"))

    def _fail(self, error: Exception) -> None:
        if not self._failed.done():
            self._failed.set_exception(error)

    def _log(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.log"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending = True
        try:
            await self.close()
            with suppress(TimeoutError):
                async with asyncio.timeout(GRACE):
                    await self._end()
        finally:
            for process in self._processes.values():
                if process.returncode is None:
                    process.kill()
        await asyncio.gather(*(process.wait() for process in self._processes.values()))
        await self._supervisor.close()
        self._failed.cancel()

    async def _end(self) -> None:
        """End the recording node first, so that other ends are not recorded, and the building last, for its devices."""
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
    ports: set[int] = set()
    while len(ports) < count:
        ports.add(free_port("127.0.0.1", 0))
    return [*ports]
