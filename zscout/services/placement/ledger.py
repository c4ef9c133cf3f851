"""A candidate's copy of the placer's publications: all that is known of components on a host that died with the
leader."""

from __future__ import annotations

import asyncio
import logging
from contextlib import ExitStack
from typing import Final

from zscout.keyexpr import BadName, Role, Token, check_name
from zscout.mesh import Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import MAX_PLACED, ListPlacements, Placement, Placements, absurd
from zscout.placement.events import Inherited
from zscout.types import NO_TERM, ComponentId, HostName, Term

log = logging.getLogger(__name__)

ASK_TIMEOUT: Final = 2.0
TRIES: Final = 3


class PlacementLedger:
    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.term: Term = NO_TERM
        self.placements: dict[ComponentId, Placement] = {}
        self._current: set[ComponentId] = set()  # published or listed since `start`
        self._cordoned: frozenset[HostName] = frozenset()
        self._declarations = ExitStack()

    def start(self, supervisor: Supervisor) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self._supervisor = supervisor
        self._current.clear()
        for declared in (
            mesh.subscribe(keys.placements, Placements, supervisor.guard(self._on_placements)),
            mesh.watch(keys.alive_any(Role.RCM), supervisor.guard(self._on_leader)),
        ):
            self._declarations.callback(declared.close)

    def stop(self) -> None:
        self._declarations.close()

    def inherited(self) -> Inherited:
        """All placements known, for a new placer."""
        return Inherited(tuple(self.placements.values()), self._cordoned)

    def _on_placements(self, _key: str, published: Placements) -> None:
        if published.term < self.term or absurd(published.term, self.term):
            return
        self.term = published.term
        self._cordoned = frozenset(published.cordoned) - {*published.maintained}
        for placement in published.components:
            component = check_name(placement.component, "component")
            if len(self.placements) < 2 * MAX_PLACED or component in self.placements:
                self.placements[component] = placement
                self._current.add(component)
        for component in published.forgotten:
            self.placements.pop(component, None)
            self._current.discard(component)

    def _on_leader(self, token: Token, alive: bool) -> None:
        """Ask a new leader for placements published before this candidate started."""
        if alive and token.host != self.mesh.me.host:
            self._supervisor.spawn(self._catch_up())

    async def _catch_up(self) -> None:
        for _ in range(TRIES):
            key = self.mesh.keys.placer(self.mesh.me)
            reply = await self.mesh.ask_one(key, ListPlacements(), Placements, timeout=ASK_TIMEOUT)
            if reply is not None and reply.message is not None:
                # Publications received meanwhile are newer or equal.
                listed = reply.message
                fresh = [known for known in listed.components if known.component not in self._current]
                try:
                    self._on_placements("", Placements(listed.term, fresh, listed.cordoned, [], listed.maintained))
                except BadName as error:
                    log.warning("ignored a list of placements: %s", error)
                return
            await asyncio.sleep(ASK_TIMEOUT)
        log.warning("the leading placer did not list its components in %d tries", TRIES)
