"""No change of upcoming ends is missed, and no hold ends while it was reported to be safe."""

from __future__ import annotations

import random
from fractions import Fraction

import pytest

from tests.thorough import times
from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling.booking import Booked, Booking, Unbooked
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    ArcRequest,
    Cancelled,
    Effect,
    Event,
    Granted,
    HandedOver,
    HoldEnded,
    Outcome,
    Propose,
    RcJoined,
    Released,
    Requested,
    Tick,
    Vote,
)
from zscout.scheduling.strategies import STRATEGIES
from zscout.scheduling.upcoming import UpcomingEnd
from zscout.types import ArcId, Ns, Params

RCS = ("cam/a", "cam/b", "cam/c", "robot/x", "robot/y", "radio/rf")
NEEDS = (*RCS, "cam/*", "cam/*#2", "robot/*")


class Story:
    """A core, and what the holders of its holds were told last."""

    def __init__(self, seed: int, strategy: StrategyName) -> None:
        self.random, self.core = random.Random(seed), Core(STRATEGIES[strategy]())  # noqa: S311
        self.now: Ns = 0
        self.told: dict[ArcId, tuple[UpcomingEnd, ...]] = {}
        self.names = 0
        self.handle(*(RcJoined(rc, sharable=rc.startswith("radio")) for rc in RCS))

    def handle(self, *events: Event) -> list[Effect]:
        effects = self.core.handle(self.now, *events)
        while votes := [self._vote(effect) for effect in effects[-len(effects) :] if isinstance(effect, Propose)]:
            more = self.core.handle(self.now, *votes)
            effects = [*(effect for effect in effects if not isinstance(effect, Propose)), *more]
        return effects

    @staticmethod
    def _vote(asked: Propose) -> Vote:
        return Vote(asked.proposal, accept=sum(params.get("rate", 1) for params in asked.holders.values()) <= 4)

    def event(self) -> Event:
        self.names += 1
        name, choose = f"n{self.names}", self.random
        arcs = self.core.arcs()
        match choose.randrange(10) if arcs else 0:
            case 0 | 1 | 2 | 3 | 4:
                return Requested(self._request(name))
            case 5:
                return Released(choose.choice(arcs))
            case 6:
                return Cancelled(choose.choice(arcs))
            case 7 if self.core.strategy.name == "adaptive":
                start, rcs = self.now + choose.randrange(40), choose.sample(RCS[:5], choose.randrange(1, 3))
                runtime, priority, kind = choose.randrange(5, 30), choose.randrange(3), choose.random()
                needs: dict[str, Params] = {rc: {} for rc in rcs}
                maintenance = kind < 0.5
                booking = Booking(
                    name,
                    needs,
                    priority,
                    start,
                    runtime,
                    runtime if maintenance else 10,
                    self.now,
                    maintenance=maintenance,
                    urgent=kind < 0.1,
                )
                return Booked(booking)
            case 8 if self.core.bookings():
                return Unbooked(choose.choice(self.core.bookings())[0].id)
            case 9:
                return HandedOver(choose.choice(arcs), "h/heir", name)
            case _:
                return Tick()

    def _request(self, name: str) -> ArcRequest:
        choose = self.random
        chosen = choose.sample(NEEDS, choose.randrange(1, 4))
        chosen = [need for need in chosen if "#" not in need or "cam/*" in chosen]
        needs: dict[str, Params] = {
            need: {"rate": Fraction(choose.randrange(1, 4))} if need == "radio/rf" else {} for need in chosen or RCS[:1]
        }
        priority, runtime = choose.randrange(3), choose.randrange(1, 40)
        until_done = choose.randrange(100) if choose.random() < 0.3 else 0
        client, keep = f"h{choose.randrange(3)}/c", choose.random() < 0.7
        return ArcRequest(name, client, needs, priority, runtime, keep, until_done=until_done)

    def tell(self) -> None:
        for arc in self.core.contended_holds():
            self.told[arc] = self.core.upcoming(arc)


@pytest.mark.parametrize("strategy", ["adaptive", "priority"])
def test_no_change_is_missed_and_no_hold_ends_while_it_is_safe(strategy: StrategyName) -> None:
    ended = 0
    for seed in range(times(30)):
        story = Story(seed, strategy)
        for _ in range(80):
            story.now += story.random.randrange(4)
            for effect in story.handle(story.event()):
                if isinstance(effect, Granted):
                    story.told[effect.arc] = story.core.upcoming(effect.arc)
                if not isinstance(effect, HoldEnded):
                    continue
                known = [end for end in story.told.pop(effect.arc, ()) if end.by.arc == effect.by]
                if effect.outcome in (Outcome.COMPLETED, Outcome.PREEMPTED):
                    ended += bool(known)
                    assert all(end.until <= story.now for end in known), (seed, effect, known)
            story.tell()
            for arc in story.core.arcs():
                now = [end._replace(until=0) for end in story.core.upcoming(arc)]
                told = [end._replace(until=0) for end in story.told.get(arc, ())]
                assert now == told, (seed, story.now, arc, now, told)
    assert ended > 20
