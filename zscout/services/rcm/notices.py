"""Notices to clients: every change of their requests that is not the answer to an operation."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable

from zscout.keyexpr import BadName, client_of
from zscout.mesh import Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import Notice
from zscout.scheduling.core import Core
from zscout.scheduling.model import Dropped, Effect, Granted, HoldEnded, Queued
from zscout.services.rcm.history import ArcHistory
from zscout.services.rcm.registry import RequestRegistry
from zscout.types import ArcId

log = logging.getLogger(__name__)

REASONS_EVERY = 0.1
"""Seconds at most until a changed reason to wait is published: in a busy queue every grant changes many
reasons, and only the last is of use."""


class Notices:
    """Publishes what becomes of one reign's requests, each on its client's key."""

    def __init__(
        self, mesh: Mesh, core: Core, registry: RequestRegistry, history: ArcHistory, supervisor: Supervisor
    ) -> None:
        self.mesh, self.core = mesh, core
        self._registry, self._history, self._supervisor = registry, history, supervisor
        self._changed: set[ArcId] = set()
        """Queued ARCs whose reason to wait has changed and has not been published yet."""

    def report(
        self, effects: Iterable[Effect], answered: Collection[ArcId], given_up: Collection[ArcId]
    ) -> None:
        """Publishes what follows from an instant's effects. For the `answered` ARCs a grant, and for
        the `given_up` ones the end of a hold, is the answer to an operation, and no notice."""
        for effect in effects:
            match effect:
                case Granted(arc=arc, rcs=rcs):
                    self._record(arc, f"granted {', '.join(rcs)}")
                    if arc not in answered:
                        self._publish(self._registry.notice(arc))
                case HoldEnded(arc=arc):
                    again = "; queued again" if effect.requeued else ""
                    self._record(arc, f"{effect.outcome}: {effect.reason}{again}")
                    notice = self._registry.close(effect)
                    if arc not in given_up:
                        self._publish(notice)
                case Dropped(arc=arc):
                    self._record(arc, f"{effect.outcome}: {effect.reason}")
                    self._publish(self._registry.close(effect))
                case Queued(arc=arc, settled=True) if self.core.is_queued(arc):
                    if not self._changed:
                        self._supervisor.call_later(REASONS_EVERY, self._publish_reasons)
                    self._changed.add(arc)
                case _:
                    pass

    def publish(self, arcs: Iterable[ArcId]) -> None:
        """Tells the clients of these ARCs, as far as they are open, how they stand now."""
        for arc in arcs:
            if self.core.arc(arc) is not None:
                self._changed.discard(arc)
                self._publish(self._registry.notice(arc))

    def flush(self) -> None:
        """Records the reasons that have not been published: nothing is published any more."""
        changed, self._changed = self._changed, set()
        for arc in filter(None, map(self.core.arc, changed)):
            if arc.hold is None:
                self._record(arc.id, f"waits: {arc.reported}")

    def _publish_reasons(self) -> None:
        changed = [arc for arc in self._changed if self.core.is_queued(arc)]
        self.flush()
        self.publish(changed)

    def _record(self, arc: ArcId, text: str) -> None:
        self._history.record(arc, self._registry.name(arc), text)

    def _publish(self, notice: Notice) -> None:
        try:
            self.mesh.put(self.mesh.keys.notice(client_of(notice.client)), notice)
        except BadName:
            log.exception("a notice could not be addressed")
