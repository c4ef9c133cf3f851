"""What every candidate keeps of the placer's work, so that it can go on with it.

What runs, the nodes tell; what ran on a host that died together with the leader, nobody would know.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from zscout.keyexpr import Role, Token, check_name
from zscout.mesh import Declared, Mesh
from zscout.messages import MAX_PLACED, ListPlacements, Placement, Placements, absurd
from zscout.placing.events import Inherited
from zscout.scheduling.model import NO_TERM, Term
from zscout.services.placements import record_of

log = logging.getLogger(__name__)

ASK_TIMEOUT: Final = 2.0
TRIES: Final = 3


class PlacementLedger:
    """Follows what the placer publishes."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.term: Term = NO_TERM
        self._placements: dict[str, Placement] = {}
        self._cordoned: frozenset[str] = frozenset()
        self._declared: list[Declared] = []
        self._tasks: set[asyncio.Task[None]] = set()

    def start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self._declared = [
            mesh.subscribe(keys.placements, Placements, self._on_placements),
            mesh.watch(keys.alive_any(Role.RCM), self._on_leader),
        ]

    async def stop(self) -> None:
        for declared in reversed(self._declared):
            declared.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def inherited(self) -> Inherited:
        """Everything that is known, for a placer that begins."""
        return Inherited(tuple(map(record_of, self._placements.values())), self._cordoned)

    def _on_placements(self, _key: str, told: Placements) -> None:
        if told.term < self.term or absurd(told.term, self.term):
            return
        self.term = told.term
        self._cordoned = frozenset(told.cordoned)
        for placement in told.components:
            check_name(placement.component, "component")
            if len(self._placements) < 2 * MAX_PLACED or placement.component in self._placements:
                self._placements[placement.component] = placement
        for component in told.forgotten:
            self._placements.pop(component, None)

    def _on_leader(self, token: Token, alive: bool) -> None:
        """Who comes late asks for what was published before."""
        if alive and token.host != self.mesh.me.host:
            task = asyncio.get_running_loop().create_task(self._catch_up())
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _catch_up(self) -> None:
        for _ in range(TRIES):
            reply = await self.mesh.ask_one(
                self.mesh.keys.placer, ListPlacements(), Placements, timeout=ASK_TIMEOUT
            )
            if reply is not None and reply.message is not None:
                # What was published meanwhile is newer than the answer or the same.
                told = reply.message
                if told.term >= self.term:
                    fresh = [one for one in told.components if one.component not in self._placements]
                    self._on_placements("", Placements(told.term, fresh, told.cordoned))
                return
            await asyncio.sleep(ASK_TIMEOUT)
