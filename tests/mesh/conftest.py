"""A test that takes a `world` runs on each of both meshes."""

from __future__ import annotations

from contextlib import AsyncExitStack

import pytest

from tests.mesh.both_meshes import Memory, World, Zenoh


@pytest.fixture(params=[Memory, Zenoh])
def world(request: pytest.FixtureRequest, stack: AsyncExitStack) -> World:
    world: World = request.param(stack)
    return world
