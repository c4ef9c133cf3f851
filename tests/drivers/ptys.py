"""A radio's line for tests: a pty whose other end keeps what it hears, and when the line had carried it."""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.hang import HANG
from zscout.drivers.packets import Packet, PacketDecoder
from zscout.mesh import clock
from zscout.types import SECOND, Ns


class PtyLine:
    """A pty at `link`. `heard` are packets with the time at which their last byte was through a line of
    `baud`: a pty itself is as quick as memory."""

    def __init__(self, link: Path, *, baud: int = 9600, reads: bool = True) -> None:
        self.link, self.baud = link, baud
        self.heard: list[tuple[Ns, Packet]] = []
        self.decoder = PacketDecoder()
        self.backlog: Ns = 0
        """The longest that the line had still to carry when more was written to it."""
        self._free: Ns = 0
        self._news = asyncio.Event()
        self._reads = reads
        self.master = -1
        self.plug()

    @property
    def packets(self) -> list[Packet]:
        return [packet for _, packet in self.heard]

    def plug(self) -> None:
        """Plugs it in, as a new device under the old name."""
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        fresh = self.link.with_suffix(".new")
        fresh.symlink_to(os.ttyname(slave))
        fresh.replace(self.link)
        os.close(slave)
        if self._reads:
            asyncio.get_running_loop().add_reader(self.master, self._read)

    def unplug(self) -> None:
        if self.master >= 0:
            asyncio.get_running_loop().remove_reader(self.master)
            # First: its number may be another terminal's as soon as it is closed.
            self.link.unlink()
            os.close(self.master)
            self.master = -1

    def _read(self) -> None:
        try:
            data = os.read(self.master, 4096)
        except OSError:  # nobody has the other end open just now
            return
        now = clock.now()
        self.backlog = max(self.backlog, self._free - now)
        self._free = max(self._free, now) + len(data) * 10 * SECOND // self.baud
        self.heard += [(self._free, packet) for packet in self.decoder.feed(data)]
        self._news.set()

    async def until(self, found: Callable[[list[Packet]], Any], *, since: int = 0) -> Any:
        """Waits until `found` is true of the packets heard from number `since` on; returns what it says."""
        try:
            async with asyncio.timeout(HANG):
                while not (result := found(self.packets[since:])):
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            raise AssertionError(f"waited in vain; heard {self.packets[since:]}") from None
        return result
