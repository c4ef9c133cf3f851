"""A candidate's knowledge from the publications of leaders, for the time when it leads itself."""

from __future__ import annotations

from collections.abc import Mapping

from zscout.messages import Grants
from zscout.scheduling.fair_shares import decayed
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.journal.journal import Journal
from zscout.services.rcm.observed_runtimes import RuntimeObserver
from zscout.types import SECOND, Ns


class Learned:
    def __init__(self, keeper: BookingKeeper, runtimes: RuntimeObserver, journal: Journal | None) -> None:
        self.keeper, self.runtimes, self._journal = keeper, runtimes, journal
        self._charged: tuple[Mapping[str, float], Ns] = {}, 0
        """The last published usage per group, and its arrival."""
        self.patience: Ns | None = None
        """The last published patience."""

    def hear(self, now: Ns, grants: Grants) -> None:
        self.keeper.observe(grants)
        self.runtimes.hear(now, grants)
        if grants.charged:
            self._charged = grants.charged, now
        if grants.patience is not None:
            self.patience = round(grants.patience * SECOND)
        if self._journal is not None:
            self._journal.observe(grants)

    def charged(self, now: Ns, half_life: Ns) -> dict[str, float]:
        """Usage per group, decayed since its publication (`fair_shares.py`)."""
        charged, at = self._charged
        return {group: decayed(usage, now - at, half_life) for group, usage in charged.items()}
