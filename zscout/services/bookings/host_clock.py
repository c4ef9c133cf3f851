"""Whether a time service keeps this host's clock, by the kernel."""

from __future__ import annotations

import ctypes
from typing import Final

TIME_ERROR: Final = 5  # what adjtimex returns where nothing keeps the clock
TIMEX: Final = 256  # bytes that are enough for its struct on any platform


def is_synchronised() -> bool | None:
    """None where the kernel can't be asked."""
    try:
        code = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(TIMEX))
    except (OSError, AttributeError):
        return None
    return None if code < 0 else bool(code != TIME_ERROR)
