"""MJPEG over HTTP for the video receivers of a building, with an address for each channel.

`/ch1` is an endless stream (multipart/x-mixed-replace, as network cameras send it), `/ch1.jpg` the next frame alone,
`/` a page with links. Each watcher is sent the newest frame once the previous frame has left, so a slow watcher
misses frames and delays no other. `watched` lists the channels worth drawing.
"""

from __future__ import annotations

import asyncio
import errno
import html
import os
import re
import socket
from collections.abc import Sequence
from contextlib import suppress
from http import HTTPStatus
from typing import Final, Self

from zscout.config.strict import BadInput

MAX_REQUEST: Final = 8_192  # bytes with headers
MAX_CLIENTS: Final = 32
MAX_WAITING: Final = 32  # connections beyond MAX_CLIENTS that get an error; more are closed
REQUEST_TIME: Final = 5.0  # s to receive a request
SEND_TIME: Final = 10.0  # s to send a frame before the client is cut off
FRAME_TIME: Final = 5.0  # s to wait for a single frame
SEND_BUFFER: Final = 16_384  # bytes in the kernel per watcher: few, since frames grow old there
LINGER: Final = 1.0  # s that the rest of a refused request is read and discarded
MAX_LINGER: Final = 16  # reads at most in that time
BOUNDARY: Final = "frame"
_REQUEST_LINE: Final = re.compile(rb"([A-Z]{1,16}) (/[!-~]{0,1000}) HTTP/1\.[01]\r\n")
_PAGE: Final = "text/html; charset=utf-8"
_JPEG: Final = "image/jpeg"
_STREAM: Final = f"multipart/x-mixed-replace; boundary={BOUNDARY}"


