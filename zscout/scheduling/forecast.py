"""When will mine run: the core played forward from how things stand, as if nothing else were to come.

The forecast runs the very core and strategy that decide. RCs are taken to vote as they have voted; a question
that was never asked is taken to be a yes. Higher priority that comes later makes it wrong, of course, and so
does who releases early: it is an estimate, and is shown as one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    ArcRequest,
    Event,
    Granted,
    HoldEnded,
    Outcome,
    Propose,
    Requested,
    Tick,
    Vote,
)
from zscout.scheduling.reason import Reason
from zscout.scheduling.replay import play_instant
from zscout.scheduling.strategies import STRATEGIES
from zscout.types import ArcId, Ns, Term

MAX_CHECKS = 4_000
"""Queued ARCs, summed over all instants: a forecast must not keep the RCM from its work."""


@dataclass(slots=True)
class Forecast:
    """What is to be expected: when who waits starts, and whom a newcomer would preempt at once."""

    starts: dict[ArcId, Ns] = field(default_factory=dict)
    """Those that are not in it never start as things stand, or not within what was played."""
    preempts: list[ArcId] = field(default_factory=list)
    reason: Reason | None = None
    """What the newcomer waits for at first; None if it starts at once."""


def forecast(core: Core, now: Ns, newcomer: ArcRequest | None = None) -> Forecast:
    """Plays `core` forward from `now`, with `newcomer` asking at once. `core` is not touched."""
    return _Player(core, now).play(newcomer)


class _Player:
    def __init__(self, core: Core, now: Ns) -> None:
        self.real, self.now = core, now
        # A strategy may keep unfinished searches: the forecast must not meddle with them.
        self.core = Core(STRATEGIES[core.strategy.name](), core.policy)
        self.result = Forecast()
        self.ends: dict[ArcId, Ns] = {}
        self.unserved: set[ArcId] = set()
        """ARCs that are queued and have not started within what was played."""

    def play(self, newcomer: ArcRequest | None) -> Forecast:
        joined, lead = self.real.as_events(Term(self.real.term.counter + 1, "forecast"))
        self.ends = {held.request.arc: held.end for held in lead.standing}
        self.unserved = {one.request.arc for one in lead.waiting}
        self._step([*joined, lead])
        if newcomer is not None:
            self.unserved.add(newcomer.arc)
            self._step([Requested(newcomer)], newcomer.arc)
            arc = self.core.arc(newcomer.arc)
            self.result.reason = arc.reported if arc is not None else None
        checks = 0
        while self.ends and self.unserved:
            checks += self.core.waiting
            if checks > MAX_CHECKS:
                break
            self.now = max(self.now, min(self.ends.values()))
            self._step([Tick()])
        return self.result

    def _step(self, events: list[Event], newcomer: ArcId | None = None) -> None:
        """One instant."""
        for effects in play_instant(self.core, self.now, events, self._vote):
            for effect in effects:
                match effect:
                    case Granted(arc=arc, start=start):
                        self.result.starts.setdefault(arc, start)
                        self.unserved.discard(arc)
                        running = self.core.arc(arc)
                        if running is not None and running.hold is not None:
                            self.ends[arc] = running.hold.end
                    case HoldEnded(arc=arc, outcome=outcome, by=by, requeued=requeued):
                        self.ends.pop(arc, None)
                        if requeued and arc not in self.result.starts:
                            self.unserved.add(arc)
                        if newcomer is not None and by == newcomer and outcome is Outcome.PREEMPTED:
                            self.result.preempts.append(arc)
                    case _:
                        pass
            # A kept hold goes on past its minimum runtime: what counts is when it becomes preemptible.
            self.ends = {arc: end for arc, end in self.ends.items() if end > self.now}

    def _vote(self, asked: Propose) -> Vote:
        return Vote(asked.proposal, self.real.expects_yes(asked.rc, frozenset(asked.holders)))
