"""Coroutine tests run in virtual time: an hour on a mesh in memory takes milliseconds. In a module with `REAL_TIME`,
such as one with sockets, they run in that of the clock."""

from __future__ import annotations

import asyncio
import inspect

import pytest

from zscout.testing.virtual_time import run


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    args = {name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters}
    (asyncio.run if getattr(pyfuncitem.module, "REAL_TIME", False) else run)(pyfuncitem.obj(**args))
    return True