class Channel:
    """The newest frame of a channel, and its watchers."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.frame = b""
        self.number = 0
        self.watchers: set[StreamClient] = set()
        self.stalled = False


class StreamClient:
    def __init__(self) -> None:
        self.news = asyncio.Event()
        self.gone = False


class VideoServer:
    """`channels`: path segments. `port` 0: any free port. Entering raises BadInput for an unusable address."""

    def __init__(self, channels: Sequence[str], *, host: str = "127.0.0.1", port: int = 0) -> None:
        self._channels = {name: Channel(name) for name in channels}
        self._host, self._port = host, port
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.sent = self.missed = self.refused = 0  # frames sent, frames skipped for slow watchers, requests

    async def __aenter__(self) -> Self:
        try:
            self._server = await asyncio.start_server(
                self._connected, self._host, self._port, limit=MAX_REQUEST, backlog=64
            )
        except (OSError, OverflowError) as error:
            number = error.errno if isinstance(error, OSError) else errno.EINVAL
            reason = "in use" if number == errno.EADDRINUSE else os.strerror(number or 0)
            raise BadInput(f"can't serve on {self._host}, port {self._port} ({reason}); choose another") from None
        self._port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *exc: object) -> None:
        if self._server is not None:
            self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    @property
    def page(self) -> str:
        """URL of the page with links."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        if self._host in ("0.0.0.0", "::"):  # noqa: S104 - compared, not bound
            host = socket.gethostname()
        return f"http://{host}:{self._port}/"

    def url(self, channel: str) -> str:
        return self.page + self._channels[channel].name

    @property
    def clients(self) -> int:
        return len(self._tasks)

    @property
    def watched(self) -> tuple[str, ...]:
        """The channels with watchers, without stalled channels."""
        return tuple(name for name, channel in self._channels.items() if channel.watchers and not channel.stalled)

    def show(self, channel: str, jpeg: bytes) -> None:
        shown = self._channels[channel]
        shown.frame, shown.number = jpeg, shown.number + 1
        for watcher in shown.watchers:
            watcher.news.set()

    def stall(self, channel: str, *, stalled: bool = True) -> None:
        """Stop the frames with connections open, or resume them."""
        self._channels[channel].stalled = stalled

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101
        before = len(self._tasks)
        self._tasks.add(task)
        # Without a buffer here, `drain` returns once the kernel has all bytes.
        writer.transport.set_write_buffer_limits(high=0)
        try:
            if before < MAX_CLIENTS + MAX_WAITING:
                await self._answer(reader, writer, full=before >= MAX_CLIENTS)
        except (OSError, TimeoutError, asyncio.CancelledError):
            # The client left or was too slow, or the server ends: asyncio would report each cancelled connection.
            pass
        finally:
            self._tasks.discard(task)
            if writer.transport.get_write_buffer_size():
                writer.transport.abort()  # `close` would wait for clients that do not read
            else:
                writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, full: bool) -> None:
        asked = await _request(reader)
        if asked is None:
            return
        if full and not isinstance(asked, HTTPStatus):
            asked = HTTPStatus.SERVICE_UNAVAILABLE
        if isinstance(asked, HTTPStatus):
            await self._refuse(reader, writer, asked)
            return
        method, path = asked
        name, single = path[1:].removesuffix(".jpg"), path.endswith(".jpg")
        if path != "/" and name not in self._channels:
            await self._refuse(reader, writer, HTTPStatus.NOT_FOUND)
        elif method == "HEAD":
            await _send(writer, _head(HTTPStatus.OK, _PAGE if path == "/" else _JPEG if single else _STREAM))
        elif path == "/":
            await _send_whole(writer, HTTPStatus.OK, _PAGE, self._links())
        elif single:
            await self._single(self._channels[name], reader, writer)
        else:
            await self._stream(self._channels[name], reader, writer)

    async def _single(self, channel: Channel, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        watcher = StreamClient()
        channel.watchers.add(watcher)
        try:
            async with asyncio.timeout(FRAME_TIME):
                await watcher.news.wait()
        except TimeoutError:
            await self._refuse(reader, writer, HTTPStatus.SERVICE_UNAVAILABLE)
            return
        finally:
            channel.watchers.discard(watcher)
        self.sent += 1
        await _send_whole(writer, HTTPStatus.OK, _JPEG, channel.frame)

    async def _stream(self, channel: Channel, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        sock: socket.socket = writer.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        watcher = StreamClient()
        leaving = asyncio.ensure_future(_until_gone(reader, watcher))
        last = channel.number
        channel.watchers.add(watcher)
        try:
            await _send(writer, _head(HTTPStatus.OK, _STREAM) + f"--{BOUNDARY}\r\n".encode())
            while True:
                await watcher.news.wait()
                watcher.news.clear()
                if watcher.gone:
                    return
                self.missed += channel.number - last - 1
                last = channel.number
                await _send(writer, _part(channel.frame))
                self.sent += 1
        finally:
            channel.watchers.discard(watcher)
            leaving.cancel()

    async def _refuse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, status: HTTPStatus) -> None:
        self.refused += 1
        await _send_whole(writer, status, "text/plain; charset=utf-8", f"{status.phrase}\n".encode())
        # If the connection is closed with unread bytes, the answer may get lost.
        writer.write_eof()
        with suppress(TimeoutError):
            async with asyncio.timeout(LINGER):
                for _ in range(MAX_LINGER):
                    if not await reader.read(MAX_REQUEST):
                        break

    def _links(self) -> bytes:
        rows = (
            f'<li><a href="/{name}">{name}</a> (<a href="/{name}.jpg">one frame</a>)</li>'
            for name in map(html.escape, self._channels)
        )
        return f"<!doctype html><title>Video channels</title><ul>{''.join(rows)}</ul>\n".encode()


async def _request(reader: asyncio.StreamReader) -> tuple[str, str] | HTTPStatus | None:
    """The requested method and path, an error, or None if the client left without a request."""
    try:
        async with asyncio.timeout(REQUEST_TIME):
            head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.IncompleteReadError as error:
        return HTTPStatus.BAD_REQUEST if error.partial else None
    except asyncio.LimitOverrunError:
        return HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
    except TimeoutError:
        return HTTPStatus.REQUEST_TIMEOUT
    request = _REQUEST_LINE.match(head)
    if request is None:
        return HTTPStatus.BAD_REQUEST
    method, path = request[1].decode(), request[2].decode().partition("?")[0]
    return (method, path) if method in ("GET", "HEAD") else HTTPStatus.METHOD_NOT_ALLOWED


async def _until_gone(reader: asyncio.StreamReader, watcher: StreamClient) -> None:
    """Notice that a watcher leaves, even without frames to send; discard its input."""
    with suppress(OSError):
        while await reader.read(MAX_REQUEST):
            pass
    watcher.gone = True
    watcher.news.set()


def _head(status: HTTPStatus, kind: str, length: int | None = None) -> bytes:
    lines = [f"HTTP/1.1 {status.value} {status.phrase}", f"Content-Type: {kind}"]
    lines += ["Cache-Control: no-store", "X-Content-Type-Options: nosniff", "Connection: close"]
    if length is not None:
        lines.append(f"Content-Length: {length}")
    if status is HTTPStatus.METHOD_NOT_ALLOWED:
        lines.append("Allow: GET, HEAD")
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def _part(jpeg: bytes) -> bytes:
    """A frame with its closing boundary, so that readers need not wait for the next frame."""
    head = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
    return head.encode() + jpeg + f"\r\n--{BOUNDARY}\r\n".encode()


async def _send_whole(writer: asyncio.StreamWriter, status: HTTPStatus, kind: str, body: bytes) -> None:
    await _send(writer, _head(status, kind, len(body)) + body)


async def _send(writer: asyncio.StreamWriter, data: bytes) -> None:
    writer.write(data)
    async with asyncio.timeout(SEND_TIME):
        await writer.drain()
