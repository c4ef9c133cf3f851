"""Ask the kernel whether a time service synchronises this host's clock."""

from __future__ import annotations

import ctypes
from typing import Final

TIME_ERROR: Final = 5  # result of adjtimex for an unsynchronised clock
TIMEX: Final = 256  # bytes; enough for its struct on any platform


def is_synchronised() -> bool | None:
    """Return None if the kernel can't be asked."""
    try:
        code = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(TIMEX))
    except (OSError, AttributeError):
        return None
    return None if code < 0 else bool(code != TIME_ERROR)
