"""When the queued ARCs will start: one forecast serves all who ask for it in the same instant."""

from __future__ import annotations

from collections.abc import Mapping

from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.types import SECOND, ArcId, Ns

RECENT: Ns = SECOND
"""Notices make do with a forecast of this age: each costs the RCM as much as many passes."""


class Forecasts:
    """The forecasts of one core."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self._batch: int | None = None
        """The batch of events after which the last one was made."""
        self._made: Ns = 0
        self._starts: Mapping[ArcId, Ns] = {}

    def starts(self, now: Ns) -> Mapping[ArcId, Ns]:
        """When each queued ARC will start as things stand; those that are left out will not, or too late."""
        if self._batch != self._core.batches:
            self._starts = forecast(self._core, now).starts
            self._batch, self._made = self._core.batches, now
        return self._starts

    def start(self, arc: ArcId, since: Ns, now: Ns) -> Ns | None:
        """When an ARC that is queued `since` then will start, by a forecast that is not older than RECENT."""
        recent = self._batch is not None and since < self._made and now - self._made < RECENT
        return (self._starts if recent else self.starts(now)).get(arc)
