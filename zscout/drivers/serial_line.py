"""A serial line in a thread of its own: pyserial blocks. It opens again what was unplugged, for ever."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import queue
import re
import threading
from collections.abc import Callable
from typing import Any, Final

from zscout.mesh import clock

DEPTH: Final = 2
IDLE: Final = 0.2
"""Seconds after which a line that nothing is written to is looked at: is it there still?"""
TIMEOUT: Final = 1.0
"""Seconds that reading and writing may take."""
PAUSES: Final = (0.2, 2.0)
"""Seconds before it is opened again: the first, and the longest."""
CLOSE_TIMEOUT: Final = 3.0
READ_AT_ONCE: Final = 4_096

_WORDS: Final = {
    **dict.fromkeys((errno.ENOENT, errno.ENODEV, errno.ENXIO), "is not there; is it plugged in?"),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM), "may not be opened by this user; add it to the group of the port, often dialout"
    ),
    **dict.fromkeys((errno.EBUSY, errno.EAGAIN), "is used by another program"),
    errno.ENOTTY: "is no serial port",
    errno.ECONNREFUSED: "does not answer: nobody listens there",
    errno.EIO: "was unplugged",
}
_NUMBER: Final = re.compile(r"(?:\[Errno |\()(\d+)[],]")
"""Where pyserial hides an error number in its words."""


class SerialLine:
    """A line, until `stop`. `port` is anything that pyserial's `serial_for_url` takes.

    Called in the event loop: `up()` when the line is open; `down(why)` when it can't be used, once for each reason in a
    row; `wrote()` when the system has taken a packet. At most DEPTH packets are handed to the thread at a time; the
    caller hands over no more than the line carries (`transmit_queue`)."""

    def __init__(
        self, port: str, baud: int, *, up: Callable[[], None], down: Callable[[str], None], wrote: Callable[[], None]
    ) -> None:
        self.port, self.baud = port, baud
        self.received = 0
        """Bytes that came in: the radio goes one way, so they are counted and forgotten."""
        self._up, self._down, self._wrote = up, down, wrote
        self._loop = asyncio.get_running_loop()
        self._queue: queue.Queue[bytes] = queue.Queue(DEPTH)
        self._stopping = threading.Event()
        self._why = ""
        self._thread = threading.Thread(target=self._run, name=f"line {port}", daemon=True)
        self._thread.start()

    async def stop(self) -> None:
        """Closes the line; what was handed over goes out first, if it goes."""
        self._stopping.set()
        await asyncio.to_thread(self._thread.join, CLOSE_TIMEOUT)

    def write(self, data: bytes) -> bool:
        """Hands a packet to the thread, and `wrote` will be called for it; False: DEPTH wait there."""
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(data)
            return True
        return False

    # In the thread

    def _run(self) -> None:
        pause = PAUSES[0]
        while not self._stopping.is_set():
            try:
                port = self._open()
            except Exception as error:  # noqa: BLE001 - what a URL handler raises is nobody's promise
                self._fail(error)
            else:
                pause = PAUSES[0]
                self._serve(port)
            self._stopping.wait(pause)
            pause = min(2 * pause, PAUSES[1])

    def _open(self) -> Any:
        import serial

        # Only real ports can be locked; of two programs on one line neither would be understood.
        exclusive = True if "://" not in self.port else None
        return serial.serial_for_url(self.port, self.baud, timeout=TIMEOUT, write_timeout=TIMEOUT, exclusive=exclusive)

    def _serve(self, port: Any) -> None:
        """Writes until the line fails or nobody wants it any more."""
        while not self._queue.empty():  # handed over while it was down: too old
            self._queue.get_nowait()
        self._why = ""
        self._call(self._up)
        looked = clock.now()
        try:
            while not (self._stopping.is_set() and self._queue.empty()):
                with contextlib.suppress(queue.Empty):
                    port.write(self._queue.get(timeout=0 if self._stopping.is_set() else IDLE))
                    self._call(self._wrote)
                if clock.now() - looked >= IDLE * 1e9:
                    looked = clock.now()
                    if port.in_waiting:
                        self.received += len(port.read(min(port.in_waiting, READ_AT_ONCE)))
        except Exception as error:  # noqa: BLE001 - OSError, termios.error and what else pyserial lets through
            self._fail(error)
            with contextlib.suppress(Exception):
                port.reset_output_buffer()  # what lies in it would go out late
        finally:
            with contextlib.suppress(Exception):
                port.close()

    def _fail(self, error: Exception) -> None:
        why = f"{self.port} {_plain(error)}"
        if why != self._why:
            self._why = why
            self._call(self._down, why)

    def _call(self, call: Callable[..., None], *args: Any) -> None:
        try:
            self._loop.call_soon_threadsafe(call, *args)
        except RuntimeError:  # the loop is closed: the process is on its way out
            self._stopping.set()


def _plain(error: Exception) -> str:
    """What is wrong with a line, for people who do not know pyserial."""
    import serial

    if isinstance(error, serial.SerialTimeoutException):
        return f"took nothing for {TIMEOUT:g} s; is what hangs on it stalled?"
    text = str(error)
    found = _NUMBER.search(text)
    number = getattr(error, "errno", None) or (int(found[1]) if found else None)
    if number in _WORDS:
        return _WORDS[number]
    if "exclusively lock" in text:
        return _WORDS[errno.EBUSY]
    if "write failed" in text or "device reports readiness" in text:
        return _WORDS[errno.EIO]
    return f"fails: {text[:200] or type(error).__name__}"
