"""A serial line served by its own thread, since pyserial blocks. It reopens an unplugged port, without limit."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from zscout.drivers.serial_port import IDLE, TIMEOUT, SerialPort, plain
from zscout.mesh import clock
from zscout.types import SECOND, Ns

DEPTH: Final = 2
PAUSES: Final = (0.2, 2.0)
"""Seconds before it is reopened: the first pause, and the longest."""
CLOSE_TIMEOUT: Final = 3.0
LOOK: Final = 0.02


class SerialLine:
    """A line to `port`, until `stop`.

    Callbacks in the event loop: `up()` when the line is open; `down(why)` when it is not usable, once for each change
    of the reason; `wrote()` when the system has accepted a packet, or it was too old to send. The thread takes at most
    DEPTH packets at a time; the caller keeps to the rate of the line (`transmit_queue`)."""

    def __init__(
        self, port: SerialPort, *, up: Callable[[], None], down: Callable[[str], None], wrote: Callable[[], None]
    ) -> None:
        self.port = port
        self.received = 0
        """Received bytes: they are only counted, since the radio is one-way."""
        self._up, self._down, self._wrote = up, down, wrote
        self._loop = asyncio.get_running_loop()
        self._queue: queue.Queue[tuple[bytes, Ns | None]] = queue.Queue(DEPTH)
        self._stopping = threading.Event()
        self._why = ""
        self._thread = threading.Thread(target=self._run, name=f"line {port.url}", daemon=True)
        self._thread.start()

    async def stop(self) -> None:
        """Close the line, after sending the packets handed over if possible."""
        self._stopping.set()
        await asyncio.to_thread(self._thread.join, CLOSE_TIMEOUT)

    def write(self, data: bytes, until: Ns | None = None) -> bool:
        """Return False if DEPTH packets wait. The packet is not sent after `until`, by the host's clock."""
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait((data, until))
            return True
        return False

    def _run(self) -> None:
        pause = PAUSES[0]
        while not self._stopping.is_set():
            try:
                self.port.open()
            except Exception as error:  # noqa: BLE001 - URL handlers may raise any exception
                self._fail(error)
            else:
                pause = PAUSES[0]
                self._serve()
            self._stopping.wait(pause)
            pause = min(2 * pause, PAUSES[1])

    def _serve(self) -> None:
        """Write until the line fails or is stopped."""
        while not self._queue.empty():  # handed over while the line was down: too old
            self._queue.get_nowait()
        self._why = ""
        self._call(self._up)
        looked = clock.now()
        try:
            while not (self._stopping.is_set() and self._queue.empty()):
                with contextlib.suppress(queue.Empty):
                    data, until = self._queue.get(timeout=0 if self._stopping.is_set() else IDLE)
                    if until is None or clock.now() <= until:
                        self.port.write(data)
                    self._call(self._wrote)
                if clock.now() - looked >= IDLE * SECOND:
                    looked = clock.now()
                    self.received += self.port.look()
            end = clock.now() + TIMEOUT * SECOND
            while self.port.outstanding() and clock.now() < end:
                time.sleep(LOOK)
            self.port.close(discard=self.port.outstanding() > 0)
        except Exception as error:  # noqa: BLE001 - OSError, termios.error and others that pyserial lets through
            self._fail(error)
            self.port.close(discard=True)

    def _fail(self, error: Exception) -> None:
        why = f"{self.port.url} {plain(error)}"
        if why != self._why:
            self._why = why
            self._call(self._down, why)

    def _call(self, call: Callable[..., None], *args: Any) -> None:
        try:
            self._loop.call_soon_threadsafe(call, *args)
        except RuntimeError:  # the loop is closed: the process is ending
            self._stopping.set()
