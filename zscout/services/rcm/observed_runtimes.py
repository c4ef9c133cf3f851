"""Learns the durations of holds from the leader's publications, which every candidate receives, and from the journal:
a new leader knows as much as the last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from typing import Final, NamedTuple

from zscout.messages import Grants, Holder, PastHold, ReasonInfo, Who, duration
from zscout.scheduling.model import Outcome
from zscout.scheduling.reason import ReasonCode
from zscout.scheduling.runtimes import RequestTraits, RuntimeEstimator
from zscout.types import SECOND, Grant, Ns

MAX_OPEN: Final = 20_000
"""Holds that are followed at one time: the latest ones."""


class _Begun(NamedTuple):
    traits: RequestTraits
    at: Ns


class RuntimeObserver:
    def __init__(self) -> None:
        self.estimator = RuntimeEstimator()
        self._open: OrderedDict[Grant, _Begun] = OrderedDict()

    def hear(self, now: Ns, grants: Grants) -> None:
        """Take in a publication of a believed term; `now` by any monotonic clock."""
        for holders in grants.rcs.values():
            for holder in holders:
                if holder.grant not in self._open:
                    self._begin(now, holder)
        for revoked in grants.revoked:
            begun = self._open.pop(revoked.grant, None)
            if begun is not None:
                self._end(begun.traits, now - begun.at, revoked.outcome, revoked.why)

    def recall(self, holds: Iterable[PastHold]) -> None:
        """Learn from the holds in a journal, given with the oldest first."""
        for hold in holds:
            if hold.ended is not None and hold.min_runtime is not None and not hold.late and hold.rcs:
                asked = round(hold.min_runtime * SECOND)
                if asked > 0:
                    traits = _traits(hold.arc, hold.who, hold.rcs, asked)
                    why = ReasonInfo(hold.code, own=hold.own) if hold.code else None
                    self._end(traits, round((hold.ended - hold.began) * SECOND), hold.outcome, why)

    def _begin(self, now: Ns, holder: Holder) -> None:
        try:
            asked = duration(holder.min_runtime, "min_runtime")
        except ValueError:
            return
        patterns = {rc: need for need, rc in holder.bound.items()}
        needs = [patterns.get(rc, rc) for rc in holder.rcs]
        traits = _traits(holder.arc, holder.who, needs, asked)
        # A hold that is seen late, or that continues under a new grant, began earlier: by the part of its minimum
        # runtime that is used up.
        runtime = asked if holder.runtime is None else round(holder.runtime * SECOND)
        self._open[holder.grant] = _Begun(traits, now - max(0, runtime - round(holder.remaining * SECOND)))
        if len(self._open) > MAX_OPEN:
            self._open.popitem(last=False)

    def _end(self, traits: RequestTraits, lasted: Ns, outcome: str, why: ReasonInfo | None) -> None:
        unknown = why is None and outcome in (Outcome.COMPLETED, Outcome.RELEASED)  # of an older version
        if outcome == Outcome.HANDED_OVER or lasted < 0 or unknown:
            return
        expired = why is not None and why.code == ReasonCode.EXPIRED
        given_back = why is not None and why.code == ReasonCode.RELEASED and why.own
        if expired:
            lasted = traits.runtime  # exactly: the rest is the latency of publications
        # Whole: the program had all the time that it wanted, or had requested.
        self.estimator.observe(traits, lasted, whole=expired or given_back)


def _traits(arc: str, who: Who | None, needs: Iterable[str], asked: Ns) -> RequestTraits:
    return RequestTraits(arc, "" if who is None else who.command, frozenset(needs), asked)
