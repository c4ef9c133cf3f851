"""A served building on the mesh: what it looks like, and who is where, for recorders and demos to show."""

from __future__ import annotations

import asyncio
from typing import Final

from zscout.mesh import Mesh, Request
from zscout.messages.behaviors import BuildingPoses, PlanAsk
from zscout.simulation.serve import Served

EVERY: Final = 0.2
"""Seconds of ours from one word about who is where to the next."""


async def tell(served: Served, mesh: Mesh) -> None:
    """Publishes who is where, and answers who asks for the plan, until it is cancelled."""
    plan = await served.map()

    def answer(request: Request[PlanAsk]) -> None:
        request.answer(plan)

    keys = mesh.keys
    asked = mesh.serve(keys.building_plan(mesh.me), PlanAsk, answer)
    told = mesh.publisher(keys.building_poses(mesh.me), BuildingPoses, data=True)
    loop = asyncio.get_running_loop()
    try:
        due = loop.time()
        while True:
            told.put(await served.poses())
            due = max(due + EVERY, loop.time())
            await asyncio.sleep(due - loop.time())
    finally:
        told.close()
        asked.close()
