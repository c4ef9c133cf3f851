"""Output of a component: its end is kept, and its rate limited."""

from __future__ import annotations

import asyncio
import codecs
import os
from typing import Final

from zscout.messages import MAX_OUTPUT, MAX_TAIL

RATE: Final = 1_000_000  # bytes read per second, on average; faster writers wait
BURST: Final = 262_144  # bytes read before that limit applies
CHUNK: Final = 65_536
LAST_READS: Final = 32  # chunks read after a component has ended


class OutputRing:
    """The last `size` bytes of a stream. Positions are bytes from its beginning."""

    def __init__(self, size: int = MAX_OUTPUT) -> None:
        self._size = size
        self._bytes = bytearray()
        self.end = 0  # bytes ever written
        self.over = False  # the stream has ended

    @property
    def start(self) -> int:
        """The first byte still kept."""
        return self.end - len(self._bytes)

    def write(self, data: bytes) -> None:
        self.end += len(data)
        self._bytes += data[-self._size :]
        if len(self._bytes) > self._size:
            del self._bytes[: -self._size]

    def read(self, start: int) -> tuple[int, int, str]:
        """Start, end and text from byte `start`; U+FFFD for invalid UTF-8; no incomplete last character."""
        first = min(max(start, self.start), self.end)
        decoder = codecs.getincrementaldecoder("utf-8")("replace")
        text = decoder.decode(self._bytes[first - self.start :], final=self.over)
        unfinished, _ = decoder.getstate()
        return first, self.end - len(unfinished), text

    def tail(self) -> str:
        """The last MAX_TAIL characters."""
        _, _, text = self.read(self.end - 4 * MAX_TAIL)
        return text[-MAX_TAIL:]


class OutputReader:
    """Reads a pipe into a ring, no faster than RATE. Owns the descriptor `fd`."""

    def __init__(self, fd: int, ring: OutputRing) -> None:
        self._fd, self._ring = fd, ring
        self._loop = asyncio.get_running_loop()
        self._credit = float(BURST)
        self._at = self._loop.time()
        self._again: asyncio.TimerHandle | None = None
        os.set_blocking(fd, False)
        self._loop.add_reader(fd, self._readable)

    def _readable(self) -> None:
        count = self._read()
        if count is None:
            return
        now = self._loop.time()
        self._credit = min(BURST, self._credit + (now - self._at) * RATE) - count
        self._at = now
        if not count or self._credit < 0:
            self._loop.remove_reader(self._fd)
        if count and self._credit < 0:
            self._again = self._loop.call_later(-self._credit / RATE, self._loop.add_reader, self._fd, self._readable)

    def _read(self) -> int | None:
        """Return the number of bytes read; None: nothing available, 0: the other end is closed."""
        try:
            data = os.read(self._fd, CHUNK)
        except BlockingIOError:
            return None
        self._ring.write(data)
        return len(data)

    def finish(self) -> None:
        """Read the rest, and close the pipe, even if it has writers."""
        if self._again is not None:
            self._again.cancel()
        self._loop.remove_reader(self._fd)
        for _ in range(LAST_READS):
            if not self._read():
                break
        os.close(self._fd)
        self._ring.over = True
