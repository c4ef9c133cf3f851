"""The event loop that zscout's own programs run on."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


def run(main: Coroutine[Any, Any, T]) -> T:
    if os.environ.get("BENCH_UV"):
        import uvloop
        return uvloop.run(main)
    return asyncio.run(main)
