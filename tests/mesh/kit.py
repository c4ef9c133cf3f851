"""What tests of services need to run on a mesh in memory, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from tests.hang import HANG
from zscout.testing.virtual_time import run

__all__ = ["run", "until"]

WITHIN = HANG
"""Seconds in which anything that is waited for must have come true, on a busy machine."""


async def until(condition: Callable[[], object], *, within: float = WITHIN) -> None:
    """Waits until `condition()` is true: in virtual time, without real waiting."""
    async with asyncio.timeout(within):
        while not condition():  # noqa: ASYNC110 - any condition, of any code
            await asyncio.sleep(0.001)
