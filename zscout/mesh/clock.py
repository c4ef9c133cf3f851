"""The host's own clock: monotonic, and it goes on while the machine is suspended."""

from __future__ import annotations

import time

from zscout.types import Ns


def now() -> Ns:
    """Nanoseconds since boot, time in suspend included. Not comparable between hosts."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
