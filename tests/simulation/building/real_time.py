"""Tests that are coroutines, of what a building serves in real time."""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Callable, Coroutine
from contextlib import AbstractAsyncContextManager
from typing import Any

from tests.hang import HANG

Test = Callable[..., Coroutine[Any, Any, None]]


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(HANG):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


def in_real_time(test: Test) -> Callable[..., None]:
    @functools.wraps(test)
    def run(**fixtures: object) -> None:
        asyncio.run(asyncio.wait_for(test(**fixtures), 2 * HANG))

    return run


def with_served(opened: Callable[[], AbstractAsyncContextManager[Any]]) -> Callable[[Test], Callable[..., None]]:
    """For tests whose first parameter is what `opened` serves."""

    def decorator(test: Test) -> Callable[..., None]:
        async def serve(**fixtures: object) -> None:
            async with opened() as served:
                await test(served, **fixtures)

        run, signature = in_real_time(serve), inspect.signature(test)
        functools.update_wrapper(run, test)
        parameters = [*signature.parameters.values()][1:]
        run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        return run

    return decorator
