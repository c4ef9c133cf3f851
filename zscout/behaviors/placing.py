"""Asking the component placer, for programs that have others do their work."""

from __future__ import annotations

import asyncio
from typing import Final

from zscout import clock
from zscout.behaviors.client import TRY_AGAIN, Client
from zscout.behaviors.refusals import RequestRefused
from zscout.messages import ComponentSpec, EndComponent, PlaceComponent, Placement, Problem
from zscout.scheduling.model import SECOND

TIMEOUT: Final = 5.0
"""Seconds of one asking: a placer that has just begun first hears from all nodes."""
PATIENCE: Final = 30.0
"""Seconds within which some placer answers, though the lead changes meanwhile."""
AGAIN: Final = 0.5


async def place(client: Client, component: str, spec: ComponentSpec, *, wait: float = 3.0) -> Placement:
    """Has `component` run somewhere, or tells how it stands if it does. Raises RequestRefused."""
    return await _ask(client, PlaceComponent(component, spec, wait=wait))


async def stop(client: Client, component: str, *, wait: float = 0.0) -> Placement:
    """Stops it for good. Raises RequestRefused."""
    return await _ask(client, EndComponent(component, wait=wait))


async def _ask(client: Client, operation: PlaceComponent | EndComponent) -> Placement:
    # Both may be asked twice: the placer then only tells how it stands.
    deadline = clock.now() + round(PATIENCE * SECOND)
    problem = Problem("unknown", "no component placer answered; see zscout status")
    while clock.now() < deadline:
        reply = await client.mesh.ask_one(client.mesh.keys.placer, operation, Placement, timeout=TIMEOUT)
        if reply is not None and reply.message is not None:
            return reply.message
        if reply is not None and reply.problem is not None:
            problem = reply.problem
            if problem.code not in TRY_AGAIN:
                break
        await asyncio.sleep(AGAIN)
    raise RequestRefused(problem)
