"""Serves a node's figures over HTTP: `GET /metrics`, and nothing else.

A scrape is read and answered in the event loop, and written as text in a thread, one at a time, at most once in
`FRESH` seconds however many ask."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from typing import Final

from zscout.mesh.sparse_log import SparseLog
from zscout.mesh.supervision import clock
from zscout.services.metrics.exposition import CONTENT_TYPE, Exposition
from zscout.services.metrics.figures import Samples

log = logging.getLogger(__name__)

MAX_CONNECTIONS: Final = 8
"""That are served at one time; others are closed at once."""
MAX_HEAD: Final = 8_192
"""Bytes of a request."""
TIMEOUT: Final = 5.0
"""Seconds from a connection to its end."""
FRESH: Final = 1.0
"""Seconds for which a text is given again."""


class MetricsServer:
    """`read` gives the figures of now, in the event loop."""

    def __init__(self, read: Callable[[], Samples], bind: str, port: int) -> None:
        self._read, self._bind, self.port = read, bind, port
        self._exposition = Exposition()
        self._rendering = asyncio.Lock()
        self._text, self._made = b"", float("-inf")
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None
        self._strange = SparseLog(log, clock.now)

    async def start(self) -> None:
        """Raises OSError where the port can't be had. Port 0 becomes a free one."""
        self._server = await asyncio.start_server(self._accept, self._bind, self.port, limit=MAX_HEAD, backlog=16)
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
            writer.transport.abort()
            return
        task = asyncio.create_task(self._serve(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(TIMEOUT):
                writer.write(await self._response(await reader.readuntil(b"\r\n\r\n")))
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, OSError):
            pass  # whoever asked is slow, gone, or no HTTP client
        except Exception as error:  # noqa: BLE001 - figures disturb nothing else
            self._strange.warning("", "a scrape of the figures failed: %r", error)
        finally:
            writer.transport.abort()

    async def _response(self, head: bytes) -> bytes:
        method, _, rest = head.partition(b" ")
        path = rest.partition(b" ")[0].partition(b"?")[0]
        if path != b"/metrics":
            return _response("404 Not Found", b"figures are at /metrics\n")
        if method not in (b"GET", b"HEAD"):
            return _response("405 Method Not Allowed", b"GET or HEAD\n", "Allow: GET, HEAD\r\n")
        text = await self._current()
        return _response("200 OK", text, f"Content-Type: {CONTENT_TYPE}\r\n", body=method == b"GET")

    async def _current(self) -> bytes:
        async with self._rendering:
            if time.monotonic() - self._made > FRESH:
                samples = self._read()
                self._text = await asyncio.to_thread(self._exposition.render, samples)
                self._made = time.monotonic()
            return self._text


def _response(status: str, text: bytes, headers: str = "Content-Type: text/plain\r\n", *, body: bool = True) -> bytes:
    head = f"HTTP/1.1 {status}\r\n{headers}Content-Length: {len(text)}\r\nConnection: close\r\n\r\n"
    return head.encode("ascii") + (text if body else b"")
