"""When will mine run: the core played forward from how things stand, as if nothing else were to come.

The forecast runs the very core and strategy that decide. RCs are taken to vote as they have voted; a question
that was never asked is taken to be a yes. Higher priority that comes later makes it wrong, of course, and so
does who gives back early: it is an estimate, and says so where it is shown.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.core import Core
from zscout.scheduling.effects import Granted, Outcome, Propose, Revoked, WakeAt
from zscout.scheduling.events import Asked, Event, LeadTaken, RcJoined, Standing, Tick, Vote, Waiting
from zscout.scheduling.model import ArcId, Ns, Request, Term

MAX_VISITS = 4_000
"""Looks at a waiting ARC, all instants together: a forecast must not keep the RCM from its work."""


@dataclass(slots=True)
class Forecast:
    """What is to be expected: when who waits starts, and whom a newcomer would preempt at once."""

    starts: dict[ArcId, Ns] = field(default_factory=dict)
    """Those that are not in it never start as things stand, or not within what was played."""
    preempts: list[ArcId] = field(default_factory=list)
    reason: str = ""
    """What the newcomer waits for at first, in words; empty if it starts at once."""


def forecast(core: Core, now: Ns, newcomer: Request | None = None) -> Forecast:
    """Plays `core` forward from `now`, with `newcomer` asking at once. `core` is not touched."""
    return _Player(core, now).play(newcomer)


class _Player:
    def __init__(self, core: Core, now: Ns) -> None:
        self.real, self.now = core, now
        # It keeps unfinished searches: the forecast must not meddle with them.
        self.core = Core(Adaptive() if isinstance(core.strategy, Adaptive) else core.strategy, core.policy)
        self.result = Forecast()
        self.ends: dict[ArcId, Ns] = {}

    def play(self, newcomer: Request | None) -> Forecast:
        self._step(self._standing())
        if newcomer is not None:
            self._step([Asked(newcomer)], newcomer.arc)
            waits = self.core.floor.queued.get(newcomer.arc)
            self.result.reason = waits.reason if waits is not None else ""
        visits = 0
        while self.ends and self.core.floor.queued.keys() - self.result.starts.keys():
            visits += len(self.core.floor.queued)
            if visits > MAX_VISITS:
                break
            self.now = max(self.now, min(self.ends.values()))
            self._step([Tick()])
        return self.result

    def _standing(self) -> list[Event]:
        floor = self.real.floor
        joined = [RcJoined(rc.name, rc.sharable) for rc in floor.rcs.values() if rc.present]
        standing = tuple(
            Standing(arc.request, arc.place, arc.hold.grant, arc.hold.start, arc.hold.end, arc.bound)
            for arc in floor.running.values()
            if arc.hold is not None
        )
        waiting = tuple(Waiting(arc.request, arc.place, arc.since) for arc in floor.queued.values())
        self.ends = {held.request.arc: held.end for held in standing}
        term = Term(self.real.term.counter + 1, "forecast")
        return [*joined, LeadTaken(term, standing, waiting)]

    def _step(self, events: list[Event], newcomer: ArcId | None = None) -> None:
        """One instant, with every vote that it takes."""
        while events:
            votes: list[Event] = []
            again = False
            for effect in self.core.handle(self.now, *events):
                match effect:
                    case Granted(arc=arc, start=start):
                        self.result.starts.setdefault(arc, start)
                        running = self.core.floor.running[arc]
                        if running.hold is not None:
                            self.ends[arc] = running.hold.end
                    case Revoked(arc=arc, outcome=outcome, by=by):
                        self.ends.pop(arc, None)
                        if newcomer is not None and by == newcomer and outcome is Outcome.PREEMPTED:
                            self.result.preempts.append(arc)
                    case Propose(proposal=proposal, rc=rc, holders=holders):
                        known = self.real.votes.known(rc, frozenset(holders))
                        votes.append(Vote(proposal, known is None or known.accept))
                    case WakeAt(at=at):
                        again = at == self.now
                    case _:
                        pass
            # A kept hold goes on past its minimum runtime: what counts is when it begins to yield.
            self.ends = {arc: end for arc, end in self.ends.items() if end > self.now}
            events = votes or ([Tick()] if again else [])
