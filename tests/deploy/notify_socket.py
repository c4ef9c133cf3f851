"""The service manager's end of `$NOTIFY_SOCKET`: a real socket, and what came out of it."""

from __future__ import annotations

import asyncio
import socket
from types import TracebackType
from typing import Final, Self

from tests.hang import HANG

LONGEST: Final = 65_536


class NotifySocket:
    """`address` as systemd writes it: a path, or `@` and an abstract name. Messages come as a mapping."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.heard: list[dict[str, str]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)

    def read(self) -> list[dict[str, str]]:
        """What has come since the last time."""
        new: list[dict[str, str]] = []
        while True:
            try:
                message = self._socket.recv(LONGEST)
            except BlockingIOError:
                self.heard += new
                return new
            new.append(dict(line.split("=", 1) for line in message.decode().splitlines()))

    async def until(self, key: str) -> dict[str, str]:
        """The next message that has this key; those before it are passed over."""
        async with asyncio.timeout(HANG):
            while True:
                message = await asyncio.get_running_loop().sock_recv(self._socket, LONGEST)
                self.heard.append(dict(line.split("=", 1) for line in message.decode().splitlines()))
                if key in self.heard[-1]:
                    return self.heard[-1]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
