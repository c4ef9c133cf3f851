"""Whether a leader was itself away when tokens go: it would take its own lost links for others' deaths."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

from msgspec import Struct

from zscout.mesh import Declaration, Mesh
from zscout.mesh.supervision import StallWatch, Supervisor
from zscout.messages import RcAsk
from zscout.types import SECOND, HostName, Ns

AWAY: Final = 0.25
"""A leader that stood still for this part of the mesh lease, or lost several hosts within it, was away itself."""
AT_ONCE: Final = 0.05
"""Seconds within which others answer a leader that is not away. A later answer proves nothing: it may be back since."""
MAX_ASKED: Final = 3
"""Hosts that are asked whether this one is away."""

Asked: TypeAlias = tuple[str, type[Struct]]
"""A key, and what is answered there."""


class Absence:
    """Of one leader: it stood still, or lost several hosts at once. Of one token that goes it is not known for the
    moment that others take to answer; `on_present` is called once they have.

    `lease` is the mesh lease in seconds."""

    def __init__(self, mesh: Mesh, lease: float, supervisor: Supervisor, on_present: Callable[[], object]) -> None:
        self._mesh, self._supervisor, self._on_present = mesh, supervisor, on_present
        self._lease, self._span = round(lease * SECOND), round(AWAY * lease * SECOND)
        self._stall = StallWatch(mesh.now)
        self._gone: deque[tuple[Ns, HostName]] = deque()
        """Which hosts' last tokens went lately, and when."""
        self._until: Ns = 0

    def watch(self) -> Declaration:
        return Declaration(self._stall.start().stop)

    def token_went(self, host: HostName, *, last: bool, others: Callable[[], Sequence[Asked]]) -> None:
        """A token of `host` is gone, the `last` one that was seen of it. `others`: whom to ask, on hosts seen."""
        now = self._mesh.now()
        if last:
            self._gone.append((now, host))
        while self._gone and self._gone[0][0] < now - self._span:
            self._gone.popleft()
        if (self._stall.fresh() and self.stood_still) or self._lost_several:
            self._until = now + self._lease
        elif not self.lasts and (asked := others()[:MAX_ASKED]):
            # Of several links that are lost, be it to one host, one is the first.
            self._until = now + self._lease
            for key, kind in asked:
                self._supervisor.spawn(self._ask(key, kind))

    @property
    def lasts(self) -> bool:
        """Whether what goes now is only unseen."""
        return self._mesh.now() < self._until

    @property
    def stood_still(self) -> bool:
        """Whether this leader was away for that less than a lease ago."""
        self._stall.check()
        return self._stall.length > self._span and self._mesh.now() - self._stall.ended < self._lease

    @property
    def _lost_several(self) -> bool:
        return len({host for _, host in self._gone}) > 1

    async def _ask(self, key: str, kind: type[Struct]) -> None:
        """If anybody else answers, this leader is not away, and what went has gone."""
        reply = await self._mesh.ask_one(key, RcAsk(), kind, timeout=AT_ONCE)
        # Who stood still meanwhile, or lost another host, does not believe it.
        if reply is not None and not self._stall.fresh() and not self._lost_several:
            self._until = 0
            self._on_present()
