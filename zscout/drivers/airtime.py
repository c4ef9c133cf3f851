"""What a radio's line can carry: its vote, and the bucket that keeps each holder to its share. Pure.

A holder asks for `command_rate` packets a second of at most `packet_size` bytes. Its packets pass a token
bucket with room for one packet: in any `t` seconds at most `L (1 + r t)` bytes of it come out (`L` bytes a
packet, `r` packets a second). They then wait in one queue, first come first served, before a line of `C`
bytes a second. Halts and stops go ahead of them. These and everything that is sent again together keep to a
bucket of their own of `U` bytes, filled at `s C`: the reserve.

The delay bound (network calculus; Le Boudec and Thiran, "Network Calculus", section 1.4: FIFO server, leaky
buckets). Let a packet enter the queue at `t`, be through the line at `t + d`, and let the line have been busy
since `b <= t`. What it carried in between came in after `b`, or was under way then (`M` bytes, one packet):

    C (t + d - b)  <=  M + sum L + sum r L (t - b) + U + s C (t + d - b)

If `sum r L <= C (1 - s)`, which is the first half of the vote, then it follows that

    d  <=  (M + sum L + U) / (C (1 - s))

The second half is that this is within `bound`. `U` has room for one halt for each holder. Both sums grow with
every holder, so what is accepted is accepted of every part. A holder that joins while the line is busy begins
with an empty bucket, so the sums hold across changes of holders, too.

The promise is suspended while more than `U` bytes of halts and stops come at once: they go first even so."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Final

from zscout.drivers.packets import MAX_PACKET, OVERHEAD
from zscout.messages import exact_amounts
from zscout.types import SECOND, Ns

BITS_PER_BYTE: Final = 10
"""On the line: a start bit, eight of data, a stop bit."""
RESERVE: Final = Fraction(1, 10)
"""Share of the line that is kept for halts, stops and what is sent again."""
DEFAULT_RATE: Final = Fraction(5)
"""Packets a second, of the full size."""
MAX_RATE: Final = Fraction(5_000)
"""Bytes a second that are counted on at most: a faster line is not what holds commands up."""


def line_rate(baud: int) -> Fraction:
    """Bytes a second that are counted on at `baud` bits a second."""
    return min(Fraction(baud, BITS_PER_BYTE), MAX_RATE)


@dataclass(frozen=True, slots=True)
class Share:
    """What one holder may send: `rate` packets a second of at most `size` bytes."""

    rate: Fraction
    size: Fraction

    @property
    def bytes_per_second(self) -> Fraction:
        return self.rate * self.size


def room(rate: Fraction) -> Fraction:
    """Bytes a second that the holders of a line of `rate` bytes a second may send."""
    return rate * (1 - RESERVE)


def default_rate(rate: Fraction) -> Fraction:
    """Packets a second that a holder books on such a line who does not say."""
    return min(DEFAULT_RATE, room(rate) / MAX_PACKET)


def share_of(params: Mapping[str, Decimal], default: Fraction = DEFAULT_RATE) -> Share:
    """The share that bandwidth parameters ask for; `default` is the rate where they have none. Raises ValueError with a
    reason in words."""
    amounts = exact_amounts(params)
    rate = amounts.get("command_rate", default)
    size = amounts.get("packet_size", Fraction(MAX_PACKET))
    if size < OVERHEAD:
        raise ValueError(f"packet_size is {_text(size)}; the shortest packet has {OVERHEAD} bytes")
    return Share(rate, size)


def urgent_burst(holders: int) -> int:
    """`U`: bytes of halts, stops and repeats that may come at once. A halt or a stop is all overhead."""
    return max(OVERHEAD * holders, MAX_PACKET)


def longest_wait(rate: Fraction, shares: Iterable[Share]) -> Fraction:
    """Seconds from when a packet enters the queue until it is through the line: the delay bound above."""
    sizes = [share.size for share in shares]
    return (MAX_PACKET + sum(sizes) + urgent_burst(len(sizes))) / room(rate)


def objection(rate: Fraction, bound: Fraction, shares: Iterable[Share]) -> str:
    """Why a line of `rate` bytes a second can't carry these shares, no packet waiting longer than `bound`
    seconds; empty if it can."""
    shares = list(shares)
    most = room(rate)
    wanted = sum((share.bytes_per_second for share in shares), Fraction(0))
    if wanted > most:
        sizes = {share.size for share in shares if share.rate}
        size = sizes.pop() if len(sizes) == 1 else Fraction(1)
        unit = "bytes/s" if size == 1 else f"packets/s of {_text(size)} bytes"
        return f"its holders would send {_text(wanted / size)} of {_text(most / size)} {unit}"
    wait = longest_wait(rate, shares) if shares else Fraction(0)
    if wait > bound:
        return f"a packet could wait {_text(wait)} s, the bound is {_text(bound)} s"
    return ""


class Bucket:
    """A token bucket of bytes, or frames, at a positive rate a second. Times are whole ns going in, exact ns
    coming out."""

    def __init__(self, size: Fraction, rate: Fraction, now: Ns, *, full: bool = True) -> None:
        self.size = size
        self._period = SECOND / rate
        self._full_at = now + (0 if full else size * self._period)

    def ready(self, needed: int) -> Fraction:
        """When there is enough for `needed` (at most `size`)."""
        return Fraction(self._full_at - (self.size - needed) * self._period)

    def take(self, needed: int, at: Fraction | Ns) -> None:
        """Takes `needed` out at `at`; more than there is leaves it in debt."""
        self._full_at = max(self._full_at, at) + needed * self._period

    def admits(self, needed: int, now: Ns) -> bool:
        """Takes `needed` out if there is enough; whether there was."""
        if self.ready(needed) > now:
            return False
        self.take(needed, now)
        return True

    def fill(self, now: Ns) -> None:
        self._full_at = min(self._full_at, now)


def _text(value: Fraction) -> str:
    return f"{float(value):.3g}" if value < 100 else f"{float(value):.0f}"
