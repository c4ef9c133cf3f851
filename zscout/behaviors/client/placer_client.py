"""Client of the component placer: requests, and its publications."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection
from typing import Final, Self, TypeVar

from zscout import messages
from zscout.behaviors.client.rcm_link import TRY_AGAIN
from zscout.behaviors.client.request import RequestRefused
from zscout.keyexpr import Role
from zscout.mesh import Mesh
from zscout.mesh.exchange import naming_versions
from zscout.mesh.supervision import done_within
from zscout.messages import ComponentSpec, Placement, PlacementOperation, Placements, PlacerOperation, Problem
from zscout.types import NO_TERM, SECOND, ComponentId, HostName, Term

TIMEOUT: Final = 5.0
"""Seconds of one query beyond its own `wait`: a new placer first asks all nodes for their components."""
PLACER_TIMEOUT: Final = 30.0
RETRY_AFTER: Final = 0.2
REFRESH_EVERY: Final = 1.0

R = TypeVar("R")


class PlacerSilent(RequestRefused):
    """No component placer answered; the operation may or may not have been carried out."""


class PlacerClient:
    """Places and stops components. `timeout`: seconds within which some placer must answer, even if the leader changes
    meanwhile.

    As a context manager it keeps `placements` (of the components in `only`, if given) up to date from publications and
    answers."""

    def __init__(
        self, mesh: Mesh, only: Collection[ComponentId] | None = None, *, timeout: float = PLACER_TIMEOUT
    ) -> None:
        self.mesh, self.only, self._timeout = mesh, only, timeout
        self._list = messages.ListPlacements(next(iter(only)) if only is not None and len(only) == 1 else None)
        self.placements: dict[ComponentId, Placement] = {}
        self.cordoned: frozenset[HostName] = frozenset()
        self.term: Term = NO_TERM
        self.changed = asyncio.Event()

    def __enter__(self) -> Self:
        self._subscription = self.mesh.subscribe(self.mesh.keys.placements, Placements, self._on_placements)
        return self

    def __exit__(self, *_: object) -> None:
        self._subscription.close()

    async def place(self, component: ComponentId, spec: ComponentSpec, *, wait: float = 3.0) -> Placement:
        """`wait`: seconds for which the placer waits for the start. Raises RequestRefused."""
        return await self.request(messages.PlaceComponent(component, spec, wait=wait), Placement)

    async def stop(self, component: ComponentId, *, wait: float = 0.0) -> Placement:
        """Raises RequestRefused."""
        return await self.request(messages.EndComponent(component, wait=wait), Placement)

    async def request(self, operation: PlacerOperation, kind: type[R]) -> R:
        """Repeat an idempotent operation until a placer answers. Raises RequestRefused, PlacerSilent."""
        silent = f"the component placer of fleet {self.mesh.keys.fleet} did not answer for {self._timeout:.0f} s"
        remedy = "see zscout status, and the leader's log of zscout-node"
        return await self._until(lambda: self._ask(operation, kind), f"{silent}; {remedy}")

    async def request_once(self, operation: PlacementOperation, done: Callable[[Placement], bool]) -> Placement:
        """Like `request`, but not idempotent: without an answer it is repeated only while `done` is false for the
        component's placement. Raises RequestRefused, PlacerSilent."""

        async def attempt() -> Placement | None:
            if (answer := await self._ask(operation, Placement)) is not None:
                self.take(answer)
                return answer
            await self.refresh()
            placement = self.placements.get(operation.component)
            return placement if placement is not None and done(placement) else None

        silent = "the component placer did not answer: it may or may not have been done; see zscout component list"
        return await self._until(attempt, silent)

    async def _until(self, attempt: Callable[[], Awaitable[R | None]], silent: str) -> R:
        deadline = self.mesh.now() + round(self._timeout * SECOND)
        while True:
            if (answer := await attempt()) is not None:
                return answer
            if self.mesh.now() > deadline:
                raise PlacerSilent(Problem("unknown", silent))
            await asyncio.sleep(RETRY_AFTER)

    async def refresh(self) -> None:
        """Query all placements, or those in `only`. Raises RequestRefused, PlacerSilent."""
        self._listed(await self.request(self._list, Placements))

    async def try_refresh(self) -> None:
        """Like `refresh`, with a single query: without an answer, `placements` stay unchanged."""
        if (listed := await self._ask(self._list, Placements)) is not None:
            self._listed(listed)

    async def wait_changed(self) -> None:
        """Wait for news; after REFRESH_EVERY seconds, refresh. Raises RequestRefused, PlacerSilent."""
        if not await done_within(REFRESH_EVERY, self.changed.wait()):
            await self.refresh()
        self.changed.clear()

    def take(self, *placements: Placement) -> None:
        for placement in placements:
            if self.only is None or placement.component in self.only:
                self.placements[placement.component] = placement
        self.changed.set()

    async def _ask(self, operation: PlacerOperation, kind: type[R]) -> R | None:
        """Send a single query. None: no answer, or a placer that can't answer now. Raises RequestRefused."""
        timeout = TIMEOUT + (operation.wait if isinstance(operation, PlacementOperation) else 0.0)
        replies = await self.mesh.ask(
            self.mesh.keys.placer(self.mesh.me),
            operation,
            kind,
            timeout=timeout,
            enough=lambda reply: reply.message is not None,
        )
        for reply in replies:
            if reply.message is not None:
                return reply.message
        if replies:
            leaders = await self.mesh.living(self.mesh.keys.alive_any(Role.RCM), timeout=RETRY_AFTER)
            who = " at ".join(["the component placer", *(token.host for token in leaders[:1])])
            refused = naming_versions(replies[0], who)
            if refused is not None and refused.problem is not None and refused.problem.code not in TRY_AGAIN:
                raise RequestRefused(refused.problem)
        return None

    def _listed(self, listed: Placements) -> None:
        self.placements = {}
        self.term, self.cordoned = listed.term, frozenset(listed.cordoned)
        self.take(*listed.components)

    def _on_placements(self, _key: str, published: Placements) -> None:
        if published.term < self.term or messages.absurd(published.term, self.term):
            return
        self.term, self.cordoned = published.term, frozenset(published.cordoned)
        self.take(*published.components)
        for component in published.forgotten:
            self.placements.pop(component, None)
