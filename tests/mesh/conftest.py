"""A test that takes a `world` runs on each of both meshes."""

from __future__ import annotations

from contextlib import AsyncExitStack

import pytest

from tests.mesh.async_tests import pytest_pyfunc_call, real_time, stack
from tests.mesh.both_meshes import Memory, World, Zenoh

__all__ = ["pytest_pyfunc_call", "real_time", "stack"]


@pytest.fixture(params=[Memory, Zenoh])
def world(request: pytest.FixtureRequest, stack: AsyncExitStack) -> World:
    world: World = request.param(stack)
    return world
