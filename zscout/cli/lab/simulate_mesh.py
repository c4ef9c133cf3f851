"""A served building on the mesh: what it looks like, and who is where, for recorders and demos to show."""

from __future__ import annotations

import asyncio
from typing import Final

from zscout.lab.building.serve import Served
from zscout.mesh import IncomingQuery, Mesh
from zscout.messages.behaviors import BuildingPoses, PlanAsk

EVERY: Final = 0.2
"""Seconds of ours between two publications of who is where."""


async def publish(served: Served, mesh: Mesh) -> None:
    """Publishes who is where, and answers queries for the plan, until it is cancelled."""
    plan = await served.map()

    def answer(request: IncomingQuery[PlanAsk]) -> None:
        request.answer(plan)

    keys = mesh.keys
    queryable = mesh.serve(keys.building_plan(mesh.me), PlanAsk, answer)
    poses = mesh.publisher(keys.building_poses(mesh.me), BuildingPoses, data=True)
    loop = asyncio.get_running_loop()
    try:
        due = loop.time()
        while True:
            poses.put(await served.poses())
            due = max(due + EVERY, loop.time())
            await asyncio.sleep(due - loop.time())
    finally:
        poses.close()
        queryable.close()
