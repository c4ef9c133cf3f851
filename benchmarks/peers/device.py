"""Devices that check a fencing token, as zscout's RCs check a grant, for peers whose locks have one.

`python -m benchmarks.peers.device` is a child process (see benchmarks/child.py): it reports its port. On each
connection it takes lines `TOKEN RC...` and answers `ok`, or `old` if one of these RCs has seen a higher token: it obeys
only the holder of its highest token."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Self

from benchmarks.child import Child
from benchmarks.loop import run
from benchmarks.peers.peer import HOST, RCS

HOMES: tuple[Sequence[str], ...] = (RCS[0::2], RCS[1::2])
"""The RCs of each process, as zscout's nodes have them."""


async def serve() -> None:
    shown: dict[str, int] = {}

    async def obey(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            token, *rcs = line.decode().split()
            newer = all(int(token) >= shown.get(rc, 0) for rc in rcs)
            if newer:
                shown.update(dict.fromkeys(rcs, int(token)))
            writer.write(b"ok\n" if newer else b"old\n")
            await writer.drain()

    async with await asyncio.start_server(obey, HOST, 0) as server:
        print(json.dumps(server.sockets[0].getsockname()[1]), flush=True)
        await asyncio.to_thread(sys.stdin.read)


@asynccontextmanager
async def devices() -> AsyncIterator[str]:
    """Run a process for each of HOMES; the target is their ports, separated by commas."""
    processes = [Child.of("peers.device") for _ in HOMES]
    try:
        yield ",".join(str(process.report()) for process in processes)
    finally:
        for process in processes:
            process.close()


class Devices:
    """A program's links to the devices."""

    def __init__(self, links: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]]) -> None:
        self._links = links
        self._turns = [asyncio.Lock() for _ in links]

    @classmethod
    async def link(cls, ports: str) -> Self:
        return cls([await asyncio.open_connection(HOST, int(port)) for port in ports.split(",")])

    async def confirm(self, rcs: Sequence[str], token: int) -> None:
        """Show `token` to all of `rcs`, with one query to each process that has some. Raises PermissionError if it is
        too old."""
        asked = [(number, [rc for rc in rcs if rc in home]) for number, home in enumerate(HOMES)]
        answers = await asyncio.gather(*(self._ask(number, token, own) for number, own in asked if own))
        if not all(answers):
            raise PermissionError(f"token {token} is older than the last shown to {', '.join(rcs)}")

    async def _ask(self, number: int, token: int, rcs: Sequence[str]) -> bool:
        reader, writer = self._links[number]
        async with self._turns[number]:
            writer.write(f"{token} {' '.join(rcs)}\n".encode())
            return await reader.readline() == b"ok\n"

    async def close(self) -> None:
        for _, writer in self._links:
            writer.close()
            await writer.wait_closed()


if __name__ == "__main__":
    run(serve())
