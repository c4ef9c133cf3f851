"""The radio's end of a serial line: a pty limited to the line's rate.

A pty copies at once, so bytes are read from it only as the line would have carried them, a tenth of its baud rate per
second (ten bits to a byte). The rest stays in the kernel, where a writer that is too quick blocks: not at the kernel's
own 20 kB, but at a UART's 4 kB, by stopping the line's output. Packets are then decoded, and some are lost.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import random
import struct
import termios
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Final, Self

from zscout.config.strict import BadInput
from zscout.drivers.packets import Packet, PacketDecoder

BITS: Final = 10  # per byte: a start bit, eight of data, a stop bit
MIN_BAUD: Final = 300
MAX_BAUD: Final = 1_000_000
MAX_SPEED: Final = 100.0
HOLDS: Final = 4_000  # bytes in the buffer before the writer blocks, about as in a serial port
STEP: Final = 0.008  # s between reads of a busy line, for at least MIN_CHUNK bytes
MIN_CHUNK: Final = 8
SLACK: Final = 0.1  # s that a read may be late without costing the line time
_USUAL: Final = (300, 600, 1200, 2400, 4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800)
RATES: Final = {rate: getattr(termios, f"B{rate}") for rate in _USUAL}
_SPEED_OUT: Final = 5
_SPEED_IN: Final = 4


class Pace:
    """Times of bytes on a line of `rate` bytes per second. Pure: times in seconds are passed in."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.chunk = max(MIN_CHUNK, int(rate * STEP))  # bytes per read
        self._free = float("-inf")

    def carry(self, now: float, size: int, *, waited: bool) -> float:
        """When `size` bytes read at `now` have passed. `waited`: they follow the previous bytes without a gap, so that
        a late read (up to SLACK) costs the line no time."""
        begin = self._free if waited and now - self._free <= SLACK else max(now, self._free)
        self._free = begin + size / self.rate
        return self._free


