"""`rcm/grants`: who holds what, published as one numbered stream."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable

from zscout.config.fleet import Fleet
from zscout.mesh import Mesh
from zscout.messages import Grants, Holder, Revocation
from zscout.scheduling.core import Core
from zscout.scheduling.model import Effect, Granted, HoldEnded
from zscout.services.rcm import convert
from zscout.services.rcm.registry import RequestRegistry
from zscout.types import SECOND, Ns, RcName


class GrantsPublisher:
    """Publishes one reign's grants and revocations, and its heartbeat."""

    def __init__(self, mesh: Mesh, fleet: Fleet, core: Core, registry: RequestRegistry) -> None:
        self.mesh, self.core = mesh, core
        self._registry = registry
        self._heartbeat = fleet.timing.heartbeat
        self._publisher = mesh.publisher(mesh.keys.grants, Grants)
        self.seq = 0
        """The last number that was published."""
        self._at: Ns = 0
        self._named: dict[RcName, int] = {}
        """The number of the last publication that named an RC."""

    def publish(self, effects: Iterable[Effect], rcs: Collection[RcName] | None = None) -> None:
        """Publishes all holders of the RCs that were granted or revoked, if any were; with `rcs` in any case,
        and those of `rcs` as well."""
        changed = [effect for effect in effects if isinstance(effect, (Granted, HoldEnded))]
        if not changed and rcs is None:
            return
        revoked = [
            convert.revocation(effect, self._registry.name(effect.arc))
            for effect in changed
            if isinstance(effect, HoldEnded)
        ]
        now = self.mesh.now()
        number = self.core.seq if self.core.seq > self.seq else self.core.number()
        names = sorted({*(rcs or ()), *(rc for effect in changed for rc in effect.rcs)})
        self._named |= dict.fromkeys(names, number)
        holders = {name: convert.holders(self.core.holders(name), name, now) for name in names}
        self._put(number, holders, revoked)

    def is_current(self, rc: RcName, seq: int) -> bool:
        """Whether `seq` is not older than the last publication that named an RC."""
        return seq >= self._named.get(rc, 0)

    async def beat(self) -> None:
        """Repeats the last number whenever nothing was published for a while."""
        while True:
            due = self._at + self._heartbeat - self.mesh.now()
            if due > 0:
                await asyncio.sleep(due / SECOND)
            else:
                self._put(self.seq, {}, [])

    def close(self) -> None:
        self._publisher.close()

    def _put(self, number: int, rcs: dict[RcName, list[Holder]], revoked: list[Revocation]) -> None:
        every = self._heartbeat / SECOND
        term, previous = self.core.term, self.seq
        self._publisher.put(
            Grants(term=term, seq=number, prev=previous, every=every, rcs=rcs, revoked=revoked)
        )
        self.seq, self._at = number, self.mesh.now()
