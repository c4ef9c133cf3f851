"""What a contender is to this benchmark, and what several of them share."""

from __future__ import annotations

import asyncio
import importlib
import importlib.metadata
import socket
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

RCS = [f"robot/r{number}" for number in range(10)]
LEASE = 2
"""Seconds without word after which a holder counts as dead, for all that know such a thing. The least that
etcd takes."""
START = 30.0
"""Seconds that a server may take to start."""
END = 15.0
HOST = "127.0.0.1"

Waiting = Callable[[], None]


class Missing(Exception):
    """This peer can't be had here; the message says what is missing and how to mend it."""


class Session(ABC):
    """One program's link to a peer. Several behaviors use it at once."""

    async def prepare(self, rcs: Sequence[str]) -> None:  # noqa: B027
        """What has to be there before `rcs` can be asked for as a set; not timed."""

    async def settle(self, rcs: Sequence[str]) -> None:  # noqa: B027
        """Waits until what was given back can be had again, where a release returns before; not timed."""

    @abstractmethod
    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> Any:
        """Gets all of `rcs` or waits, and returns the hold. `waiting` is called once it is known to wait."""

    @abstractmethod
    async def release(self, hold: Any) -> None:
        """Gives a hold back, and returns when the server has heard it."""

    @abstractmethod
    async def close(self) -> None:
        """Leaves."""


class Peer(ABC):
    """One contender: its server, which lives in this process's children, and its sessions."""

    name: str
    lacks: str
    """What of zscout's work it does not do."""

    @abstractmethod
    def version(self) -> str:
        """Versions of server and client. Raises Missing."""

    @abstractmethod
    def serve(self, folder: Path) -> AbstractAsyncContextManager[str]:
        """Runs the server until the end of the block; gives the address. Raises Missing."""

    @abstractmethod
    async def connect(self, address: str, name: str) -> Session:
        """A program's session; `name` is the only one of its kind."""


NAMES = ("zscout", "confirmed", "dask", "redis", "redis_fenced", "etcd", "etcd_fenced", "labgrid", "ray")


def load(name: str) -> Peer:
    """The contender of this name. Raises Missing where its packages are not installed."""
    module = "with_zscout" if name == "confirmed" else f"with_{name.partition('_')[0]}"
    try:
        peers: dict[str, Peer] = importlib.import_module(f"benchmarks.peers.{module}").PEERS
    except ModuleNotFoundError as error:
        raise Missing(f"no Python module {error.name}; `make bench-peers` installs it") from None
    return peers[name]


def package(name: str) -> str:
    return f"{name} {importlib.metadata.version(name)}"


def program_version(*command: str, mend: str) -> str:
    """The first line that a program says of its version. Raises Missing."""
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=START)
    except (OSError, subprocess.SubprocessError):
        raise Missing(f"no program {command[0]}; {mend}") from None
    return said.stdout.splitlines()[0].strip()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


@asynccontextmanager
async def server(
    command: Sequence[str], folder: Path, *, port: int | None = None
) -> AsyncIterator[subprocess.Popen[bytes]]:
    """Runs a server in `folder` until the end of the block; with a `port`, waits until it listens there.

    Raises Missing, with the last line of its log, where it does not come up."""
    log = folder / f"server-{time.monotonic_ns()}.log"
    process = _started(command, folder, log)
    try:
        if port is not None:
            await _listening(process, port, log)
        yield process
    finally:
        process.terminate()
        try:
            await asyncio.to_thread(process.wait, END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _started(command: Sequence[str], folder: Path, log: Path) -> subprocess.Popen[bytes]:
    with log.open("wb") as out:
        return subprocess.Popen(
            list(command), cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT
        )


async def _listening(process: subprocess.Popen[bytes], port: int, log: Path) -> None:
    deadline = time.monotonic() + START
    while True:
        try:
            _, writer = await asyncio.open_connection(HOST, port)
        except OSError:
            if process.poll() is not None or time.monotonic() > deadline:
                raise Missing(f"its server does not come up: {last_line(log)}") from None
            # Nobody tells when a port begins to listen.
            await asyncio.sleep(0.05)
        else:
            writer.close()
            return


def last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:300] if lines else "its log is empty"


class Waiters:
    """Those of a session that wait for RCs, for peers that tell what became free but keep no queue."""

    def __init__(self) -> None:
        self._waiting: dict[asyncio.Event, frozenset[str]] = {}
        self._deaf = False

    @contextmanager
    def waiter(self, rcs: Iterable[str]) -> Iterator[asyncio.Event]:
        """An event that is set whenever one of `rcs` becomes free. Enter before the first try."""
        event = asyncio.Event()
        self._waiting[event] = frozenset(rcs)
        try:
            yield event
        finally:
            del self._waiting[event]

    async def wait(self, event: asyncio.Event) -> None:
        """Until something became free since the last wait. Raises ConnectionError where none will tell."""
        if not self._deaf:
            await event.wait()
        event.clear()
        if self._deaf:
            raise ConnectionError("the peer no longer tells what becomes free")

    def deaf(self, _task: asyncio.Task[None]) -> None:
        """To be called when the task that listens has ended."""
        self._deaf = True
        for event in self._waiting:
            event.set()

    def freed(self, rcs: Iterable[str]) -> None:
        free = set(rcs)
        for event, wanted in self._waiting.items():
            if wanted & free:
                event.set()
