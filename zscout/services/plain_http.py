"""A small read-only server of texts over plain HTTP: `GET` and `HEAD`, one request per connection."""

from __future__ import annotations

import asyncio
import logging
import re
import socket
from abc import ABC, abstractmethod
from contextlib import suppress
from ipaddress import ip_address
from typing import Final, NamedTuple

from zscout.mesh.sparse_log import SparseLog
from zscout.mesh.supervision import clock

log = logging.getLogger(__name__)

MAX_CONNECTIONS: Final = 32
"""Connections at one time: a further one replaces the oldest, preferably without a request yet."""
MAX_HEAD: Final = 8_192
"""Bytes of a request."""

_HOST: Final = re.compile(rb"\r\nhost:[ \t]*([^\r\n]*?)[ \t]*(?=\r\n)", re.IGNORECASE)


class Page(NamedTuple):
    text: bytes
    kind: str = "text/plain"
    status: str = "200 OK"
    headers: str = ""
    """Further headers, each ended by CR LF."""


class PlainHttpServer(ABC):
    """A server; `what` names its contents, for the log."""

    timeout = 5.0
    """Seconds that a connection may last."""

    def __init__(self, what: str, bind: str, port: int) -> None:
        self._what, self.bind, self.port = what, bind, port
        self._tasks: dict[asyncio.Task[None], bool] = {}
        """Connections, oldest first; True once the request has arrived."""
        self._names = {"localhost", bind.lower(), socket.gethostname().lower()}
        self._knows_domain = False
        self._server: asyncio.Server | None = None
        self._failures_log = SparseLog(log, clock.now)

    @abstractmethod
    async def page(self, path: str) -> Page | None:
        """The page at a path (without the query string), None if there is none. Called concurrently."""

    @property
    @abstractmethod
    def where(self) -> str:
        """Names the valid paths; the answer to any other path."""

    async def start(self) -> None:
        """Start serving. Raises OSError if the port is not available. Port 0 becomes a free port."""
        self._server = await asyncio.start_server(self._accept, self.bind, self.port, limit=MAX_HEAD, backlog=16)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._tasks) >= MAX_CONNECTIONS:
            oldest = next((task for task, asked in self._tasks.items() if not asked), next(iter(self._tasks)))
            del self._tasks[oldest]
            oldest.cancel()
        task = asyncio.create_task(self._serve(reader, writer))
        self._tasks[task] = False
        task.add_done_callback(lambda done: self._tasks.pop(done, None))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(self.timeout):
                head = await reader.readuntil(b"\r\n\r\n")
                if (task := asyncio.current_task()) in self._tasks:
                    self._tasks[task] = True
                writer.write(await self._response(head))
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, OSError):
            pass  # the client is slow, gone, or does not speak HTTP
        except Exception as error:  # noqa: BLE001 - a failing page must not stop the service
            self._failures_log.warning("", "%s can't be served: %r", self._what, error)
        finally:
            writer.transport.abort()

    async def _response(self, head: bytes) -> bytes:
        method, _, rest = head.partition(b" ")
        path = rest.partition(b" ")[0].partition(b"?")[0].decode("ascii", "replace")
        found = None
        if not await self._is_named(head):
            # DNS rebinding: a page of another site that a browser took for this host.
            words = f"not a name of this host; use {socket.gethostname()} or its address\n"
            found = Page(words.encode(), status="421 Misdirected Request")
        elif path.startswith("/"):
            found = Page(b"GET or HEAD\n", status="405 Method Not Allowed", headers="Allow: GET, HEAD\r\n")
            if method in (b"GET", b"HEAD"):
                found = await self.page(path)
        page = found or Page(f"{self.where}\n".encode(), status="404 Not Found")
        first = f"HTTP/1.1 {page.status}\r\nContent-Type: {page.kind}\r\n{page.headers}"
        first += f"Content-Length: {len(page.text)}\r\nConnection: close\r\n"
        text = f"{first}X-Content-Type-Options: nosniff\r\n\r\n".encode("ascii")
        return text if method == b"HEAD" else text + page.text

    async def _is_named(self, head: bytes) -> bool:
        """Return True if a request names this host, an IP address, or no host."""
        hosts = _HOST.findall(head)
        if len(hosts) != 1:
            return not hosts
        name = hosts[0].decode("ascii", "replace").lower()
        host = name.partition("]")[0].removeprefix("[") if name.startswith("[") else name.partition(":")[0]
        with suppress(ValueError):
            return bool(ip_address(host))
        if host not in self._names and not self._knows_domain:
            self._names.add((await asyncio.to_thread(socket.getfqdn)).lower())
            self._names.add(f"{socket.gethostname().partition('.')[0].lower()}.local")
            self._knows_domain = True
        return host.removesuffix(".") in self._names
