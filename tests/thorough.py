"""How many random cases a test tries. `ZSCOUT_THOROUGH=1` tries ten times as many."""

from __future__ import annotations

import os
from typing import Final

FACTOR: Final = 10 if os.environ.get("ZSCOUT_THOROUGH") == "1" else 1


def times(number: int) -> int:
    """Cases to try, of which `number` are enough from day to day."""
    return number * FACTOR
