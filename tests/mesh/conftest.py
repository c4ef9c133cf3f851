"""`play` runs a story on each of both meshes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack

import pytest

from tests.hang import HANG
from tests.mesh import kit
from tests.mesh.both_meshes import Memory, Story, Zenoh


@pytest.fixture(params=[Memory, Zenoh])
def play(request: pytest.FixtureRequest) -> Callable[[Story], None]:
    def play(story: Story) -> None:
        async def main() -> None:
            async with AsyncExitStack() as stack, asyncio.timeout(2 * HANG):
                await story(request.param(stack))

        (kit.run if request.param is Memory else asyncio.run)(main())

    return play
