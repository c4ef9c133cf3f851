"""A real HTTP server of MJPEG, as cameras have it, that can be told to misbehave."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

BOUNDARY: Final = b"frame"
HEAD: Final = (
    b"HTTP/1.0 200 OK\r\nCache-Control: no-cache\r\n"
    b"Content-Type: multipart/x-mixed-replace; boundary=" + BOUNDARY + b"\r\n\r\n"
)


def numbered(number: int, *, width: int = 160, height: int = 120, grey: bool = True) -> NDArray[np.uint8]:
    """A picture that carries a number of 16 bits in big blocks, which survive JPEG; see `number_of`."""
    bits = np.array([[number >> (4 * row + column) & 1 for column in range(4)] for row in range(4)], np.uint8)
    blocks = cv2.resize(bits * 200 + 20, (width, height), interpolation=cv2.INTER_NEAREST)
    picture = blocks if grey else cv2.merge([blocks, blocks, 255 - blocks])
    return np.asarray(picture, np.uint8)


def number_of(picture: NDArray[np.uint8]) -> int:
    """The number in a picture of `numbered`."""
    plane = picture if picture.ndim == 2 else picture[:, :, 0]
    height, width = plane.shape
    return sum(
        1 << (4 * row + column)
        for row in range(4)
        for column in range(4)
        if plane[(2 * row + 1) * height // 8, (2 * column + 1) * width // 8] > 120
    )


def jpeg(picture: NDArray[np.uint8], quality: int = 80) -> bytes:
    good, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert good
    return coded.tobytes()


class MjpegServer:
    """Serves numbered pictures to whoever connects, `rate` a second; a context manager.

    `mode` may be changed at any time: "run", "stall" (silent, also to who connects), "garble" (every second
    JPEG has its body overwritten), "half" (half a JPEG, then silence for as long as that client stays: what went
    on from there would pass for the other half), "torn" (half a JPEG, then closed), "404". `clients` bounds how
    many are served at once; others are refused with 503.
    """

    def __init__(self, *, rate: float = 30.0, clients: int = 8, picture: Callable[[int], bytes] | None = None):
        self.rate = rate
        self.mode = "run"
        self.clients = clients
        self.picture = picture or (lambda number: jpeg(numbered(number)))
        self.sent = 0
        """The number of the newest picture that was sent to anybody."""
        self.connected = 0
        """How many are being served."""
        self.accepted = 0
        """How many ever connected."""
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        self._sockets: set[socket.socket] = set()
        self._port = 0
        self._listener: socket.socket | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._port}/video"

    def open(self) -> None:
        """Listens; after `close`, at the same address again."""
        self._closing = threading.Event()
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", self._port))
        listener.listen()
        self._port = listener.getsockname()[1]
        self._listener = listener
        self._spawn(self._accept, listener, self._closing)

    def close(self) -> None:
        """Is gone, as a server that was killed: whoever connects is refused."""
        self._closing.set()
        if self._listener is not None:
            self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()
            self._listener = None
        self.cut()
        for thread in self._threads:
            thread.join(5)
        self._threads.clear()

    def cut(self) -> None:
        """Closes all connections."""
        with self._lock:
            for client in self._sockets:
                with suppress(OSError):  # it has left by itself
                    client.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _spawn(self, run: Callable[..., None], *args: object) -> None:
        thread = threading.Thread(target=run, args=args, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket, closing: threading.Event) -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            with self._lock:
                self.accepted += 1
                self._sockets.add(client)
            self._spawn(self._serve, client, closing)

    def _serve(self, client: socket.socket, closing: threading.Event) -> None:
        served = False
        try:
            client.recv(65_536)
            with self._lock:
                served = self.connected < self.clients
                self.connected += served
            if self.mode == "404":
                client.sendall(b"HTTP/1.0 404 Not Found\r\nContent-Length: 0\r\n\r\n")
            elif not served:
                client.sendall(b"HTTP/1.0 503 Service Unavailable\r\nContent-Length: 0\r\n\r\n")
            else:
                self._stream(client, closing)
        except OSError:
            pass
        finally:
            with self._lock:
                self.connected -= served
                self._sockets.discard(client)
            client.close()

    def _stream(self, client: socket.socket, closing: threading.Event) -> None:
        headed, due, half = False, time.monotonic(), False
        while not closing.is_set():
            due = max(due + 1 / self.rate, time.monotonic() - 1)
            closing.wait(max(0.0, due - time.monotonic()))
            mode = self.mode
            if mode == "stall" or half:
                # A client that has left is noticed all the same.
                client.setblocking(False)
                try:
                    if client.recv(1) == b"":
                        return
                except BlockingIOError:
                    pass
                finally:
                    client.setblocking(True)
                continue
            if not headed:
                client.sendall(HEAD)
                headed = True
            with self._lock:
                self.sent += 1
                number = self.sent
            coded = self.picture(number)
            if mode == "garble" and number % 2:
                coded = coded[: len(coded) // 2] + bytes(range(256)) * (len(coded) // 512 + 1)
            part = b"--%s\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % (BOUNDARY, len(coded))
            if mode in ("half", "torn"):
                client.sendall(part + coded[: len(coded) // 2])
                if mode == "torn":
                    return
                half = True
                continue
            client.sendall(part + coded + b"\r\n")
