"""What a component writes: the last of it is kept, and a flood is held back."""

from __future__ import annotations

import asyncio
import os
from typing import Final

from zscout.messages import MAX_OUTPUT, MAX_TAIL

RATE: Final = 1_000_000
"""Bytes a second that are read at most, on average: who writes more has to wait."""
BURST: Final = 262_144
"""Bytes that are read at once before that holds."""
CHUNK: Final = 65_536
LAST_READS: Final = 32
"""Chunks that are read of what is left when a component has ended."""


class OutputRing:
    """The last `size` bytes of a stream. Places are counted in bytes from its beginning."""

    def __init__(self, size: int = MAX_OUTPUT) -> None:
        self._size = size
        self._bytes = bytearray()
        self.end = 0
        """Bytes that were ever written."""
        self.over = False
        """Nothing more will come."""

    @property
    def start(self) -> int:
        """The first byte that is still there."""
        return self.end - len(self._bytes)

    def write(self, data: bytes) -> None:
        self.end += len(data)
        self._bytes += data[-self._size :]
        if len(self._bytes) > self._size:
            del self._bytes[: -self._size]

    def read(self, start: int) -> tuple[int, int, str]:
        """What there is from byte `start` on: where it begins and ends, and the text, with U+FFFD for what is
        no UTF-8. A character that is not whole yet is left for the next time."""
        first = min(max(start, self.start), self.end)
        data = bytes(self._bytes[first - self.start :])
        if not self.over:
            data = data[: len(data) - _unfinished(data)]
        return first, first + len(data), data.decode("utf-8", "replace")

    def tail(self) -> str:
        """The last MAX_TAIL characters."""
        _, _, text = self.read(self.end - 4 * MAX_TAIL)
        return text[-MAX_TAIL:]


def _unfinished(data: bytes) -> int:
    """How many bytes at the end of `data` begin a character that needs more of them."""
    for back in range(1, min(3, len(data)) + 1):
        byte = data[-back]
        if byte >= 0xC0:
            length = 2 if byte < 0xE0 else 3 if byte < 0xF0 else 4
            return back if length > back else 0
        if byte < 0x80:
            break
    return 0


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
        data = self._read()
        if data is None:
            return
        if not data:
            # Nobody holds the other end any more.
            self._loop.remove_reader(self._fd)
            return
        now = self._loop.time()
        self._credit = min(BURST, self._credit + (now - self._at) * RATE) - len(data)
        self._at = now
        if self._credit < 0:
            self._loop.remove_reader(self._fd)
            self._again = self._loop.call_later(-self._credit / RATE, self._resume)

    def _resume(self) -> None:
        self._again = None
        self._loop.add_reader(self._fd, self._readable)

    def _read(self) -> bytes | None:
        """None: nothing is there now."""
        try:
            data = os.read(self._fd, CHUNK)
        except BlockingIOError:
            return None
        self._ring.write(data)
        return data

    def finish(self) -> None:
        """Reads what is there still, and closes the pipe, whoever writes to it."""
        if self._again is not None:
            self._again.cancel()
        else:
            self._loop.remove_reader(self._fd)
        for _ in range(LAST_READS):
            if not self._read():
                break
        os.close(self._fd)
        self._ring.over = True
