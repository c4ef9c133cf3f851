"""Tests of a live mesh may be coroutines: what they take is entered where it is an async context manager."""

from __future__ import annotations

import asyncio
import inspect
import typing
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from pathlib import Path

import pytest

from tests.live.bench import Stand
from tests.live.lab import Lab


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    taken = {name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters}

    async def story() -> None:
        async with AsyncExitStack() as stack:
            for one in taken.values():
                if isinstance(one, AbstractAsyncContextManager):
                    await stack.enter_async_context(one)
            await pyfuncitem.obj(**taken)

    asyncio.run(story())
    return True


@pytest.fixture
def lab(request: pytest.FixtureRequest, tmp_path: Path) -> Lab:
    """Of the kind that the test says it takes: a `Lab`, or one derived from it."""
    made: Lab = typing.get_type_hints(request.function)["lab"](tmp_path)
    return made


@pytest.fixture
def stand(lab: Lab) -> Stand:
    return Stand(lab)