class RadioLine:
    """A radio at the end of a serial line, within an event loop. Bytes pass at `baud / 10 * speed` per second; `speed`
    is the building's. A packet is lost with probability `loss`, a byte garbled with `garble`; both repeat with `seed`.
    `link`: a symlink to the port, which replaces one to another pty; raises BadInput for anything else there. Drivers
    with a usual rate other than `baud` and `baud * speed` are received as noise. `on_packet(packet, at)` is called in
    the event loop; `at` is on its clock, in seconds."""

    def __init__(
        self,
        baud: int,
        on_packet: Callable[[Packet, float], None],
        *,
        speed: float = 1.0,
        loss: float = 0.0,
        garble: float = 0.0,
        seed: int = 0,
        link: Path | None = None,
    ) -> None:
        if not MIN_BAUD <= baud <= MAX_BAUD:
            raise BadInput(f"baud rate {baud}: write {MIN_BAUD} to {MAX_BAUD}")
        if not 0 < speed <= MAX_SPEED:
            raise BadInput(f"speed {speed:g}: write more than 0 and at most {MAX_SPEED:g}")
        for name, share in (("loss", loss), ("garble", garble)):
            if not 0 <= share <= 1:
                raise BadInput(f"{name} {share:g}: write a share from 0 to 1")
        self.baud, self.link = round(baud * speed), link
        self._rates = [RATES[rate] for rate in (self.baud, baud) if rate in RATES]
        self._pace = Pace(baud * speed / BITS)
        self._on_packet, self._loss, self._garble = on_packet, loss, garble
        self._losing, self._garbling = random.Random(f"loss {seed}"), random.Random(f"garble {seed}")  # noqa: S311
        self._decoder = PacketDecoder()
        self._ends: tuple[int, int] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._stopped = False
        self._unplugged_spoiled = 0
        self.port: str | None = None  # of the pty, while it is plugged in
        self.carried = self.received = self.lost = 0  # bytes, packets, packets
        self.plug()

    @property
    def spoiled(self) -> int:
        """Incomplete or garbled packets."""
        return self._unplugged_spoiled + self._decoder.spoiled

    def plug(self) -> None:
        """Open a new pty behind the same link, if none is plugged in."""
        if self._ends is not None:
            return
        master, slave = os.openpty()
        try:
            tty.setraw(slave)
            self._set_rate(slave)
            os.set_blocking(master, False)
            port = os.ttyname(slave)
            if self.link is not None:
                _point(self.link, port)
        except BaseException:
            os.close(master)
            os.close(slave)
            raise
        # The driver's end stays open here, so that the line outlives a driver.
        self._ends, self.port, self._stopped = (master, slave), port, False
        asyncio.get_running_loop().add_reader(master, self._arrived)

    def unplug(self) -> None:
        """Close the pty as if the cable was pulled, so that writers get an error, and remove its link."""
        if self._ends is None or self.port is None:
            return
        master, slave = self._ends
        asyncio.get_running_loop().remove_reader(master)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self.link is not None:
            _unpoint(self.link, self.port)
        self._ends = self.port = None
        os.close(slave)
        os.close(master)
        self._unplugged_spoiled += self._decoder.spoiled
        self._decoder = PacketDecoder()

    def close(self) -> None:
        self.unplug()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _arrived(self) -> None:
        if self._ends is not None:
            asyncio.get_running_loop().remove_reader(self._ends[0])
            self._take(waited=False)

    def _take(self, *, waited: bool) -> None:
        if self._ends is None:
            return
        loop, (master, slave) = asyncio.get_running_loop(), self._ends
        self._hold_back(master, slave)
        try:
            data = os.read(master, self._pace.chunk)
        except BlockingIOError:
            loop.add_reader(master, self._arrived)
            return
        data = self._spoil(data, wrong_rate=self._wrong_rate(slave))
        through = self._pace.carry(loop.time(), len(data), waited=waited)
        self._timer = loop.call_at(through, self._through, data, through)

    def _through(self, data: bytes, at: float) -> None:
        self._timer = None
        self.carried += len(data)
        for packet in self._decoder.feed(data):
            if self._losing.random() < self._loss:
                self.lost += 1
            else:
                self.received += 1
                self._on_packet(packet, at)
        self._take(waited=True)

    def _hold_back(self, master: int, slave: int) -> None:
        (waiting,) = struct.unpack("i", fcntl.ioctl(master, termios.FIONREAD, bytes(4)))
        if (waiting >= HOLDS) != self._stopped:
            self._stopped = not self._stopped
            termios.tcflow(slave, termios.TCOOFF if self._stopped else termios.TCOON)

    def _spoil(self, data: bytes, *, wrong_rate: bool) -> bytes:
        share = 1.0 if wrong_rate else self._garble
        if not share:
            return data
        draw = self._garbling
        return bytes(byte ^ draw.randint(1, 255) if draw.random() < share else byte for byte in data)

    def _set_rate(self, slave: int) -> None:
        if self._rates:
            modes = termios.tcgetattr(slave)
            modes[_SPEED_IN] = modes[_SPEED_OUT] = self._rates[0]
            termios.tcsetattr(slave, termios.TCSANOW, modes)

    def _wrong_rate(self, slave: int) -> bool:
        """Return True if the driver set a usual rate that is not the line's."""
        rate = termios.tcgetattr(slave)[_SPEED_OUT]
        return bool(self._rates) and rate in RATES.values() and rate not in self._rates


def _point(link: Path, port: str) -> None:
    """Make `link` a symlink to `port` atomically, never in place of another file."""
    remedy = "give another name for the radio's link"
    if link.is_symlink():
        if not str(link.readlink()).startswith("/dev/pts/"):
            raise BadInput(f"{link}: links to something else; {remedy}")
    elif link.exists():
        raise BadInput(f"{link}: already exists; {remedy}")
    beside = link.with_name(f"{link.name[:200]}.{os.getpid()}")
    try:
        beside.symlink_to(port)
        try:
            beside.replace(link)
        except OSError:
            beside.unlink()
            raise
    except OSError as error:
        raise BadInput(f"{link}: the link can't be created ({error.strerror}); {remedy}") from None


def _unpoint(link: Path, port: str) -> None:
    if link.is_symlink() and str(link.readlink()) == port:
        link.unlink(missing_ok=True)
