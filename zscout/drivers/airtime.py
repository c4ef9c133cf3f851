"""The capacity of a radio's line: the vote, and the token bucket that limits each holder to its share. Pure.

A holder requests `command_rate` packets per second of at most `packet_size` bytes. Its packets pass a token bucket of
one packet: at most `L (1 + r t)` bytes come out in any `t` seconds (`L` bytes per packet, `r` packets per second). They
then wait in a common queue, first come first served, for a line of `C` bytes per second. Halts and stops go ahead of
them. Halts, stops and repeats together keep to a separate bucket of `U` bytes, filled at `s C`: the reserve.

The delay bound (network calculus; Le Boudec and Thiran, "Network Calculus", section 1.4: FIFO server, leaky
buckets). Let a packet enter the queue at `t` and leave the line at `t + d`, and let the line have been busy since
`b <= t`. The bytes carried in between came in after `b`, or were under way at `b` (`M` bytes, one packet):

    C (t + d - b)  <=  M + sum L + sum r L (t - b) + U + s C (t + d - b)

If `sum r L <= C (1 - s)`, which is the first half of the vote, then it follows that

    d  <=  (M + sum L + U) / (C (1 - s))

The second half is that this is within `bound`. `U` has room for a halt of each holder. Both sums grow with every
holder, so every subset of accepted holders is accepted. A holder that joins while the line is busy begins with an empty
bucket, so the sums hold across changes of holders, too.

The bound does not hold while more than `U` bytes of halts and stops come at once: they still go first."""

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
"""Share of the line reserved for halts, stops and repeats."""
DEFAULT_RATE: Final = Fraction(5)
"""Packets of full size per second."""
MAX_RATE: Final = Fraction(5_000)
"""Bytes per second assumed at most: a faster line is not the bottleneck."""


def line_rate(baud: int) -> Fraction:
    """Bytes per second assumed for a line of `baud` bits per second."""
    return min(Fraction(baud, BITS_PER_BYTE), MAX_RATE)


@dataclass(frozen=True, slots=True)
class Share:
    """A holder's share: `rate` packets per second of at most `size` bytes."""

    rate: Fraction
    size: Fraction

    @property
    def bytes_per_second(self) -> Fraction:
        return self.rate * self.size


def room(rate: Fraction) -> Fraction:
    return rate * (1 - RESERVE)


def default_rate(rate: Fraction) -> Fraction:
    """Packets per second of a holder that requests no `command_rate`."""
    return min(DEFAULT_RATE, room(rate) / MAX_PACKET)


def share_of(params: Mapping[str, Decimal], default: Fraction = DEFAULT_RATE) -> Share:
    """The share in bandwidth parameters; `default`: the rate without any. Raises ValueError with a reason for
    people."""
    amounts = exact_amounts(params)
    rate = amounts.get("command_rate", default)
    size = amounts.get("packet_size", Fraction(MAX_PACKET))
    if size < OVERHEAD:
        raise ValueError(f"packet_size is {_text(size)}; the shortest packet has {OVERHEAD} bytes")
    return Share(rate, size)


def urgent_burst(holders: int) -> int:
    """`U`: bytes of halts, stops and repeats that may come at once. Halts and stops consist of overhead only."""
    return max(OVERHEAD * holders, MAX_PACKET)


def longest_wait(rate: Fraction, shares: Iterable[Share]) -> Fraction:
    """The delay bound above: seconds from a packet's entry into the queue until it has left the line."""
    sizes = [share.size for share in shares]
    return (MAX_PACKET + sum(sizes) + urgent_burst(len(sizes))) / room(rate)


def objection(rate: Fraction, bound: Fraction, shares: Iterable[Share]) -> str:
    """Why a line of `rate` bytes per second can't carry these shares with waits of at most `bound` seconds; or ""."""
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
    """A token bucket of bytes or frames with a positive rate per second. It takes whole ns and returns exact ns."""

    def __init__(self, size: Fraction, rate: Fraction, now: Ns, *, full: bool = True) -> None:
        self.size = size
        self._period = SECOND / rate
        self._full_at = now + (0 if full else size * self._period)

    def ready(self, needed: int) -> Fraction:
        """The time at which `needed` tokens (at most `size`) are there."""
        return Fraction(self._full_at - (self.size - needed) * self._period)

    def take(self, needed: int, at: Fraction | Ns) -> None:
        """The bucket may go into debt."""
        self._full_at = max(self._full_at, at) + needed * self._period

    def admits(self, needed: int, now: Ns) -> bool:
        """Remove `needed` tokens and return True, or return False if there are not enough."""
        if self.ready(needed) > now:
            return False
        self.take(needed, now)
        return True

    def fill(self, now: Ns) -> None:
        self._full_at = min(self._full_at, now)


def _text(value: Fraction) -> str:
    return f"{float(value):.3g}" if value < 100 else f"{float(value):.0f}"
