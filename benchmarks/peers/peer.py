"""The interface of a contender in this benchmark, and code shared by several."""

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
"""Seconds of silence after which a holder counts as dead, for all contenders with leases; etcd's minimum."""
START = 30.0
"""Seconds that a server may take to start."""
END = 15.0
HOST = "127.0.0.1"

Waiting = Callable[[], None]


class Missing(Exception):
    """This peer is not available here; the message names the missing part and its remedy."""


class Session(ABC):
    """One program's link to a peer, used by several behaviors at once."""

    async def prepare(self, rcs: Sequence[str]) -> None:  # noqa: B027
        """Prepare to request `rcs` as a set; not timed."""

    async def settle(self, rcs: Sequence[str]) -> None:  # noqa: B027
        """Wait until released `rcs` are available again, if `release` returns sooner; not timed."""

    @abstractmethod
    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> Any:
        """Wait for all of `rcs` and return the hold. `waiting` is called as soon as the request is known to wait."""

    @abstractmethod
    async def release(self, hold: Any) -> None:
        """Give a hold back; return once the server has it."""

    @abstractmethod
    async def close(self) -> None:
        """End the session."""


class Peer(ABC):
    """One contender: its server, which runs in child processes, and its sessions."""

    name: str
    lacks: str
    """Features of zscout that it does not have."""

    @abstractmethod
    def version(self) -> str:
        """Return the versions of server and client. Raises Missing."""

    @abstractmethod
    def serve(self, folder: Path) -> AbstractAsyncContextManager[str]:
        """Run the server until the end of the block; its target is the address. Raises Missing."""

    @abstractmethod
    async def connect(self, address: str, name: str) -> Session:
        """Open a program's session; `name` is unique."""


NAMES = ("zscout", "confirmed", "dask", "redis", "redis_fenced", "etcd", "etcd_fenced", "labgrid", "ray")


def load(name: str) -> Peer:
    """Return the contender of this name. Raises Missing if its packages are not installed."""
    module = "with_zscout" if name == "confirmed" else f"with_{name.partition('_')[0]}"
    try:
        peers: dict[str, Peer] = importlib.import_module(f"benchmarks.peers.{module}").PEERS
    except ModuleNotFoundError as error:
        raise Missing(f"no Python module {error.name}; `make bench-peers` installs it") from None
    return peers[name]


def package(name: str) -> str:
    return f"{name} {importlib.metadata.version(name)}"


def program_version(*command: str, remedy: str) -> str:
    """Return the first line that a program prints of its version. Raises Missing, with the remedy `remedy`."""
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=START)
    except (OSError, subprocess.SubprocessError):
        raise Missing(f"no program {command[0]}; {remedy}") from None
    return said.stdout.splitlines()[0].strip()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


@asynccontextmanager
async def server(
    command: Sequence[str], folder: Path, *, port: int | None = None
) -> AsyncIterator[subprocess.Popen[bytes]]:
    """Run a server in `folder` until the end of the block; with a `port`, wait until it listens there.

    Raises Missing, with the last line of its log, if it does not start."""
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
            # There is no event for a port that begins to listen.
            await asyncio.sleep(0.05)
        else:
            writer.close()
            return


def last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:300] if lines else "its log is empty"


class Waiters:
    """The waiting requests of a session, for peers that notify of freed RCs but keep no queue."""

    def __init__(self) -> None:
        self._waiting: dict[asyncio.Event, frozenset[str]] = {}
        self._ended = False

    @contextmanager
    def waiter(self, rcs: Iterable[str]) -> Iterator[asyncio.Event]:
        """Return an event that is set whenever one of `rcs` becomes free. Enter before the first try."""
        event = asyncio.Event()
        self._waiting[event] = frozenset(rcs)
        try:
            yield event
        finally:
            del self._waiting[event]

    async def wait(self, event: asyncio.Event) -> None:
        """Wait until one of the event's RCs has become free since the last wait. Raises ConnectionError if there are no
        notifications any more."""
        if not self._ended:
            await event.wait()
        event.clear()
        if self._ended:
            raise ConnectionError("the peer's notifications of freed RCs have ended")

    def notifications_ended(self, _task: asyncio.Task[None]) -> None:
        """Call it when the task that receives notifications has ended."""
        self._ended = True
        for event in self._waiting:
            event.set()

    def freed(self, rcs: Iterable[str]) -> None:
        free = set(rcs)
        for event, wanted in self._waiting.items():
            if wanted & free:
                event.set()
