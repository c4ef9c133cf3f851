"""Tests that are coroutines: run in virtual time, or on a real loop if they use `real_time` or a world of Zenoh."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import Any

import pytest

from tests.hang import HANG
from tests.mesh import kit
from tests.mesh.both_meshes import Zenoh

__all__ = ["pytest_pyfunc_call", "real_time", "stack"]


@pytest.fixture
def real_time() -> None:
    """For sockets, threads and processes."""


@pytest.fixture
def stack() -> AsyncExitStack:
    """Open for as long as the test runs."""
    return AsyncExitStack()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Imported by the conftest of a folder with such tests."""
    test = pyfuncitem.obj
    values: dict[str, Any] = pyfuncitem.funcargs
    if not asyncio.iscoroutinefunction(test):
        return None

    real = "real_time" in values or isinstance(values.get("world"), Zenoh)

    async def main() -> None:
        opened = values.get("stack") or AsyncExitStack()
        async with opened, asyncio.timeout(3 * HANG if real else None):
            await test(**{name: values[name] for name in pyfuncitem._fixtureinfo.argnames})

    (asyncio.run if real else kit.run)(main())
    return True
