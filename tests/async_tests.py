"""Tests may be coroutines: a plugin of pytest that runs them."""

from __future__ import annotations

import asyncio
import inspect
import os
import random
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from typing import Any

import pytest

from tests.hang import HANG
from zscout.keyexpr import RANDOM
from zscout.testing import run

REAL = ("live", "real_time")
"""Marks of tests that run in real time; all others run in virtual time."""
SEED = "ZSCOUT_TEST_SEED"
"""The environment variable that gives tests in virtual time other pauses: what fails then depends on luck."""


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "real_time: a coroutine that uses sockets, threads or processes")


@pytest.fixture
def stack() -> AsyncExitStack:
    """Open for as long as the test runs."""
    return AsyncExitStack()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine; what it takes is entered first, where it is an async context manager."""
    test = pyfuncitem.obj
    if not inspect.iscoroutinefunction(test):
        return None
    values: dict[str, Any] = pyfuncitem.funcargs
    marked = any(pyfuncitem.get_closest_marker(name) for name in REAL)
    real = marked or getattr(values.get("world"), "real_time", False)

    async def main() -> None:
        if not real:
            RANDOM.set(random.Random(os.environ.get(SEED, "") + pyfuncitem.nodeid))  # noqa: S311 - what failed once must fail again
        async with AsyncExitStack() as opened, asyncio.timeout(3 * HANG if real else None):
            for value in values.values():
                if isinstance(value, AbstractAsyncContextManager):
                    await opened.enter_async_context(value)
            await test(**{name: values[name] for name in pyfuncitem._fixtureinfo.argnames})

    (asyncio.run if real else run)(main())
    return True
